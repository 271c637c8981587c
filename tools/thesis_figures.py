"""Print the figures of the thesis that the sessions `thesis_recognition` and `thesis_recursion` measured over the bus.

Each file of samples holds the rows `feature_identification` of one condition; the truth log of the session, in the same
folder, has the true attitudes and which detections were false stars.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path
from typing import Any, Final

import numpy as np
from rich.console import Console
from rich.table import Table

from starid.attitude import Attitude

CONDITIONS: Final = ("clean", "noise1", "noise2", "noise3", "false", "noise", "both")
IDENTIFIED_DEG: Final = 0.3
"""Error of the boresight that the thesis counts as identified."""
TAU: Final = 0.5
"""The threshold τ of profile `thesis`, the smaller one of the thesis."""


def read(path: Path) -> list[dict[str, str]]:
    """Read the rows of a CSV file."""
    with path.open(newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def true_attitude(row: dict[str, str]) -> Attitude:
    """Return the true attitude of a row of the truth log."""
    return Attitude.from_quaternion([float(row[f"true_q{axis}"]) for axis in "xyzw"])


def figures(samples: list[dict[str, str]], truth: dict[str, dict[str, str]]) -> dict[str, Any]:
    """Return the figures of one condition."""
    over_bus = {row["frame_counter"]: row for row in samples}
    images = [(truth[frame], row) for frame, row in over_bus.items() if frame in truth]
    errors = np.array(
        [float(row["cross_boresight_arcsec"]) for row, _ in images if row["cross_boresight_arcsec"]]
    )
    turns, shifts = [], []
    for row, sent in images:
        before = truth.get(str(int(row["frame"]) - 1))
        if before is None or float(sent["translation"]) == 0.0:
            continue
        motion = true_attitude(row).matrix @ true_attitude(before).matrix.T
        turns.append(
            float(sent["rotation"])
            - np.degrees(np.arctan2(motion[1, 0] - motion[0, 1], motion[0, 0] + motion[1, 1]))
        )
        shifts.append(
            float(sent["translation"])
            - np.degrees(np.arctan2(np.hypot(motion[0, 2], motion[1, 2]), motion[2, 2]))
        )
    kept = sum(int(sent["stars"]) for _, sent in images)
    removed = sum(int(sent["removed"]) for _, sent in images)
    false, caught = (sum(int(row[name]) for row, _ in images) for name in ("false_detected", "false_removed"))
    right = kept - (false - caught)
    return {
        "images": len(images),
        "with an attitude": len(errors),
        f"within {IDENTIFIED_DEG}°, %": 100.0
        * np.count_nonzero(errors <= 3600.0 * IDENTIFIED_DEG)
        / len(images),
        "median error, °": np.median(errors) / 3600.0 if len(errors) else np.nan,
        "filter: recall, %": 100.0 * right / (right + removed - caught) if kept else np.nan,
        "filter: precision, %": 100.0 * right / kept if kept else np.nan,
        "false stars removed, %": 100.0 * caught / false if kept and false else np.nan,
        "motion: rotation, median error, °": np.median(np.abs(turns)) if turns else np.nan,
        "motion: translation, median error, °": np.median(np.abs(shifts)) if shifts else np.nan,
        "answer from the region, %": 100.0 * np.mean([int(sent["region_searched"]) for _, sent in images]),
        "whole database searched after the region, %": 100.0
        * np.mean([int(sent["triggered"]) for _, sent in images]),
        f"ε_ψ > {TAU:g}, %": 100.0 * np.mean([float(sent["error_psi"]) > TAU for _, sent in images]),
        "time of identification, median, ms": np.median([float(row["identify_ms"]) for row, _ in images]),
    }


def main() -> None:
    """Print a table with one column per condition."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="log folder of the session")
    folder: Path = parser.parse_args().folder
    truth = {row["frame"]: row for row in read(folder / "truth.csv")}
    columns = {
        name: figures(read(path), truth) for name in CONDITIONS if (path := folder / f"{name}.csv").exists()
    }
    table = Table("figure", *columns)
    for name in next(iter(columns.values())):
        table.add_row(name, *(f"{column[name]:.4g}" for column in columns.values()))
    Console(soft_wrap=True).print(table)


if __name__ == "__main__":
    main()
