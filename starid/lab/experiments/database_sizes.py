"""Least overlap, number of frames and size of the databases: eqs 2.23–2.27 and table 6.1."""

from __future__ import annotations

import math
import time
from typing import Final

import numpy as np

from starid.identification.thesis.database import DatabaseParameters, build_database
from starid.identification.thesis.database_file import save_database
from starid.identification.thesis.frame_grid import make_grid, minimum_overlap, nominal_cells
from starid.lab.experiments.experiment import Context, Evaluation, Part, Results, star_catalog

_BYTES: Final = 5
_INCLUSIVE: Final = (99.75,)
"""Overlaps of the databases that include both ends of their ranges."""
_FILE_LIMIT_MB: Final = 32.0
_BUILD_LIMIT_S: Final = 10.0
_THREADS: Final = 2


def compute(context: Context, part: Part) -> Results:
    """Number of cells of a database, and time and size if it is built."""
    overlap = part["percent"] / 100.0
    parameters = DatabaseParameters(overlap=overlap)
    cells = make_grid(parameters.geometry, parameters.fov_deg, overlap).cells
    seconds, busy, size = math.nan, math.nan, 0
    if context.parameters["build"]:
        catalog = star_catalog()
        build_database(catalog, DatabaseParameters(overlap=0.9))
        start, busy_before = time.perf_counter(), time.process_time()
        database = build_database(catalog, parameters, threads=_THREADS)
        seconds, busy = time.perf_counter() - start, time.process_time() - busy_before
        context.databases.mkdir(parents=True, exist_ok=True)
        size = save_database(database, context.database_file(overlap))
        cells = database.cells
    return {
        "cells": np.array(cells),
        "seconds": np.array(seconds),
        "processor_s": np.array(busy),
        "bytes_file": np.array(size),
    }


def _inclusive_cells(percent: float) -> float:
    """Number of cells of a grid that includes both ends of 360° and of 140°."""
    step = 40.0 * (1.0 - percent / 100.0)
    return float((round(360.0 / step) + 1) * (round(140.0 / step) + 1))


def evaluate(e: Evaluation) -> None:
    """Numbers and sizes for each overlap; bounds on the time and the file of the largest database."""
    e.compare("p_min, eq. 2.27", printed=minimum_overlap())
    lines = []
    for percent in e.parameters["percent"]:
        result = e.results[f"p{percent:g}"]
        cells, nominal = int(result["cells"]), nominal_cells(42.0, percent / 100.0)
        counted = _inclusive_cells(percent) if percent in _INCLUSIVE else cells
        line = {"percent": percent, "nominal_N_42_deg": nominal, "published_N": ""}
        line |= {"cells": cells, "bytes_features": _BYTES * cells, "published_kB": ""}
        for quantity, column, author, printed in (
            (f"nominal N, eq. 2.23, φ = 42°, p = {percent:g} %", "published_N", math.floor(nominal), nominal),
            (
                f"table 6.1: database size, p = {percent:g} %",
                "published_kB",
                _BYTES * counted / 1000.0,
                _BYTES * cells / 1000.0,
            ),
        ):
            if known := e.published(quantity):
                e.compare(quantity, author=author, printed=printed)
                line[column] = f"{known[0]:.0f}"
        line |= {"build_s": float(result["seconds"]), "build_processor_s": float(result["processor_s"])}
        lines.append(line | {"bytes_file": int(result["bytes_file"])})
    e.write("table_6_1_sizes.csv", lines)
    if e.parameters["build"]:
        last = lines[-1]
        e.compare(
            "time to build the database of 99.75 %, two threads: processor time of each",
            ours=last["build_processor_s"] / _THREADS,
            unit="s",
            check=f"≤ {_BUILD_LIMIT_S}",
            remark=f"{last['build_s']:.1f} s by the clock, other work on the machine included.",
        )
        size = 1e-6 * last["bytes_file"]
        e.compare("file of the database of 99.75 %", ours=size, unit="MB", check=f"≤ {_FILE_LIMIT_MB}")
