"""Reference frames, dates and rates as standard files name them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import lru_cache
from pathlib import Path
from typing import Final

import numpy as np

from starhil.emulator.errors import EmulatorError
from starhil.emulator.truth.feed_rates import FeedError, FeedRates
from starhil.emulator.truth.orbit import OrbitState
from starhil.emulator.truth.source import Vector
from starhil.emulator.truth.table import FileTruth, OrbitTable
from starid.attitude import Attitude
from starid.earth import utc_of_tai

NANOSECONDS: Final = 1_000_000_000
ICRS_NAMES: Final = ("ICRF", "ICRF1", "ICRF2", "ICRF3", "GCRF", "ICRS", "GCRS")
J2000_NAMES: Final = ("EME2000", "J2000")
"""Mean equator and equinox of J2000, which differ from ICRS by the frame bias of 23 milliarcseconds."""

TAI_MINUS: Final = {"TAI": 0.0, "TT": 32.184, "TDT": 32.184, "TDB": 32.184, "GPS": -19.0}
"""Label of a time scale minus TAI, seconds; TDB is within 2 ms of TT."""

MAX_METRES: Final = 1e12
"""Largest distance in an orbit file, m, and speed, m/s."""

MONTHS: Final = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")
_CALENDAR: Final = re.compile(
    r"(?P<year>\d{4})-(?:(?P<month>\d\d)-(?P<day>\d\d)|(?P<of_year>\d{3}))T(?P<clock>\d\d:\d\d:\d\d)(?P<rest>\.\d*)?Z?"
)
_STK_DATE: Final = re.compile(
    r"(?P<day>\d{1,2}) (?P<month>[a-z]{3}) (?P<year>\d{4}) (?P<clock>\d{1,2}:\d\d:\d\d)(?P<rest>\.\d*)?"
)


@dataclass(frozen=True, slots=True)
class Row:
    """A row of a file with dates: attitude ICRS→body, body rate in rad/s, position and velocity in GCRS."""

    unix_ns: int
    attitude: Attitude
    rate_rad_s: Vector | None = None
    orbit: OrbitState | None = None


@lru_cache
def icrs_to(where: str, frame: str) -> Attitude:
    """Return the rotation from ICRS to an inertial frame; EmulatorError names one that is not known."""
    import erfa

    if frame.upper() in ICRS_NAMES:
        return Attitude.identity()
    if frame.upper() in J2000_NAMES:
        return Attitude.from_matrix(erfa.bp06(2_451_545.0, 0.0)[0])
    known = ", ".join((*ICRS_NAMES, *J2000_NAMES))
    raise EmulatorError(f"{where}: frame {frame[:40]!r} is not known; known: {known}")


def is_inertial(frame: str) -> bool:
    """Whether a frame is one of those that `icrs_to` knows."""
    return frame.upper() in (*ICRS_NAMES, *J2000_NAMES)


def unix_ns(where: str, text: str, scale: str = "UTC") -> int:
    """Return the Unix time of a date, nanoseconds: ISO 8601 with month or day of year, or as STK writes it."""
    found = _CALENDAR.fullmatch(text) or _STK_DATE.fullmatch(text.lower())
    day: dict[str, str | None] = {} if found is None else found.groupdict()
    try:
        hours, minutes, seconds = (int(part) for part in (day.get("clock") or "").split(":"))
        month = day["month"] or "1"
        number = MONTHS.index(month) + 1 if month.isalpha() else int(month)
        begin = datetime(int(day["year"] or 0), number, int(day["day"] or 1), tzinfo=UTC)
        begin += timedelta(days=int(day.get("of_year") or 1) - 1)
    except ValueError:
        raise EmulatorError(f"{where}: not a date, e.g. 2026-03-20T12:00:00.0") from None
    whole = int(begin.timestamp()) + 3600 * hours + 60 * minutes + seconds
    label_ns = whole * NANOSECONDS + int(((day["rest"] or ".")[1:] + "0" * 9)[:9])
    if scale.upper() == "UTC":
        return label_ns
    if scale.upper() not in TAI_MINUS:
        known = ", ".join(("UTC", *TAI_MINUS))
        raise EmulatorError(f"{where}: time system {scale[:40]!r} is not known; known: {known}")
    tai_s = whole - TAI_MINUS[scale.upper()]
    return label_ns + round((utc_of_tai(tai_s) - whole) * NANOSECONDS)


def truth_of(path: Path, blocks: Sequence[Sequence[Row]], *, smooth: bool) -> FileTruth:
    """Return the truth of the rows of a file, in blocks of continuous motion; a block may begin where the last one ends.

    EmulatorError if dates do not increase, or rates contradict attitudes: the quaternion has the wrong sense.
    """
    rows: list[Row] = []
    for number, block in enumerate(blocks, 1):
        where = f"truth file {path}, block {number}"
        if rows and block and block[0].unix_ns == rows[-1].unix_ns:
            rows.pop()
        check = FeedRates(timed=True)
        for row in block:
            if rows and row.unix_ns <= rows[-1].unix_ns:
                raise EmulatorError(f"{where}: a date is not later than the one before")
            rows.append(row)
            try:
                check.body_rate((row.unix_ns - rows[0].unix_ns) / NANOSECONDS, row.attitude, row.rate_rad_s)
            except FeedError as error:
                fault = str(error).partition("; ")[0].replace("q,", "the quaternion,")
                raise EmulatorError(
                    f"{where}, row {len(rows)}: {fault}; its sense or its frames are wrong"
                ) from None
    if not rows:
        raise EmulatorError(f"truth file {path}: no rows")
    rates = [row.rate_rad_s for row in rows if row.rate_rad_s is not None]
    orbit = [row.orbit for row in rows if row.orbit is not None]
    return FileTruth(
        np.array([row.unix_ns - rows[0].unix_ns for row in rows]) / NANOSECONDS,
        [row.attitude for row in rows],
        np.array(rates) if len(rates) == len(rows) else None,
        orbit if len(orbit) == len(rows) else None,
        smooth=smooth,
        start_unix_s=rows[0].unix_ns / NANOSECONDS,
    )


def orbit_of_rows(
    path: Path, frame: Attitude, dates_ns: Sequence[int], rows_m: Sequence[Sequence[float]]
) -> OrbitTable:
    """Return the orbit of rows of x, y, z, vx, vy, vz (m, m/s) in the frame to which `frame` turns ICRS."""
    times = np.array(dates_ns, dtype=np.float64) / NANOSECONDS
    values = np.array(rows_m, dtype=np.float64)
    if not len(times) or not (np.diff(times) > 0.0).all():
        raise EmulatorError(f"orbit file {path}: has no rows, or a date is not later than the one before")
    if np.abs(values).max() > MAX_METRES:
        raise EmulatorError(f"orbit file {path}: a number is outside ±{MAX_METRES:g}")
    turned = [frame.to_icrs(values[:, first : first + 3]) for first in (0, 3)]
    return OrbitTable(path, times, [OrbitState(*pair) for pair in zip(*turned, strict=True)])


def body_attitude(icrs_to_reference: Attitude, reference_to_body: Attitude) -> Attitude:
    """Return the attitude ICRS→body."""
    return Attitude.from_matrix(reference_to_body.matrix @ icrs_to_reference.matrix)


def inverse(rotation: Attitude) -> Attitude:
    """Return the inverse of a rotation."""
    return Attitude(rotation.quaternion_xyzw * [-1.0, -1.0, -1.0, 1.0])


def euler_turn(where: str, sequence: str, angles_deg: Vector) -> Attitude:
    """Return the rotation by successive turns of the frame about its axes: XYZ, or digits."""
    axes = [{"1": 0, "2": 1, "3": 2, "X": 0, "Y": 1, "Z": 2}.get(letter.upper(), -1) for letter in sequence]
    if len(axes) != 3 or -1 in axes:
        raise EmulatorError(f"{where}: {sequence[:40]!r} is not a sequence of three axes")
    turn = Attitude.identity()
    for axis, angle in zip(axes, np.radians(angles_deg), strict=True):
        turn = turn.rotated(angle * np.eye(3)[axis])
    return turn
