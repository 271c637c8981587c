"""Velocity assumed by the device, from its clock and the orbit in its parameters, to correct aberration."""

from __future__ import annotations

import math
from collections.abc import Mapping

from starhil.emulator.truth.orbit import EARTH_RADIUS_M, KeplerOrbit
from starid.arithmetic.arrays import Array
from starid.catalog.earth import earth_velocity

ParameterValue = bool | int | float | str


def observer_velocity(parameters: Mapping[str, ParameterValue], unix_s: float) -> Array | None:
    """Return the velocity (3,) that the device assumes, relative to the barycentre, ICRS, m/s.

    It is None if the device does not correct aberration.
    """
    if not parameters.get("corrects_aberration", False):
        return None
    velocity = earth_velocity(unix_s)
    orbit = known_orbit(parameters)
    return velocity if orbit is None else velocity + orbit.state(unix_s).velocity_m_s


def known_orbit(parameters: Mapping[str, ParameterValue]) -> KeplerOrbit | None:
    """Return the orbit in the parameters of the device; None if there is none."""
    names = ("epoch", "semi_major_axis", "eccentricity", "inclination", "node", "perigee", "mean_anomaly")
    epoch, semi_major_axis_km, eccentricity, *angles_deg = (
        float(parameters.get(f"orbit_{name}", 0.0)) for name in names
    )
    if semi_major_axis_km == 0.0:
        return None
    inclination, node, perigee, anomaly = (math.radians(angle) for angle in angles_deg)
    return KeplerOrbit(epoch, 1e3 * semi_major_axis_km, eccentricity, inclination, node, perigee, anomaly)


def perigee_below_surface(semi_major_axis_km: float, eccentricity: float) -> bool:
    """Return whether a known orbit (with a semi-major axis other than 0) intersects the Earth."""
    return semi_major_axis_km != 0.0 and 1e3 * semi_major_axis_km * (1.0 - eccentricity) < EARTH_RADIUS_M
