"""Memory of a process that identifies with the largest database."""

from __future__ import annotations

import json
import subprocess
import sys
from typing import Final

import numpy as np

from starid.lab.experiments.comparison import ReproduceError
from starid.lab.experiments.experiment import Context, Evaluation, Part, Results

_LIMIT_MB: Final = 400.0
_PROBE: Final = "starid.lab.experiments.memory_probe"


def compute(context: Context, part: Part) -> Results:
    """Sizes that the probe reports; it is run twice, to leave out the compilation."""
    overlap = part.values["percent"] / 100.0
    context.database(overlap)
    command = [sys.executable, "-m", _PROBE, str(context.database_file(overlap))]
    for _ in range(2):
        done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603
        if done.returncode != 0:
            raise ReproduceError(f"reproduce: the memory probe failed: {done.stderr.strip()[-300:]}")
    return {name: np.asarray(value) for name, value in json.loads(done.stdout).items()}


def evaluate(e: Evaluation) -> None:
    """Bounds on the greatest memory."""
    lines = []
    for percent in e.parameters["percent"]:
        loaded, peak = (1e-6 * float(e.results[f"p{percent:g}"][name]) for name in ("loaded", "peak"))
        lines.append({"percent": percent, "loaded_mb": loaded, "peak_mb": peak})
        e.compare(
            f"greatest memory of the process, database of {percent:g} %",
            ours=peak,
            unit="MB",
            digits=0,
            check=f"≤ {_LIMIT_MB}",
            remark=f"{loaded:.0f} MB once the database is loaded and its tree is built",
        )
    e.write("memory.csv", lines)
