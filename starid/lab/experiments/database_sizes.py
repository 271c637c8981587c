"""Least overlap, number of frames and size of the databases: eqs 2.23–2.27 and table 6.1."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from typing import Final

import numpy as np

from starid.lab.experiments.comparison import compared, published
from starid.lab.experiments.experiment import (
    Context,
    Experiment,
    Outcome,
    Parameters,
    Part,
    Results,
    parts_of,
    row,
    star_catalog,
    write_lines,
)

_BYTES: Final = 5
_INCLUSIVE: Final = (99.75,)
"""Overlaps of the databases that include both ends of their ranges."""
_FILE_LIMIT_BYTES: Final = 32_000_000
_BUILD_LIMIT_S: Final = 10.0
_THREADS: Final = 2

_NOTE: Final = """The published sizes are five bytes per frame, at a grid step of 40°·(1 − p) over 140° of
declination. Eq. 2.23 with φ = 42°, as in the text, gives the nominal N of section 6.1.1, for which the tables
were not made. Ours are the number of cells times five bytes, in kB of 1 000 bytes; the polar angle takes a
sixth byte."""


def _parts(parameters: Parameters) -> list[Part]:
    return parts_of("p{percent:g}", percent=parameters["percent"])


def _compute(context: Context, part: Part) -> Results:
    from starid.thesis.database import DatabaseParameters, build_database
    from starid.thesis.database_file import save_database
    from starid.thesis.frame_grid import make_grid

    overlap = part.values["percent"] / 100.0
    parameters = DatabaseParameters(overlap=overlap)
    cells = make_grid(parameters.geometry, parameters.fov_deg, overlap).cells
    built = {"seconds": np.float64(np.nan), "processor_s": np.float64(np.nan), "bytes_file": np.int64(0)}
    if context.parameters["build"]:
        catalog = star_catalog()
        build_database(catalog, DatabaseParameters(overlap=0.9))
        start, busy = time.perf_counter(), time.process_time()
        database = build_database(catalog, parameters, threads=_THREADS)
        built["seconds"] = np.float64(time.perf_counter() - start)
        built["processor_s"] = np.float64(time.process_time() - busy)
        context.databases.mkdir(parents=True, exist_ok=True)
        path = context.database_file(overlap)
        built["bytes_file"] = np.int64(save_database(database, path))
        cells = database.cells
    return {"cells": np.int64(cells), **built}  # type: ignore[dict-item]


def _inclusive_cells(percent: float) -> float:
    """Number of cells of a grid that includes both ends of 360° and of 140°."""
    step = 40.0 * (1.0 - percent / 100.0)
    return float((round(360.0 / step) + 1) * (round(140.0 / step) + 1))


def _evaluate(context: Context, results: Mapping[str, Results]) -> Outcome:
    from starid.thesis.frame_grid import minimum_overlap, nominal_cells

    rows = [compared("database-sizes", "p_min, eq. 2.27", printed=minimum_overlap())]
    lines = []
    for percent in context.parameters["percent"]:
        result = results[f"p{percent:g}"]
        cells, nominal = int(result["cells"]), nominal_cells(42.0, percent / 100.0)
        counted = _inclusive_cells(percent) if percent in _INCLUSIVE else cells
        quantities = {
            f"nominal N, eq. 2.23, φ = 42°, p = {percent:g} %": (math.floor(nominal), nominal),
            f"table 6.1: database size, p = {percent:g} %": (
                _BYTES * counted / 1000.0,
                _BYTES * cells / 1000.0,
            ),
        }
        numbers = [published("database-sizes", quantity) for quantity in quantities]
        rows += [
            compared("database-sizes", quantity, author=author, printed=printed)
            for (quantity, (author, printed)), known in zip(quantities.items(), numbers, strict=True)
            if known
        ]
        names = ["".join(f"{number:.0f}" for number in known) for known in numbers]
        line = {"percent": percent, "nominal_N_42_deg": nominal, "published_N": names[0]}
        line |= {"cells": cells, "bytes_features": _BYTES * cells, "published_kB": names[1]}
        line |= {"build_s": float(result["seconds"]), "build_processor_s": float(result["processor_s"])}
        lines.append(line | {"bytes_file": int(result["bytes_file"])})
    last = results[f"p{context.parameters['percent'][-1]:g}"]
    if context.parameters["build"]:
        rows += [
            row(
                "time to build the database of 99.75 %, two threads: processor time of each",
                ours=float(last["processor_s"]) / _THREADS,
                unit="s",
                at_most=_BUILD_LIMIT_S,
                remark=f"{float(last['seconds']):.1f} s by the clock, other work on the machine included.",
            ),
            row(
                "file of the database of 99.75 %",
                ours=float(last["bytes_file"]) / 1e6,
                unit="MB",
                at_most=_FILE_LIMIT_BYTES / 1e6,
            ),
        ]
    return Outcome(tuple(rows), (write_lines(context.folder / "table_6_1_sizes.csv", lines),), (_NOTE,))


_PERCENT: Final = [96.0, 97.0, 98.0, 99.0, 99.1, 99.2, 99.3, 99.4, 99.5, 99.6, 99.75]

EXPERIMENTS: Final = (
    Experiment(
        "database-sizes",
        "Overlap, number of frames, sizes: eqs 2.23–2.27, section 6.1.1, table 6.1",
        _parts,
        _compute,
        _evaluate,
        full={"percent": _PERCENT, "build": True},
        quick={"percent": _PERCENT, "build": False},
        alone=True,
        revision=2,
    ),
)
