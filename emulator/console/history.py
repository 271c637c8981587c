"""The numbers of each published frame, and of changes to a mode without frames, and their history of an hour."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from starhil.emulator.device.measurement import Measurement
from starhil.emulator.device.modes import Mode
from starhil.protocol.icd.conventions import NANOSECONDS
from starid.attitude import ARCSEC_PER_RAD, Attitude

COLUMNS: Final = (
    "run_s", "unix_s", "frame", "mode", "valid",
    "error_x", "error_y", "error_roll", "error_cross", "sigma_cross", "sigma_roll",
    "rate_x", "rate_y", "rate_z", "true_rate_x", "true_rate_y", "true_rate_z",
    "detected", "matched", "render_ms", "detect_ms", "identify_ms", "latency_ms",
    "qx", "qy", "qz", "qw", "ra", "dec", "roll", "true_ra", "true_dec", "true_roll", "reason",
)  # fmt: skip
"""Columns of a row, in `UNITS`.

`mode` is an index into `MODES`, `reason` an index into the `reasons` of the history. NaN: unknown. A row without a
`frame` is a change to a mode without frames.
"""

UNITS: Final = {
    **dict.fromkeys(("run_s", "unix_s"), "s"),
    **dict.fromkeys(
        ("error_x", "error_y", "error_roll", "error_cross", "sigma_cross", "sigma_roll"), "arcsec"
    ),
    **dict.fromkeys(("rate_x", "rate_y", "rate_z", "true_rate_x", "true_rate_y", "true_rate_z"), "deg/s"),
    **dict.fromkeys(("render_ms", "detect_ms", "identify_ms", "latency_ms"), "ms"),
    **dict.fromkeys(("ra", "dec", "roll", "true_ra", "true_dec", "true_roll"), "deg"),
}
"""Unit of each column that has one."""

MODES: Final = tuple(mode.value for mode in Mode)

NO_FRAMES: Final = "no_images"
"""Reason why the attitude is not valid in a mode without frames."""

TIMES: Final = 2
"""Number of leading columns that are times, which a page is sent in double precision; the others are in single precision."""

KEPT_ROWS: Final = 36_000
"""Number of rows in the history: an hour at 10 Hz."""

Numbers = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Image:
    """An image for pages, as JPEG, and its description with the overlay: JSON without the outer braces."""

    description: str
    jpeg: bytes


class History:
    """The latest rows, oldest first, in memory of fixed size."""

    def __init__(self, kept: int = KEPT_ROWS) -> None:
        self._rows: Numbers = np.zeros((kept, len(COLUMNS)))
        self._count = 0
        self.reasons: list[str] = []
        """Reasons that have occurred; the column `reason` is an index into this list."""

    def add(self, measurement: Measurement) -> list[float]:
        return self._keep(self._row(measurement))

    def add_mode(self, mode: Mode, run_s: float, unix_s: float) -> list[float]:
        """Add a row for a change to a mode without frames, and return it."""
        known = {"run_s": run_s, "unix_s": unix_s, "mode": MODES.index(mode.value), "valid": 0.0}
        known["reason"] = self._reason(NO_FRAMES)
        return self._keep([known.get(name, math.nan) for name in COLUMNS])

    def _keep(self, row: list[float]) -> list[float]:
        self._rows[self._count % len(self._rows)] = row
        self._count += 1
        return row

    def __len__(self) -> int:
        return min(self._count, len(self._rows))

    @property
    def end(self) -> int:
        """Number of rows ever added, and of the next one."""
        return self._count

    @property
    def start(self) -> int:
        """Number of the first row that is kept."""
        return self._count - len(self)

    def rows(self, numbers: range) -> Numbers:
        """Return a copy of rows (n, columns) that are kept."""
        return self._rows[np.array(numbers, dtype=np.int64) % len(self._rows)]

    def block(self, numbers: range) -> bytes:
        """Return rows for a page, little-endian: the times of all rows (f64), then their other columns (f32)."""
        rows = self.rows(numbers)
        return rows[:, :TIMES].astype("<f8").tobytes() + rows[:, TIMES:].astype("<f4").tobytes()

    def _row(self, measurement: Measurement) -> list[float]:
        result, truth = measurement.result, measurement.truth
        error = measured = [math.nan] * 3
        cross = sigma_cross = sigma_roll = math.nan
        quaternion = [math.nan] * 4
        if measurement.valid:
            attitude = Attitude(np.array(result.quaternion_xyzw))
            difference = attitude.error_to(truth.attitude)
            error = (difference.rotation_vector_rad * ARCSEC_PER_RAD).tolist()
            cross = difference.cross_boresight_arcsec
            sigma_cross, sigma_roll = result.sigma_cross_arcsec, result.sigma_roll_arcsec
            quaternion = attitude.quaternion_xyzw.tolist()
            measured = [attitude.ra_deg, attitude.dec_deg, attitude.roll_deg]
        rate = np.degrees(measurement.rate_rad_s).tolist() if measurement.rate_valid else [math.nan] * 3
        return [
            measurement.mid_ns / NANOSECONDS,
            measurement.mid_unix_ns / NANOSECONDS,
            measurement.counter,
            MODES.index(measurement.mode.value),
            measurement.valid,
            *error,
            cross,
            sigma_cross,
            sigma_roll,
            *rate,
            *np.degrees(truth.rate_rad_s).tolist(),
            result.detected,
            result.matched,
            result.render_s * 1e3,
            result.detect_s * 1e3,
            result.identify_s * 1e3,
            measurement.latency_s * 1e3,
            *quaternion,
            *measured,
            truth.attitude.ra_deg,
            truth.attitude.dec_deg,
            truth.attitude.roll_deg,
            self._reason(measurement.reason),
        ]

    def _reason(self, reason: str) -> int:
        """Return the index of a reason, which is added if it is new."""
        if reason not in self.reasons:
            self.reasons.append(reason)
        return self.reasons.index(reason)


def json_row(row: Iterable[float]) -> list[float | None]:
    """Return a row for JSON, with None for NaN."""
    return [value if math.isfinite(value) else None for value in map(float, row)]


def image_of(measurement: Measurement, number: int, row: list[float]) -> Image | None:
    """Return the image of a measurement for pages, with the number and the content of its row; None if there is none."""
    preview = measurement.result.preview
    if preview is None:
        return None
    numbers = {
        "n": number,
        "row": json_row(row),
        "late": measurement.late,
        "rejected": measurement.result.refused,
        "true_q": measurement.truth.attitude.quaternion_xyzw.tolist(),
    }
    overlay = preview.overlay.decode().strip()[1:-1]
    description = json.dumps(numbers)[1:-1] + (f", {overlay}" if overlay else "")
    return Image(description, preview.jpeg)
