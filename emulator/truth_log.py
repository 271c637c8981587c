"""The truth log: a CSV file with true and measured attitude, one row per exposure."""

from __future__ import annotations

import csv
import errno
import fcntl
import io
import logging
import os
import stat
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final

import numpy as np

from starhil.emulator.clock import NANOSECONDS
from starhil.emulator.device.cycle import Measurement, as_quaternion
from starhil.emulator.errors import EmulatorError
from starid.attitude import Attitude

log = logging.getLogger("starhil.truth")

COLUMNS: Final = (
    "frame", "time_of_exposure_s", "run_time_s", "mode", "valid", "reason",
    "true_qx", "true_qy", "true_qz", "true_qw", "true_wx_deg_s", "true_wy_deg_s", "true_wz_deg_s", "truth_status",
    "measured_qx", "measured_qy", "measured_qz", "measured_qw", "measured_wx_deg_s", "measured_wy_deg_s", "measured_wz_deg_s",
    "cross_boresight_arcsec", "roll_arcsec", "total_arcsec", "sigma_cross_arcsec", "sigma_roll_arcsec",
    "stars_detected", "stars_matched", "rms_px", "latency_ms", "processing_ms", "render_ms", "detect_ms", "identify_ms", "late",
)  # fmt: skip
"""Columns: device time as Unix time, quaternions ICRS→sensor scalar last, errors of the measured attitude.

`latency_ms` is simulation time from mid-exposure to publication. `processing_ms` and the next three columns
are wall times; they are empty on the stepped clock, so that the same run gives the same file.
"""

WALL_TIMES: Final = ("processing_ms", "render_ms", "detect_ms", "identify_ms")


def compare(measurement: Measurement) -> dict[str, Any]:
    """Return truth, measurement and errors by the names in `COLUMNS`; None if invalid."""
    result = measurement.result
    truth = measurement.truth
    row: dict[str, Any] = {
        "frame": measurement.counter,
        "time_of_exposure_s": measurement.mid_unix_ns / NANOSECONDS,
        "run_time_s": measurement.mid_ns / NANOSECONDS,
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
    return {name: row.get(name) for name in COLUMNS}


class TruthLog:
    """A CSV file with one row per exposure; rows are written complete and unbuffered.

    Only one emulator at a time can write to a file. If writing fails, for example because the disk is full, a
    warning is logged, the file ends with the last complete row and the run continues.

    Parameters
    ----------
    path
        The file; created if it does not exist.
    overwrite
        Whether to replace an existing file.
    wall_times
        Whether to fill the columns in `WALL_TIMES`.

    Raises
    ------
    EmulatorError
        The file cannot be created, is not empty, or another emulator writes to it; it is unchanged.
    """

    def __init__(self, path: Path, *, overwrite: bool = False, wall_times: bool = True) -> None:
        self._path = path
        self._empty_columns = () if wall_times else WALL_TIMES
        self._size = 0
        self._file: io.FileIO | None = None
        try:
            self._file = _open(path, overwrite=overwrite)
            self._write_row(COLUMNS)
        except OSError as error:
            self.close()
            raise EmulatorError(
                f"truth log {path}: cannot be written ({error.strerror}); choose another file"
            ) from None

    def write(self, measurement: Measurement) -> None:
        """Write the row of a measurement."""
        if self._file is None:
            return
        try:
            row = compare(measurement) | dict.fromkeys(self._empty_columns)
            self._write_row([_format_cell(name, value) for name, value in row.items()])
        except OSError as error:
            log.warning(
                "truth log %s: cannot be written (%s); it ends before frame %d; the run continues",
                self._path,
                error.strerror,
                measurement.counter,
            )
            self.close()

    def _write_row(self, cells: Iterable[str]) -> None:
        """Write a complete row, or nothing."""
        if self._file is None:
            return
        text = io.StringIO()
        csv.writer(text).writerow(cells)
        row = memoryview(text.getvalue().encode())
        size = len(row)
        try:
            while row:
                written: int | None = self._file.write(row)
                if written is None:  # a character device that would block
                    raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))
                row = row[written:]
        except OSError:
            if stat.S_ISREG(os.fstat(self._file.fileno()).st_mode):
                self._file.truncate(self._size)
            raise
        self._size += size

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()
            self._file = None


def _open(path: Path, *, overwrite: bool) -> io.FileIO:
    """Open and empty a file for one writer; a pipe is rejected, as its reader could block the emulator."""
    flags = os.O_WRONLY | os.O_CREAT | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC
    file = os.fdopen(os.open(path, flags, 0o644), "wb", buffering=0)
    try:
        _lock_and_empty(path, file, overwrite=overwrite)
    except (EmulatorError, OSError):
        file.close()
        raise
    return file


def _lock_and_empty(path: Path, file: io.FileIO, *, overwrite: bool) -> None:
    """Lock a file for this process and empty it; a character device such as /dev/null is not locked."""
    mode = os.fstat(file.fileno()).st_mode
    if stat.S_ISCHR(mode):
        return
    if not stat.S_ISREG(mode):
        raise EmulatorError(f"truth log {path}: not a regular file; choose another file")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise EmulatorError(f"truth log {path}: in use by another emulator; choose another file") from None
    if os.fstat(file.fileno()).st_size and not overwrite:
        raise EmulatorError(
            f"truth log {path}: exists and is not empty; choose another file, or replace it with --overwrite"
        )
    file.truncate()


def _format_cell(name: str, value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return str(int(value))
    if isinstance(value, float):
        exact = (
            name.startswith(("true_q", "measured_q"))
            or name.endswith("time_s")
            or name == "time_of_exposure_s"
        )
        return repr(value) if exact else f"{value:.6g}"
    return str(value)
