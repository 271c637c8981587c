"""Memory of a process that identifies with the largest database: this module, run with its file."""

from __future__ import annotations

import json
import resource
import subprocess
import sys
from pathlib import Path
from typing import Final

import numpy as np

from starid.identification.thesis.database_file import load_database
from starid.identification.thesis.lsi import LostInSpace
from starid.identification.thesis.rsi import RecursiveIdentification, RsiSettings
from starid.identification.thesis.scalable_filter import TrackFilter
from starid.lab.experiments.comparison import ReproduceError
from starid.lab.experiments.experiment import Context, Evaluation, Part, Results
from starid.lab.experiments.rsi_trials import START
from starid.lab.simulation import NoiseModel, sky_sequence

_LIMIT_MB: Final = 400.0


def compute(context: Context, part: Part) -> Results:
    """Sizes that a separate process prints; it is run twice, to leave out the compilation."""
    overlap = part["percent"] / 100.0
    context.database(overlap)
    command = [sys.executable, "-P", "-m", __name__, str(context.database_file(overlap))]
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


def _peak_bytes() -> int:
    """Peak resident size of this process, bytes.

    Linux does not count the process from which it was forked, as `getrusage` does.
    """
    status = Path("/proc/self/status")
    if status.exists():
        lines = dict(line.split(":", 1) for line in status.read_text(encoding="ascii").splitlines())
        return 1024 * int(lines["VmHWM"].split()[0])
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak


def _identify(path: Path) -> None:
    """Solve frames all over the sky lost in space, then a sequence with the recursive algorithm; print the sizes."""
    lsi = LostInSpace(load_database(path))
    sky = lsi.database.sky
    loaded = _peak_bytes()
    for ra in np.arange(0.05, 360.0, 4.0):
        for dec in (-60.0, 0.0, 60.0):
            lsi.solve(sky.features(float(ra), dec))
    recursion = RecursiveIdentification(lsi, TrackFilter(), RsiSettings(memory=15))
    for frame in sky_sequence(np.random.default_rng(1), sky, *START, NoiseModel(), count=100, wander=True):
        recursion.step(frame.observed)
    print(json.dumps({"loaded": loaded, "peak": _peak_bytes()}))


if __name__ == "__main__":
    _identify(Path(sys.argv[1]))
