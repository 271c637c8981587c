"""Orbits: position and velocity of the spacecraft in GCRS, from elements, a state vector or a TLE.

Elements refer to the GCRS equator and equinox. Two-body motion has the secular rates of J2 (Vallado 2013,
sect. 9.4); a TLE is propagated by SGP4 and turned from TEME to GCRS by precession and nutation (IAU 2000B).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final, Protocol, Self, TypeAlias

import numpy as np

from starhil.emulator.errors import EmulatorError
from starid.arithmetic.arrays import Array, on_grid
from starid.arithmetic.elementary import acos, atan2, cos, hypot, sin, square
from starid.arithmetic.matrices import dot, length, product
from starid.catalog.earth import DAY_S, UNIX_EPOCH_JD, VELOCITY_GRID_M_S, terrestrial_time
from starid.storage.files import read_number

Vector: TypeAlias = Array

EARTH_GM_M3_S2: Final = 3.986_004_418e14
EARTH_RADIUS_M: Final = 6_378_137.0
EARTH_J2: Final = 1.082_626_68e-3

LARGEST_ECCENTRICITY: Final = 0.995
TLE_LENGTH: Final = 69
TLE_FIELDS: Final = {
    "day of the epoch": (0, slice(20, 32), "", 1.0, 367.0),
    "inclination": (1, slice(8, 16), "", 0.0, 180.0),
    "right ascension of the node": (1, slice(17, 25), "", 0.0, 360.0),
    "eccentricity": (1, slice(26, 33), "0.", 0.0, 1.0),
    "argument of perigee": (1, slice(34, 42), "", 0.0, 360.0),
    "mean anomaly": (1, slice(43, 51), "", 0.0, 360.0),
    "mean motion": (1, slice(52, 63), "", 0.01, 20.0),
}
"""Numbers of a TLE that the checksum does not judge: line, columns, what precedes the number, and its range."""

_KEPLER_STEPS: Final = 60
_POSITION_GRID_M: Final = 2.0**-10


@dataclass(frozen=True)
class OrbitState:
    """Position (3,), m, and velocity (3,), m/s, relative to the Earth's centre, GCRS."""

    position_m: Vector
    velocity_m_s: Vector


class Orbit(Protocol):
    """Position and velocity of the spacecraft at any time."""

    def state(self, unix_s: float) -> OrbitState:
        """Return position and velocity at a Unix time."""


