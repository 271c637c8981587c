"""The true attitude as the oracle knows it, in plain numbers: q rotates vectors from ICRS to the sensor, scalar last."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from starhil.hil_tests.attitude import Quaternion, conjugate, from_matrix, from_radec_roll, product

Vector = tuple[float, float, float]


def frame_turned(axis: Sequence[float], angle_rad: float) -> Quaternion:
    """Return the quaternion that takes vectors into a frame turned by an angle about an axis."""
    k = -math.sin(0.5 * angle_rad)
    return Quaternion(k * axis[0], k * axis[1], k * axis[2], math.cos(0.5 * angle_rad))


def cross(a: Vector, b: Vector) -> Vector:
    """Return the vector product a × b."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def of_pairs(seen: tuple[Vector, Vector], known: tuple[Vector, Vector]) -> Quaternion:
    """Return the attitude from two directions in the sensor and in ICRS (TRIAD, Black 1964)."""

    def triad(first: Vector, second: Vector) -> list[Vector]:
        axes = [first, cross(first, second), cross(first, cross(first, second))]
        x, y, z = (
            (axis[0] / length, axis[1] / length, axis[2] / length)
            for axis in axes
            if (length := math.hypot(*axis))
        )
        return [x, y, z]

    in_sensor, in_icrs = triad(*seen), triad(*known)
    rows = [
        [
            sum(sensor[row] * icrs[column] for sensor, icrs in zip(in_sensor, in_icrs, strict=True))
            for column in range(3)
        ]
        for row in range(3)
    ]
    return from_matrix(rows)


@dataclass(frozen=True)
class Motion:
    """A rotation at a constant body rate since a time; at rest if the rate is zero."""

    start_s: float
    """Simulation time."""
    attitude: Quaternion
    """Attitude at the start."""
    rate_rad_s: tuple[float, float, float]
    """Body rate, sensor frame."""

    @classmethod
    def of(cls, truth: Mapping[str, Any], start_s: float) -> Motion:
        """Return the motion of a truth table of kind `fixed` or `rate`."""
        angles = truth["attitude"]
        attitude = from_radec_roll(angles["ra_deg"], angles["dec_deg"], angles.get("roll_deg", 0.0))
        x, y, z = (math.radians(value) for value in truth.get("rate_deg_s", (0.0, 0.0, 0.0)))
        return cls(start_s, attitude, (x, y, z))

    @property
    def speed_rad_s(self) -> float:
        """Magnitude of the body rate."""
        return math.hypot(*self.rate_rad_s)

    def at(self, t_s: float) -> Quaternion:
        """Return the attitude at a time."""
        speed = self.speed_rad_s
        if speed == 0.0:
            return self.attitude
        axis = [component / speed for component in self.rate_rad_s]
        return product(frame_turned(axis, speed * (t_s - self.start_s)), self.attitude)


@dataclass(frozen=True)
class Error:
    """Error of an attitude: rotation vector in the sensor frame, radians."""

    x: float
    y: float
    z: float

    @classmethod
    def between(cls, measured: Quaternion, true: Quaternion) -> Error:
        """Return the rotation from the true to the measured attitude."""
        x, y, z, w = product(measured, conjugate(true))
        sign = -1.0 if w < 0.0 else 1.0
        sine = math.sqrt(x * x + y * y + z * z)
        k = 2.0 if sine < 1e-12 else 2.0 * math.atan2(sine, sign * w) / sine
        return cls(sign * k * x, sign * k * y, sign * k * z)

    def along(self, rate: Sequence[float], slack_s: float) -> Error:
        """Return the error that remains if the time of the measurement is uncertain by `slack_s` both ways."""
        speed2 = sum(component * component for component in rate)
        if speed2 == 0.0:
            return self
        # the frame turns by -rate * t, so a later exposure is an error along -rate
        late_s = -(self.x * rate[0] + self.y * rate[1] + self.z * rate[2]) / speed2
        shift_s = min(max(late_s, -slack_s), slack_s)
        return Error(self.x + rate[0] * shift_s, self.y + rate[1] * shift_s, self.z + rate[2] * shift_s)

    @property
    def cross_rad(self) -> float:
        """Error across the boresight."""
        return math.hypot(self.x, self.y)
