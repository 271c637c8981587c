"""Energetic particles along an orbit: few in most places, many in the South Atlantic Anomaly."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import numpy.typing as npt

from starid.arithmetic.elementary import asin, atan2, exp, square

EARTH_RADIUS_KM: Final = 6371.0
REFERENCE_ALTITUDE_KM: Final = 500.0

_CENTRE_DEG: Final = (-26.0, -49.0)
_WIDTH_LATITUDE_DEG: Final = 11.0
_WIDTH_WEST_DEG: Final = 20.0
_WIDTH_EAST_DEG: Final = 27.0
_SCALE_HEIGHT_KM: Final = 150.0
_ALTITUDES_KM: Final = (200.0, 1000.0)
_J2000_UNIX_S: Final = 946_728_000.0
_DAY_S: Final = 86_400.0


QUIET_CM2_S: Final = 4.0
ANOMALY_CM2_S: Final = 1000.0
"""Particles from all directions through a sphere of 1 cm² cross-section, per second: cosmic rays in a low orbit, and protons
above 30 MeV in the centre of the anomaly at 500 km, after AP-8; other models and solar activity differ by factors of 2."""


def default_rates(width: int, height: int, pixel_um: float) -> tuple[float, float]:
    """Return the particles per second that cross a detector: outside the anomaly, and more in its centre at 500 km.

    Of an isotropic flux, a plane is crossed by half of what a sphere of that cross-section is.
    """
    area_cm2 = width * height * square(pixel_um * 1e-4)
    return 0.5 * QUIET_CM2_S * area_cm2, 0.5 * ANOMALY_CM2_S * area_cm2


def sub_satellite_point(position_m: npt.ArrayLike, unix_s: float) -> tuple[float, float, float]:
    """Return the place below a satellite: geocentric latitude and longitude in degrees, altitude in kilometres.

    The position (3,) is in GCRS, metres; precession since J2000 (0.4° by 2026) is neglected. The time is taken as
    UT1; the Earth rotation angle is equation 5.15 of the IERS Conventions 2010.
    """
    x, y, z = (float(value) for value in np.asarray(position_m, dtype=np.float64) / 1000.0)
    distance = math.sqrt(x * x + y * y + z * z)
    days = (unix_s - _J2000_UNIX_S) / _DAY_S
    rotation = 2.0 * math.pi * (0.7790572732640 + 1.00273781191135448 * days)
    longitude = math.degrees(atan2(y, x) - rotation)
    latitude = math.degrees(asin(z / distance))
    return latitude, (longitude + 180.0) % 360.0 - 180.0, distance - EARTH_RADIUS_KM


def anomaly_share(latitude_deg: float, longitude_deg: float, altitude_km: float) -> float:
    """Return the flux of trapped protons relative to that in the centre of the anomaly at 500 km.

    A Gaussian in latitude and longitude, wider to the east, after maps of AP-8 for protons above 30 MeV; it rises by
    a factor of e every 150 km, between 200 and 1000 km.
    """
    east = (longitude_deg - _CENTRE_DEG[1] + 180.0) % 360.0 - 180.0
    north = (latitude_deg - _CENTRE_DEG[0]) / _WIDTH_LATITUDE_DEG
    east /= _WIDTH_EAST_DEG if east > 0.0 else _WIDTH_WEST_DEG
    above = min(max(altitude_km, _ALTITUDES_KM[0]), _ALTITUDES_KM[1]) - REFERENCE_ALTITUDE_KM
    return exp(-0.5 * (north * north + east * east) + above / _SCALE_HEIGHT_KM)


def particle_rate(
    quiet_s: float | None,
    anomaly_s: float | None,
    position_m: npt.ArrayLike | None,
    unix_s: float | None,
    defaults: tuple[float, float] = (0.0, 0.0),
) -> float:
    """Return the mean number of particles per second that hit the detector.

    There are `quiet_s` outside the anomaly, and `anomaly_s` more in its centre at 500 km; for None, those of `defaults`.
    Without a position (3,), GCRS, metres, and a time, only a given `quiet_s` counts.
    """
    if position_m is None or unix_s is None:
        return quiet_s or 0.0
    quiet_s, anomaly_s = (
        default if given is None else given
        for given, default in zip((quiet_s, anomaly_s), defaults, strict=True)
    )
    return quiet_s + anomaly_s * anomaly_share(*sub_satellite_point(position_m, unix_s))