@dataclass(frozen=True)
class KeplerOrbit:
    """An elliptic orbit about the Earth."""

    epoch_unix_s: float
    semi_major_axis_m: float
    eccentricity: float = 0.0
    inclination_rad: float = 0.0
    raan_rad: float = 0.0
    argument_of_perigee_rad: float = 0.0
    mean_anomaly_rad: float = 0.0
    """Angles at the epoch, radians."""
    j2: bool = True
    """Whether node, perigee and mean anomaly drift at the secular rates due to the Earth's oblateness."""

    def __post_init__(self) -> None:
        if not 0.0 <= self.eccentricity <= LARGEST_ECCENTRICITY:
            raise EmulatorError(
                f"orbit: eccentricity must be 0…{LARGEST_ECCENTRICITY}, not {self.eccentricity:g}"
            )
        perigee_m = self.semi_major_axis_m * (1.0 - self.eccentricity)
        if not EARTH_RADIUS_M <= perigee_m < math.inf:
            raise EmulatorError(
                f"orbit: perigee {1e-3 * perigee_m:g} km from the Earth's centre, "
                f"at least {1e-3 * EARTH_RADIUS_M:g} km needed"
            )

    @classmethod
    def from_state(cls, epoch_unix_s: float, state: OrbitState, *, j2: bool = True) -> Self:
        """Return the orbit with a position and velocity (osculating elements)."""
        r, v = state.position_m, state.velocity_m_s
        distance, speed2 = length(r), dot(v, v)
        momentum = np.cross(r, v)
        area = length(momentum)
        if not (distance > 0.0 and area > 0.0 and 2.0 / distance > speed2 / EARTH_GM_M3_S2):
            raise EmulatorError(
                "orbit: position and velocity are not on an ellipse about the Earth; give metres and m/s, GCRS"
            )
        a = 1.0 / (2.0 / distance - speed2 / EARTH_GM_M3_S2)
        h = momentum / area
        raan = atan2(h[0], -h[1]) if hypot(h[0], h[1]) > 1e-12 else 0.0
        node = np.array([cos(raan), sin(raan), 0.0])
        towards = np.cross(v, momentum) / EARTH_GM_M3_S2 - r / distance
        e = length(towards)
        perigee = _angle_about(h, node, towards) if e > 1e-9 else 0.0
        true = _angle_about(h, node, r) - perigee
        eccentric = 2.0 * atan2(
            math.sqrt(1.0 - min(e, 1.0)) * sin(0.5 * true), math.sqrt(1.0 + e) * cos(0.5 * true)
        )
        return cls(
            epoch_unix_s,
            a,
            e,
            acos(max(-1.0, min(1.0, float(h[2])))),
            raan,
            perigee,
            eccentric - e * sin(eccentric),
            j2,
        )

    def state(self, unix_s: float) -> OrbitState:
        """Return position and velocity at a Unix time."""
        a, e = self.semi_major_axis_m, self.eccentricity
        elapsed_s = unix_s - self.epoch_unix_s
        motion = math.sqrt(EARTH_GM_M3_S2 / (a * a * a))
        root = math.sqrt(1.0 - e * e)
        node_rate = perigee_rate = anomaly_rate = 0.0
        if self.j2:
            factor = 1.5 * EARTH_J2 * motion * square(EARTH_RADIUS_M / (a * (1.0 - e * e)))
            cosine2 = square(cos(self.inclination_rad))
            node_rate = -factor * cos(self.inclination_rad)
            perigee_rate = 0.5 * factor * (5.0 * cosine2 - 1.0)
            anomaly_rate = 0.5 * factor * root * (3.0 * cosine2 - 1.0)
        mean = self.mean_anomaly_rad + (motion + anomaly_rate) * elapsed_s
        eccentric = _eccentric_anomaly(mean, e)
        cosine, sine = cos(eccentric), sin(eccentric)
        speed = motion * a / (1.0 - e * cosine)
        in_plane = _orbit_axes(
            self.raan_rad + node_rate * elapsed_s,
            self.inclination_rad,
            self.argument_of_perigee_rad + perigee_rate * elapsed_s,
        )
        return OrbitState(
            product(np.array([a * (cosine - e), a * root * sine]), in_plane),
            product(np.array([-speed * sine, speed * root * cosine]), in_plane),
        )


