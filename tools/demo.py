"""Run starhil end to end: the emulator and an OBC as two processes, over a pty and then over CAN.

Prints a table of attitude errors and writes images; the exit status is 0 only if every check passes.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from starhil.hil_tests.errors import BenchError
from starhil.hil_tests.rig.emulator_process import EmulatorProcess, emulator_command
from starhil.hil_tests.timing.figures import percentile
from starid.arithmetic.arrays import Array
from starid.attitude import Attitude

CROSS_LIMIT_ARCSEC = 60.0
ROLL_LIMIT_ARCSEC = 300.0


FEATURES_SESSION = "recursive_features"
"""Session with the thesis's algorithm."""

SESSIONS = {"serial": "demo_serial", "can": "demo_can"}
"""Link, which also names the folder of its logs → session of the OBC over it."""


@dataclass(frozen=True, slots=True)
class Comparison:
    """Errors of the measured attitude in one session; arrays have one entry per frame."""

    cross_arcsec: Array
    roll_arcsec: Array
    rate_deg_s: Array
    reply_ms: Array
    latency_ms: Array
    invalid: int


def read_csv(path: Path) -> np.ndarray[Any, Any]:
    """Read the rows of a CSV file, whose fields are its columns."""
    rows = np.genfromtxt(path, delimiter=",", names=True, dtype=None, encoding="utf-8", comments=None)
    return np.atleast_1d(rows)


def compare(samples: np.ndarray[Any, Any], truth: np.ndarray[Any, Any]) -> Comparison:
    """Compare the samples of the OBC with the emulator's truth log, frame by frame."""
    valid = samples[samples["valid"] == 1]
    frames = valid[np.unique(valid["frame_counter"], return_index=True)[1]]
    true = truth[np.searchsorted(truth["frame"], frames["frame_counter"])]
    errors = [
        Attitude.from_quaternion([measured[f"q_{axis}"] for axis in "xyzw"]).error_to(
            Attitude.from_quaternion([row[f"true_q{axis}"] for axis in "xyzw"])
        )
        for measured, row in zip(frames, true, strict=True)
    ]
    return Comparison(
        np.array([error.cross_boresight_arcsec for error in errors]),
        np.array([error.roll_arcsec for error in errors]),
        np.linalg.norm([frames[f"rate_{axis}"] for axis in "xyz"], axis=0),
        frames["latency_ms"],
        frames["latency"],
        len(samples) - len(valid),
    )


def run_session(link: str, channel: str, out: Path, truth_log: Path) -> bool:
    """Run the session of a link as a separate process; return whether every step passed."""
    folder = out / link
    command = [
        str(Path(sys.executable).with_name("starhil")), "session", SESSIONS[link], f"--{link}", channel,
        "--log", str(folder), "--junit", str(folder / "junit.xml"), "--truth", str(truth_log),
    ]  # fmt: skip
    return subprocess.run(command, check=False).returncode == 0


def run_features(out: Path) -> str | None:
    """Let the thesis's algorithm lose the sky and find it again, with an emulator of its own; return what it did, if it passed."""
    folder = out / "features"
    command = [
        str(Path(sys.executable).with_name("starhil")), "session", FEATURES_SESSION, "--start", "--can", "auto",
        "--log", str(folder),
    ]  # fmt: skip
    if subprocess.run(command, check=False).returncode != 0:
        return None
    images = read_csv(folder / "truth.csv")
    refined = images["refined"] == 1
    region, triggered = (
        np.count_nonzero(refined & rows) for rows in (images["search"] == "rsi", images["triggered"] == 1)
    )
    return (
        f'run.algorithm = "rsi": features found, and stars verified, {np.count_nonzero(refined)} of {len(images)} images, '
        f"with the lens covered in between; {region + triggered} were searched first where the motion of the stars says, "
        f"and {region} were found there"
    )


def first_light(out: Path) -> bool:
    """Write an image of Orion with its identified stars marked; return whether that was possible."""
    folder = Path(sys.executable).parent
    image, marked = out / "orion.png", out / "first_light.png"
    steps = (
        [folder / "starhil", "render", "--profile", "demo", "--ra", "83.8", "--dec", "-1.2", "-o", image],
        [folder / "starid", "identify", image, "--profile", "demo", "-o", marked],
    )
    return all(subprocess.run(step, check=False, stdout=subprocess.DEVNULL).returncode == 0 for step in steps)


