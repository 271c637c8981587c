"""Reader of the truth log of an emulator (`starhil run --truth-log`), also while it is being written."""

from __future__ import annotations

import bisect
import csv
import io
from pathlib import Path
from typing import Final

from starhil.hil_tests.attitude import Quaternion, interpolate, unit
from starhil.hil_tests.errors import BenchError
from starhil.protocol.files.user_file import read_user_text

TIME_COLUMN: Final = "time_of_exposure_s"
QUATERNION_COLUMNS: Final = ("true_qx", "true_qy", "true_qz", "true_qw")
MAX_BYTES: Final = 256_000_000
"""Size limit of a truth log, bytes."""
SLACK_S: Final = 0.0005
"""Tolerance outside the times of the file, s: telemetry is rounded."""


class TruthLogReader:
    """True attitudes over device time.

    The file is CSV, with a column of times (device clock, seconds since 1970-01-01 UTC) and four of the quaternion.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._times: list[float] = []
        self._attitudes: list[Quaternion] = []
        self._last: Quaternion | None = None

    def at(self, time_s: float) -> Quaternion:
        """Return the attitude at a device time, interpolated by the shortest rotation.

        Raises BenchError: the file cannot be read, lacks a column, or does not cover the time.
        """
        if not self._covers(time_s):
            self.check()
        if not self._covers(time_s):
            span = f"{self._times[0]:.3f} to {self._times[-1]:.3f} s" if self._times else "nothing"
            raise BenchError(f"{self._path}: has no truth for the time {time_s:.3f} s; it covers {span}")
        time_s = min(max(time_s, self._times[0]), self._times[-1])
        after = bisect.bisect_left(self._times, time_s)
        if after == 0:
            return self._attitudes[0]
        begin, end = self._times[after - 1], self._times[after]
        return interpolate(
            self._attitudes[after - 1], self._attitudes[after], (time_s - begin) / (end - begin)
        )

    def latest(self) -> Quaternion:
        """Return the attitude in the last complete line.

        Raises BenchError: the file cannot be read, lacks a column, or has no line yet.
        """
        self.check()
        if self._last is None:
            raise BenchError(f"{self._path}: has no truth yet")
        return self._last

    def _covers(self, time_s: float) -> bool:
        return bool(self._times) and self._times[0] - SLACK_S <= time_s <= self._times[-1] + SLACK_S

    def check(self) -> None:
        """Read the file; raise BenchError if it cannot be read or lacks a column. It may have no line yet."""
        try:
            text = read_user_text(self._path, MAX_BYTES)
        except OSError as error:
            raise BenchError(f"{self._path}: the truth cannot be read: {error.strerror}") from None
        except UnicodeDecodeError as error:
            raise BenchError(f"{self._path}: the truth cannot be read: not UTF-8, {error.reason}") from None
        rows = csv.DictReader(io.StringIO(text, newline=""))
        if rows.fieldnames is None:
            return
        missing = [name for name in (TIME_COLUMN, *QUATERNION_COLUMNS) if name not in rows.fieldnames]
        if missing:
            raise BenchError(f"{self._path}: no column {', '.join(missing)} in its first line")
        pairs: dict[float, Quaternion] = {}
        for row in rows:
            try:
                values = [float(row[name]) for name in QUATERNION_COLUMNS]
                pairs[float(row[TIME_COLUMN])] = self._last = unit(values)
            except (TypeError, ValueError):
                continue  # the last line is still being written
        self._times = sorted(pairs)
        self._attitudes = [pairs[time_s] for time_s in self._times]