class TleOrbit:
    """An orbit from a two-line element set, propagated by SGP4."""

    def __init__(self, line1: str, line2: str) -> None:
        from sgp4.api import Satrec
        from sgp4.io import verify_checksum

        for number, line in (("1", line1), ("2", line2)):
            if len(line) != TLE_LENGTH or line[:2] != f"{number} ":
                raise EmulatorError(
                    f"orbit: line {number} of the TLE is invalid; it must begin with {number} and have {TLE_LENGTH} characters"
                )
        for name, (row, columns, point, low, high) in TLE_FIELDS.items():
            text = (line1, line2)[row][columns]
            try:
                valid = low <= read_number(point + text.strip()) <= high
            except ValueError:
                valid = False
            if not valid:
                raise EmulatorError(
                    f"orbit: TLE: {name} must be a number from {low:g} to {high:g}, not {text!r}; copy both lines again"
                )
        try:
            verify_checksum(line1, line2)
            self._satellite: Any = Satrec.twoline2rv(line1, line2)
        except (ValueError, IndexError) as error:
            why = str(error).partition("\n")[0].rstrip(": ")
            raise EmulatorError(f"orbit: TLE: {why}; copy both lines again") from None
        if self._satellite.error:
            raise EmulatorError(f"orbit: TLE: {_sgp4_error(self._satellite.error)}; give a current TLE")
        motion_rad_s = 2.0 * math.pi * float(line2[TLE_FIELDS["mean motion"][1]]) / DAY_S
        self._cubed_axis_m3 = EARTH_GM_M3_S2 / square(motion_rad_s)
        """Cube of the semi-major axis, twice which no ellipse reaches: SGP4 diverges for a false drag term."""

    def state(self, unix_s: float) -> OrbitState:
        """Return position and velocity at a Unix time."""
        import erfa

        days, seconds = divmod(unix_s, DAY_S)
        error, position_km, velocity_km_s = self._satellite.sgp4(UNIX_EPOCH_JD + days, seconds / DAY_S)
        if error:
            raise EmulatorError(
                f"orbit: TLE: {_sgp4_error(error)}; give a TLE with an epoch closer to the run's date"
            )
        tt = terrestrial_time(unix_s)
        equinoxes = float(erfa.ee00b(*tt))
        c, s = cos(equinoxes), sin(equinoxes)
        to_gcrs = product(erfa.pnm00b(*tt).T, np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]))
        position, velocity = (product(to_gcrs, 1e3 * np.array(each)) for each in (position_km, velocity_km_s))
        distance_m = length(position)
        within = distance_m * distance_m * distance_m < 10.0 * self._cubed_axis_m3
        if not (within and length(velocity) < math.inf):
            raise EmulatorError("orbit: TLE: has no position at the run's date; give a current TLE")
        return OrbitState(on_grid(position, _POSITION_GRID_M), on_grid(velocity, VELOCITY_GRID_M_S))


def interpolate_orbit(before: OrbitState, after: OrbitState, fraction: float, span_s: float) -> OrbitState:
    """Interpolate between two states that are `span_s` seconds apart (cubic Hermite)."""
    f, g = fraction, 1.0 - fraction
    gap = after.position_m - before.position_m
    start, end = before.velocity_m_s * span_s, after.velocity_m_s * span_s
    position = before.position_m + f * f * (3.0 - 2.0 * f) * gap + f * g * (g * start - f * end)
    if span_s <= 0.0:
        return after
    slope = 6.0 * f * g * gap + g * (1.0 - 3.0 * f) * start + f * (3.0 * f - 2.0) * end
    return OrbitState(position, slope / span_s)


def _eccentric_anomaly(mean: float, e: float) -> float:
    """Solve Kepler's equation M = E − e sin E by Newton's method from E = M, or from π for large e."""
    mean = math.remainder(mean, 2.0 * math.pi)
    eccentric = mean if e < 0.8 else math.copysign(math.pi, mean)
    for _ in range(_KEPLER_STEPS):
        step = (eccentric - e * sin(eccentric) - mean) / (1.0 - e * cos(eccentric))
        eccentric -= step
        if abs(step) < 1e-14:
            break
    return eccentric


def _orbit_axes(raan: float, inclination: float, perigee: float) -> Vector:
    """Return unit vectors (2, 3) in the orbital plane: to the perigee, and 90° ahead of it."""
    co, so = cos(raan), sin(raan)
    ci, si = cos(inclination), sin(inclination)
    cw, sw = cos(perigee), sin(perigee)
    return np.array(
        [
            [co * cw - so * sw * ci, so * cw + co * sw * ci, sw * si],
            [-co * sw - so * cw * ci, -so * sw + co * cw * ci, cw * si],
        ]
    )


def _angle_about(axis: Vector, origin: Vector, direction: Vector) -> float:
    """Return the angle from one direction to another about an axis perpendicular to both, radians."""
    return atan2(dot(axis, np.cross(origin, direction)), dot(origin, direction))


def _sgp4_error(code: int) -> str:
    from sgp4.api import SGP4_ERRORS

    return str(SGP4_ERRORS.get(code, f"error {code}"))
