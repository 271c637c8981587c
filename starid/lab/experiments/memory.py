"""Memory of a process that identifies with the largest database."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from starid.lab.experiments.experiment import (
    Context,
    Experiment,
    Outcome,
    Parameters,
    Part,
    ReproduceError,
    Results,
    parts_of,
    row,
    write_lines,
)

_LIMIT_MB: Final = 400.0
_PROBE: Final = "starid.lab.experiments.memory_probe"

_NOTE: Final = """Peak resident size of a new process that maps the database file, sorts its codes into the
search tree, solves 270 frames lost in space and follows a sequence of 100 frames with the recursive
algorithm, including the interpreter, its libraries and the mapped file. To exclude compilation, the process
is run twice, and the second run counts."""


def _parts(parameters: Parameters) -> list[Part]:
    return parts_of("p{percent:g}", percent=parameters["percent"])


def _compute(context: Context, part: Part) -> Results:
    overlap = part.values["percent"] / 100.0
    context.database(overlap)
    command = [sys.executable, "-m", _PROBE, str(context.database_file(overlap))]
    figures: dict[str, Any] = {}
    for _ in range(2):
        done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603
        if done.returncode != 0:
            raise ReproduceError(f"reproduce: the memory probe failed: {done.stderr.strip()[-300:]}")
        figures = json.loads(done.stdout)
    return {name: np.asarray(value) for name, value in figures.items()}


def _evaluate(context: Context, results: Mapping[str, Results]) -> Outcome:
    lines = []
    for percent in context.parameters["percent"]:
        sizes = results[f"p{percent:g}"]
        lines.append(
            {"percent": percent, **{f"{name}_mb": float(sizes[name]) / 1e6 for name in ("loaded", "peak")}}
        )
    rows = tuple(
        row(
            f"greatest memory of the process, database of {line['percent']:g} %",
            ours=line["peak_mb"],
            unit="MB",
            digits=0,
            at_most=_LIMIT_MB,
            remark=f"{line['loaded_mb']:.0f} MB once the database is loaded and its tree is built",
        )
        for line in lines
    )
    return Outcome(rows, (write_lines(context.folder / "memory.csv", lines),), (_NOTE,))


EXPERIMENTS: Final = (
    Experiment(
        "memory",
        "Memory of the process at run time",
        _parts,
        _compute,
        _evaluate,
        full={"percent": [99.5, 99.75]},
        quick=None,
        alone=True,
        revision=2,
    ),
)
