"""Terrestrial time, and the Earth's position and velocity, computed with the IAU SOFA routines (`erfa`).

No file is downloaded: the library contains the series, and the leap seconds known at its release.
"""

from __future__ import annotations

import bisect
from datetime import UTC, datetime
from functools import lru_cache
from typing import Any, Final

from starid.arithmetic.arrays import Array, on_grid

ASTRONOMICAL_UNIT_M: Final = 149_597_870_700.0
DAY_S: Final = 86_400.0

_POSITION_GRID_M: Final = 0.25
VELOCITY_GRID_M_S: Final = 2.0**-20
"""Velocities from `erfa` and SGP4 are multiples of this (`on_grid`)."""

UNIX_EPOCH_JD: Final = 2_440_587.5
"""Julian date of 1970-01-01."""

LATEST_UNIX_S: Final = 4_102_444_800.0
"""2100-01-01; the 32-bit seconds of telemetry wrap six years later."""

_TT_MINUS_TAI_S: Final = 32.184


def unix_time(value: object) -> float:
    """Return the Unix time of a date: a TOML date-time, ISO 8601 text, or Unix time; UTC without an offset.

    Raises
    ------
    ValueError
        The value is not a date from 1970 to 2100.
    """
    number = value
    if isinstance(value, str):
        try:
            number = datetime.fromisoformat(value)
        except ValueError:
            number = None
    if isinstance(number, datetime):
        number = (number if number.tzinfo else number.replace(tzinfo=UTC)).timestamp()
    if isinstance(number, bool) or not isinstance(number, (int, float)) or not 0.0 <= number <= LATEST_UNIX_S:
        raise ValueError("must be a date from 1970 to 2100, e.g. 2026-03-20T12:00:00Z")
    return float(number)


@lru_cache(maxsize=1)
def _leap_seconds() -> tuple[list[float], list[float]]:
    """Unix times at which TAI − UTC changes, and the value from then on, seconds."""
    import erfa

    table = [row for row in erfa.leap_seconds.get().tolist() if row[0] >= 1972]
    starts = [datetime(year, month, 1, tzinfo=UTC).timestamp() for year, month, _ in table]
    return starts, [float(row[2]) for row in table]


def _tai_minus_utc(unix_s: float) -> float:
    starts, offsets = _leap_seconds()
    return offsets[max(bisect.bisect_right(starts, unix_s) - 1, 0)]


def utc_of_tai(tai_s: float) -> float:
    """Convert TAI, as seconds since 1970-01-01T00:00:00 TAI, to Unix time."""
    return tai_s - _tai_minus_utc(tai_s - _tai_minus_utc(tai_s))


def terrestrial_time(unix_s: float) -> tuple[float, float]:
    """Julian date of terrestrial time in two parts: an integer plus a half, and the fraction.

    Barycentric dynamical time differs by less than 2 ms. Before 1972, TAI − UTC is taken as 10 s.
    """
    offset_s = _tai_minus_utc(unix_s)
    days, seconds = divmod(unix_s + offset_s + _TT_MINUS_TAI_S, DAY_S)
    return UNIX_EPOCH_JD + days, seconds / DAY_S


def julian_year(unix_s: float) -> float:
    """Convert a Unix time to a Julian year, the unit of epochs of star positions."""
    first, rest = terrestrial_time(unix_s)
    return 2000.0 + ((first - 2_451_545.0) + rest) / 365.25


def earth_and_sun(unix_s: float) -> tuple[Array, Array, Array]:
    """Position and velocity (3,) of the centre of the Earth, and position (3,) of the Sun.

    Barycentric, ICRS, m and m/s (`erfa.epv00`).
    """
    from erfa import ufunc

    # without the warning of `erfa.epv00` that the error grows outside 1900 to 2100: a device's clock may show any date
    heliocentric, barycentric, _ = ufunc.epv00(*terrestrial_time(unix_s))
    position, velocity = in_metres(barycentric)
    return position, velocity, position - in_metres(heliocentric)[0]


def earth_velocity(unix_s: float) -> Array:
    """Barycentric velocity (3,) of the Earth's centre, ICRS, m/s."""
    return earth_and_sun(unix_s)[1]


def in_metres(pv: Any) -> tuple[Array, Array]:
    """Convert a position–velocity record of `erfa` (au, au/d) to metres and m/s."""
    position, velocity = pv["p"] * ASTRONOMICAL_UNIT_M, pv["v"] * (ASTRONOMICAL_UNIT_M / DAY_S)
    return on_grid(position, _POSITION_GRID_M), on_grid(velocity, VELOCITY_GRID_M_S)
