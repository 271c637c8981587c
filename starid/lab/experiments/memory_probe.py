"""A separate process that loads a database, identifies with it, and prints how much memory it took."""

from __future__ import annotations

import json
import resource
import sys
from pathlib import Path

import numpy as np


def peak_bytes() -> int:
    """Peak resident size of this process, bytes.

    Linux does not count the process from which it was forked, as `getrusage` does.
    """
    status = Path("/proc/self/status")
    if status.exists():
        lines = dict(line.split(":", 1) for line in status.read_text(encoding="ascii").splitlines())
        return 1024 * int(lines["VmHWM"].split()[0])
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak


def main(path: Path) -> None:
    """Solve frames all over the sky lost in space, then follow a sequence with the recursive algorithm."""
    from starid.lab.simulation import NoiseModel, sky_sequence
    from starid.thesis.database_file import load_database
    from starid.thesis.lsi import LostInSpace
    from starid.thesis.rsi import RecursiveIdentification, RsiSettings
    from starid.thesis.scalable_filter import TrackFilter

    lsi = LostInSpace(load_database(path))
    sky = lsi.database.sky
    loaded = peak_bytes()
    for ra in np.arange(0.05, 360.0, 4.0):
        for dec in (-60.0, 0.0, 60.0):
            lsi.solve(sky.features(float(ra), dec))
    recursion = RecursiveIdentification(lsi, TrackFilter(), RsiSettings(memory=15))
    for frame in sky_sequence(
        np.random.default_rng(1), sky, 108.41, 12.14, NoiseModel(), count=100, wander=True
    ):
        recursion.step(frame.observed)
    print(json.dumps({"loaded": loaded, "peak": peak_bytes()}))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
