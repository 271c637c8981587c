"""Whether positions, velocities and dates can be right, and the likely mistake if they cannot.

A position must not be inside the Earth. Above the atmosphere, a satellite has a hundredth of the speed of a circular
orbit at least, which is that of an ellipse of eccentricity 0.9999 at its apogee; near the Earth it is at most as fast as
a body that comes from far away with `EXCESS_M_S`, elsewhere as `FASTEST_M_S`. The same holds halfway between two rows of a
file, where a wrong sign in one of them shows. A date is near the date of the run, and
not that of the run on another epoch.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from datetime import UTC, datetime
from typing import Final

from starhil.emulator.truth.orbit import EARTH_GM_M3_S2, OrbitState, interpolate_orbit
from starid.arithmetic.elementary import square
from starid.arithmetic.matrices import length
from starid.catalog.earth import DAY_S

SURFACE_M: Final = 6.35e6
"""Distance from the Earth's centre below which nothing flies: the poles are at 6357 km."""

ATMOSPHERE_M: Final = 6.478e6
"""Distance below which a vehicle may be at rest, or on its way up."""

NEAR_EARTH_M: Final = 1.5e9
"""Distance below which the Earth governs the motion."""

EXCESS_M_S: Final = 2e4
FASTEST_M_S: Final = 2.5e5
"""No spacecraft is faster relative to the Earth; Parker Solar Probe reaches 0.22·10⁶ m/s."""

LEAST_CIRCULAR_SHARE: Final = 0.01
"""Least speed above the atmosphere as a fraction of a circular orbit's."""

NEARNESS_S: Final = 15.0 * 365.25 * DAY_S
"""Largest difference between a date and that of the run."""

SAME_S: Final = 30.0 * DAY_S
"""Difference up to which a date of another epoch is taken for that of the run."""

EPOCHS: Final = {
    "seconds since J2000": 946_728_000.0,
    "GPS time": 315_964_800.0,
    "seconds since 1958": -378_691_200.0,
}
"""What is mistaken for Unix time, and its zero as Unix time."""


def doubt_of_orbit(orbit: OrbitState) -> str:
    """Return why position and velocity cannot be right, with the likely mistake; an empty text if they can."""
    distance, speed = (length(vector) for vector in (orbit.position_m, orbit.velocity_m_s))
    fault = _fault(distance, speed)
    if not fault:
        return ""
    return next(
        _mistakes(distance, speed), f"{fault}: give metres and m/s relative to the Earth's centre, GCRS"
    )


def doubt_between(before: OrbitState, after: OrbitState, length_s: float) -> str:
    """Return why the orbit halfway between two rows cannot be right; an empty text if it can."""
    halfway = interpolate_orbit(before, after, 0.5, length_s)
    fault = _fault(length(halfway.position_m), length(halfway.velocity_m_s))
    return fault and f"{fault}, halfway to the next row: a number is wrong, or the rows are too far apart"


def doubt_of_date(unix_s: float, run_unix_s: float) -> str:
    """Return why a date cannot be right in a run of another date; an empty text if it can."""
    dates = [f"{datetime.fromtimestamp(each, UTC):%Y-%m-%d}" for each in (unix_s, run_unix_s)]
    fault = f"the date is {dates[0]}, but that of the run {dates[1]}"
    for name, zero in EPOCHS.items():
        if abs(unix_s + zero - run_unix_s) <= SAME_S:
            return f"{fault}: it seems to be {name} instead of Unix time"
    if abs(unix_s - run_unix_s) > NEARNESS_S:
        return f"{fault}: set run.start_unix_s if it is right"
    return ""


def _fault(distance_m: float, speed_m_s: float) -> str:
    """Return what is wrong with the size of a position and velocity, or an empty text."""
    if distance_m < SURFACE_M:
        return "the position is inside the Earth"
    squared = EARTH_GM_M3_S2 / distance_m
    near = distance_m < NEAR_EARTH_M
    if speed_m_s > (math.sqrt(2.0 * squared + square(EXCESS_M_S)) if near else FASTEST_M_S):
        return "the velocity is that of no spacecraft"
    if near and distance_m > ATMOSPHERE_M and speed_m_s < LEAST_CIRCULAR_SHARE * math.sqrt(squared):
        return "the velocity is far below that of an orbit at this distance"
    return ""


def _mistakes(distance_m: float, speed_m_s: float) -> Iterator[str]:
    """Yield the mistakes in units without which the state would be an orbit about the Earth."""
    for factor, wrong, right in ((1e3, "kilometres", "metres"), (1e-3, "metres", "kilometres")):
        for of_position, of_velocity in ((factor, factor), (factor, 1.0), (1.0, factor)):
            distance, speed = of_position * distance_m, of_velocity * speed_m_s
            if distance < NEAR_EARTH_M and not _fault(distance, speed):
                what = {
                    (1.0, factor): "velocity seems",
                    (factor, 1.0): "position seems",
                    (factor, factor): "position and velocity seem",
                }[of_position, of_velocity]
                per_second = " per second" if of_position == 1.0 else ""
                yield f"{what} to be in {wrong}{per_second} instead of {right}{per_second}"
