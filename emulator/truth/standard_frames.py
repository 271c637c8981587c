"""Reference frames, dates and rates as standard files name them."""

from __future__ import annotations

from calendar import timegm
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from time import strptime
from typing import TYPE_CHECKING, Final

import numpy as np

from starhil.emulator.errors import EmulatorError
from starhil.emulator.truth.feed_rates import FeedError, FeedRates
from starhil.emulator.truth.orbit import OrbitState
from starhil.emulator.truth.source import Vector
from starhil.emulator.truth.table import FileTruth, OrbitTable
from starid.arrays import Array
from starid.attitude import Attitude
from starid.earth import utc_of_tai

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

NANOSECONDS: Final = 1_000_000_000
ICRS_NAMES: Final = ("ICRF", "ICRF1", "ICRF2", "ICRF3", "GCRF", "ICRS", "GCRS")
J2000_NAMES: Final = ("EME2000", "J2000")
"""Mean equator and equinox of J2000, which differ from ICRS by the frame bias of 23 milliarcseconds."""

TAI_MINUS: Final = {"TAI": 0.0, "TT": 32.184, "TDT": 32.184, "TDB": 32.184, "GPS": -19.0}
"""Label of a time scale minus TAI, seconds; TDB is within 2 ms of TT."""

MAX_METRES: Final = 1e12
"""Largest distance in an orbit file, m, and speed, m/s."""

DATES: Final = ("%Y-%m-%dT%H:%M:%S", "%Y-%jT%H:%M:%S", "%d %b %Y %H:%M:%S")
"""ISO 8601 with month or day of year, and STK's."""


@dataclass(frozen=True, slots=True)
class Row:
    """A row of a file with dates: attitude ICRS→body, body rate in rad/s, position and velocity in GCRS."""

    unix_ns: int
    attitude: Attitude
    rate_rad_s: Vector | None = None
    orbit: OrbitState | None = None


@lru_cache
def icrs_to(where: str, frame: str) -> Rotation:
    """Return the rotation from ICRS to an inertial frame; EmulatorError names one that is not known."""
    import erfa
    from scipy.spatial.transform import Rotation

    if frame.upper() in ICRS_NAMES:
        return Rotation.identity()
    if frame.upper() in J2000_NAMES:
        return Rotation.from_matrix(erfa.bp06(2_451_545.0, 0.0)[0])
    known = ", ".join((*ICRS_NAMES, *J2000_NAMES))
    raise EmulatorError(f"{where}: frame {frame[:40]!r} is not known; known: {known}")


def is_inertial(frame: str) -> bool:
    """Whether a frame is one of those of `icrs_to`."""
    return frame.upper() in (*ICRS_NAMES, *J2000_NAMES)


def unix_ns(where: str, text: str, scale: str = "UTC") -> int:
    """Return the Unix time of a date, nanoseconds: ISO 8601 with month or day of year, or as STK writes it."""
    whole_text, _, fraction = text.removesuffix("Z").partition(".")
    for form in DATES:
        with suppress(ValueError):
            whole = timegm(strptime(whole_text, form))
            label_ns = whole * NANOSECONDS + int((fraction + "0" * 9)[:9])
            break
    else:
        raise EmulatorError(f"{where}: not a date, e.g. 2026-03-20T12:00:00.0")
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
    path: Path, frame: Rotation, dates_ns: Sequence[int], rows_m: Sequence[Sequence[float]]
) -> OrbitTable:
    """Return the orbit of rows of x, y, z, vx, vy, vz (m, m/s) in the frame to which `frame` turns ICRS."""
    times = np.array(dates_ns, dtype=np.float64) / NANOSECONDS
    values = np.array(rows_m, dtype=np.float64)
    if not len(times) or not (np.diff(times) > 0.0).all():
        raise EmulatorError(f"orbit file {path}: has no rows, or a date is not later than the one before")
    if np.abs(values).max() > MAX_METRES:
        raise EmulatorError(f"orbit file {path}: a number is outside ±{MAX_METRES:g}")
    turned = [frame.inv().apply(values[:, first : first + 3]) for first in (0, 3)]
    return OrbitTable(path, times, [OrbitState(*pair) for pair in zip(*turned, strict=True)])


def euler_turns(where: str, sequence: str, angles_deg: Array) -> Rotation:
    """Return the rotations by successive turns (n, 3) of the frame about its axes: XYZ, or digits."""
    from scipy.spatial.transform import Rotation

    try:
        return Rotation.from_euler(
            sequence.upper().translate(str.maketrans("123", "XYZ")), angles_deg, degrees=True
        )
    except ValueError:
        raise EmulatorError(f"{where}: {sequence[:40]!r} is not a sequence of three axes") from None
