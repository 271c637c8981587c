"""The truth log: a CSV file with true and measured attitude, one row per exposure."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final

import numpy as np

from starhil.emulator.device.measurement import Measurement
from starhil.emulator.sensor.pipeline.messages import as_quaternion
from starhil.emulator.simulation.output_file import Output, OutputFile
from starhil.protocol.icd.conventions import NANOSECONDS
from starid.attitude import Attitude

COLUMNS: Final = (
    "frame", "time_of_exposure_s", "run_time_s", "mode", "valid", "reason",
    "true_qx", "true_qy", "true_qz", "true_qw", "true_wx_deg_s", "true_wy_deg_s", "true_wz_deg_s", "truth_status",
    "measured_qx", "measured_qy", "measured_qz", "measured_qw", "measured_wx_deg_s", "measured_wy_deg_s", "measured_wz_deg_s",
    "cross_boresight_arcsec", "roll_arcsec", "total_arcsec", "sigma_cross_arcsec", "sigma_roll_arcsec",
    "stars_detected", "stars_matched", "rms_px", "latency_ms", "processing_ms", "render_ms", "detect_ms", "identify_ms", "late",
    "search", "triggered", "error_psi", "cell", "weights", "region_deg", "stars_used", "stars_removed", "motion_rotation_deg",
    "motion_translation_deg", "refined", "false_detected", "false_removed", "clock_error_s",
)  # fmt: skip
"""Columns: device time as Unix time, quaternions ICRS→sensor scalar last, errors of the measured attitude.

`latency_ms` is simulation time from mid-exposure to publication. `processing_ms` and the next three columns
are wall times; they are empty on the stepped clock, so that the same run gives the same file. The columns from
`search` to `false_removed` are those of `starid.identification.solution.FeatureReport`, and the false stars among the detections and among
those that the filter removed; they are empty for `geometric`.
"""

WALL_TIMES: Final = ("processing_ms", "render_ms", "detect_ms", "identify_ms")


_DIGITS: Final = 6
"""Significant digits of a float, except in columns that are written exactly."""


def _is_exact(name: str) -> bool:
    """Return whether the floats of a column are written with all digits: quaternions and simulation times."""
    return (
        name.startswith(("true_q", "measured_q"))
        or name.endswith(("time_s", "clock_error_s"))
        or name == "time_of_exposure_s"
    )


def resolution(name: str) -> float:
    """Return the resolution of a computed column, in its unit; 0 for one whose values are exactly defined.

    Two machines may differ by less, because their C libraries round sines and exponentials differently.
    """
    if name.startswith(("true_q", "measured_q")):
        return 1e-10  # 0.00004 arcseconds
    if name.endswith("_deg_s"):
        return 1e-7
    return 1e-4 if name.endswith("_arcsec") else 1e-6 if name == "rms_px" else 0.0


def equal_cells(name: str, one: str, other: str) -> bool:
    """Return whether two cells of a column are equal to its resolution, or to one unit of their last digit."""
    step = resolution(name)
    if one == other or not step:
        return one == other
    try:
        values = float(one), float(other)
    except (TypeError, ValueError):
        return False
    return math.isclose(*values, rel_tol=0.0 if _is_exact(name) else 10.0 ** (1 - _DIGITS), abs_tol=step)


def compare(measurement: Measurement) -> dict[str, Any]:
    """Return truth, measurement and errors by the names in `COLUMNS`; None if invalid."""
    result = measurement.result
    truth = measurement.truth
    row: dict[str, Any] = {
        "frame": measurement.counter,
        "time_of_exposure_s": measurement.mid_unix_ns / NANOSECONDS,
        "run_time_s": measurement.mid_ns / NANOSECONDS,
        "clock_error_s": measurement.clock_error_ns / NANOSECONDS,
        "mode": measurement.mode.value,
        "valid": measurement.valid,
        "reason": measurement.reason,
        "truth_status": truth.status.value,
        "stars_detected": result.detected,
        "stars_matched": result.matched,
        "latency_ms": measurement.latency_s * 1e3,
        "processing_ms": (result.render_s + result.detect_s + result.identify_s) * 1e3,
        "render_ms": result.render_s * 1e3,
        "detect_ms": result.detect_s * 1e3,
        "identify_ms": result.identify_s * 1e3,
        "late": measurement.late,
    }
    row |= zip(("true_qx", "true_qy", "true_qz", "true_qw"), as_quaternion(truth.attitude), strict=True)
    true_rate = np.degrees(truth.rate_rad_s).tolist()
    row |= zip(("true_wx_deg_s", "true_wy_deg_s", "true_wz_deg_s"), true_rate, strict=True)
    if measurement.rate_valid:
        rate = np.degrees(measurement.rate_rad_s).tolist()
        row |= zip(("measured_wx_deg_s", "measured_wy_deg_s", "measured_wz_deg_s"), rate, strict=True)
    if measurement.valid:
        measured = Attitude(np.array(result.quaternion_xyzw))
        error = measured.error_to(truth.attitude)
        row |= zip(
            ("measured_qx", "measured_qy", "measured_qz", "measured_qw"), as_quaternion(measured), strict=True
        )
        row |= {
            "cross_boresight_arcsec": error.cross_boresight_arcsec,
            "roll_arcsec": error.roll_arcsec,
            "total_arcsec": error.total_arcsec,
            "sigma_cross_arcsec": result.sigma_cross_arcsec,
            "sigma_roll_arcsec": result.sigma_roll_arcsec,
            "rms_px": result.rms_px,
        }
    if result.features is not None:
        features = result.features
        row |= {
            "search": features.search,
            "triggered": features.triggered,
            "error_psi": None if math.isnan(features.error_psi) else features.error_psi,
            "cell": features.cell,
            "weights": features.weights,
            "region_deg": features.region_deg,
            "stars_used": features.stars,
            "stars_removed": features.removed,
            "motion_rotation_deg": features.rotation_deg,
            "motion_translation_deg": features.translation_deg,
            "refined": features.refined,
            "false_detected": result.false_detected,
            "false_removed": result.false_removed,
        }
    return {name: row.get(name) for name in COLUMNS}


class TruthLog:
    """A CSV file with one row per exposure; rows are written complete and unbuffered.

    The columns in `WALL_TIMES` are filled if `wall_times`. `output` is the recording of which the file is a part, if
    any.
    """

    def __init__(
        self, path: Path, *, overwrite: bool = False, wall_times: bool = True, output: Output | None = None
    ) -> None:
        self._empty_columns = () if wall_times else WALL_TIMES
        self.file = OutputFile("truth log", path, header=_as_csv(COLUMNS), overwrite=overwrite, output=output)
        self.close = self.file.close

    def write(self, measurement: Measurement) -> None:
        self.file.append(lambda: self._row(measurement))

    def _row(self, measurement: Measurement) -> bytes:
        row = compare(measurement) | dict.fromkeys(self._empty_columns)
        return _as_csv(_format_cell(name, value) for name, value in row.items())


def _as_csv(cells: Iterable[str]) -> bytes:
    text = io.StringIO()
    csv.writer(text).writerow(cells)
    return text.getvalue().encode()


def _format_cell(name: str, value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return str(int(value))
    if isinstance(value, float):
        return repr(value) if _is_exact(name) else f"{value:.{_DIGITS}g}"
    return str(value)