def within_limits(comparison: Comparison) -> bool:
    """Whether every sample of a session was valid and within the error limits."""
    return (
        len(comparison.cross_arcsec) > 0
        and comparison.invalid == 0
        and bool(comparison.cross_arcsec.max() <= CROSS_LIMIT_ARCSEC)
        and bool(comparison.roll_arcsec.max() <= ROLL_LIMIT_ARCSEC)
    )


def report(comparisons: dict[str, Comparison], console: Console) -> bool:
    """Print the attitude errors; return whether all are within their limits."""
    table = Table(
        "figure",
        *comparisons,
        title="Errors of the attitude of the ideal sensor, as read by the OBC",
    )
    figures: dict[str, Callable[[Comparison], str]] = {
        "frames": lambda comparison: str(len(comparison.cross_arcsec)),
        "samples without a valid attitude": lambda comparison: str(comparison.invalid),
        "body rate, median, deg/s": lambda comparison: f"{np.median(comparison.rate_deg_s):.3f}",
        "boresight error, median, arcsec": lambda comparison: f"{np.median(comparison.cross_arcsec):.2f}",
        "boresight error, maximum, arcsec": lambda comparison: f"{comparison.cross_arcsec.max():.2f}",
        "roll error, median, arcsec": lambda comparison: f"{np.median(comparison.roll_arcsec):.2f}",
        "roll error, maximum, arcsec": lambda comparison: f"{comparison.roll_arcsec.max():.2f}",
        "mid-exposure to attitude, median, ms": lambda comparison: f"{np.median(comparison.latency_ms):.1f}",
        "request to reply, median, ms": lambda comparison: f"{np.median(comparison.reply_ms):.2f}",
        "request to reply, 99 %, ms": lambda comparison: (
            f"{percentile(comparison.reply_ms.tolist(), 0.99):.2f}"
        ),
        f"within {CROSS_LIMIT_ARCSEC:.0f} and {ROLL_LIMIT_ARCSEC:.0f} arcsec": lambda comparison: (
            "yes" if within_limits(comparison) else "NO"
        ),
    }
    for name, figure in figures.items():
        table.add_row(name, *(figure(comparison) for comparison in comparisons.values()))
    console.print(table)
    return all(within_limits(comparison) for comparison in comparisons.values())


def main() -> int:
    """Run the demo; return 0 if every check passes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--out", type=Path, default=Path("out/demo"), help="folder for logs, tables and images"
    )
    out: Path = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    console = Console(soft_wrap=True)
    truth_log = out / "truth.csv"
    command = emulator_command(
        profile="demo", serial="auto", can="auto", state_dir=out / "state", truth_log=truth_log
    )
    console.print("Starting the emulator; the first start on a machine compiles kernels.")
    begin = time.monotonic()
    try:
        with EmulatorProcess(command) as emulator:
            where = " ".join(f"{key}={value}" for key, value in emulator.ready.items())
            console.print(f"Emulator ready after {time.monotonic() - begin:.1f} s: {where}")
            passed = [run_session(link, emulator.ready[link], out, truth_log) for link in SESSIONS]
    except BenchError as error:
        console.print(f"demo: {error}", style="red")
        return 1
    if not all(passed):
        console.print("demo: a session failed; see its steps above", style="red")
        return 1
    features = run_features(out)
    if features is None:
        console.print("demo: the session with features failed; see its steps above", style="red")
        return 1
    if not first_light(out):
        console.print("demo: the image of Orion was not identified", style="red")
        return 1
    truth = read_csv(truth_log)
    comparisons = {link: compare(read_csv(out / link / "attitude.csv"), truth) for link in SESSIONS}
    good = report(comparisons, console)
    console.print(features)
    console.print(
        f"Open {out / 'first_light.png'}: the sky of the sensor, stretched, with the stars that were identified.\n"
        f"Images that the OBC downloaded: {', '.join(map(str, sorted(out.rglob('image_*.png'))))}; logs in the same folders.\n"
        "They fill 469×469 and 235×235 pixels of the sizes that the unit downloads; the rest is black."
    )
    console.print(
        "Next: .venv/bin/starhil run --serial auto --can off, then open the port of its ready line with your OBC software; "
        "with --view, a page shows its images."
    )
    return 0 if good else 1


if __name__ == "__main__":
    raise SystemExit(main())
