"""Attitude: the rotation from ICRS into the sensor frame, and its conversions.

Conventions of the whole project:

- The sensor frame is +x right (columns of the image), +y down (rows), +z boresight.
- A quaternion is scalar-last ``(x, y, z, w)`` and *rotates vectors*: ``v_sensor = q ⊗ v_icrs ⊗ q*``, the
  convention of ``scipy.spatial.transform.Rotation``. The (Shuster) attitude quaternion of the spacecraft
  literature has the vector part of opposite sign.
- Roll is the angle by which celestial north is turned, counter-clockwise in the image, from image up.
  With b the boresight and n, e the unit vectors to north and east at b, the rows of the matrix are
  ``x = −sin(roll)·n − cos(roll)·e``, ``y = −cos(roll)·n + sin(roll)·e``, ``z = b``.
- At a celestial pole right ascension is undefined: it is reported as 0° and roll carries the whole turn,
  so that the triple always rebuilds the attitude.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Final, Self

import numpy as np
from numpy.typing import ArrayLike

from starid.arithmetic.arrays import Array
from starid.arithmetic.elementary import atan2, cos, hypot, sin, square, tan
from starid.arithmetic.matrices import dot, length, product
from starid.errors import StaridError

ARCSEC_PER_RAD: Final = 180.0 * 3600.0 / math.pi
"""Arcseconds in one radian."""

_POLE_RADIUS: Final = 1e-12
"""A boresight nearer to a pole than this (radians) is taken to be on it."""

_ROTATION_TOLERANCE: Final = 1e-6
"""Largest deviation from orthonormality that `Attitude.from_matrix` accepts."""

_SMALL_ANGLE: Final = 1e-8
"""Below this angle (radians) sin(a/2)/a is 1/2 to the last bit."""

_SMALL_TURN: Final = 1e-4
"""Turn (radians) below which the coefficient of the second order in Bortz's equation is 1/12 to the last bit."""


@dataclass(frozen=True)
class AttitudeDifference:
    """Difference between two attitudes.

    Attributes
    ----------
    cross_boresight_arcsec : float
        Angle between the two boresights, ≥ 0.
    roll_arcsec : float
        Rotation about the boresight (the twist of the swing–twist decomposition), ≥ 0.
    total_arcsec : float
        Angle of the rotation between the two attitudes, ≥ 0.
    rotation_vector_rad : ndarray (3,)
        Rotation vector e in the sensor frame, radians: ``A_this = exp(−[e]×)·A_truth``, that is, this
        attitude is the truth after the sensor has turned by +e.
    """

    cross_boresight_arcsec: float
    roll_arcsec: float
    total_arcsec: float
    rotation_vector_rad: Array


@dataclass(frozen=True, eq=False)
class Attitude:
    """The orientation of the sensor with respect to ICRS, as a unit quaternion.

    Attributes
    ----------
    quaternion_xyzw : ndarray (4,)
        Scalar-last unit quaternion ICRS→sensor, scalar part ≥ 0, read-only.

    Raises
    ------
    StaridError
        The quaternion is not four finite numbers, or all of them are zero.
    """

    quaternion_xyzw: Array

    def __post_init__(self) -> None:
        values = np.array(self.quaternion_xyzw, dtype=np.float64)
        if values.shape != (4,):
            raise StaridError(
                f"attitude quaternion: must be four numbers x, y, z, w, not an array {values.shape}"
            )
        x, y, z, w = values.tolist()
        norm = math.sqrt(x * x + y * y + z * z + w * w)
        if not (math.isfinite(norm) and norm > 0.0):
            raise StaridError(
                f"attitude quaternion: {values.tolist()} has no direction; give four finite numbers"
            )
        values /= -norm if w < 0.0 else norm
        values.flags.writeable = False
        object.__setattr__(self, "quaternion_xyzw", values)

    @classmethod
    def from_quaternion(cls, quaternion_xyzw: ArrayLike) -> Self:
        """Attitude from a scalar-last quaternion (4,) of any length and sign."""
        return cls(np.asarray(quaternion_xyzw, dtype=np.float64))

    @classmethod
    def from_matrix(cls, matrix: ArrayLike) -> Self:
        """Attitude from a rotation matrix.

        Parameters
        ----------
        matrix : array (3, 3)
            ICRS→sensor; its rows are the sensor's axes in ICRS.

        Raises
        ------
        StaridError
            The matrix is not a proper rotation to within 1e-6.
        """
        m = np.asarray(matrix, dtype=np.float64)
        if m.shape != (3, 3):
            raise StaridError(f"attitude matrix: shape must be (3, 3), not {m.shape}")
        deviation = float(np.max(np.abs(product(m, m.T) - np.eye(3))))
        if not deviation <= _ROTATION_TOLERANCE or dot(np.cross(m[0], m[1]), m[2]) < 0.0:
            raise StaridError(
                "attitude matrix: not a rotation; its rows must be orthonormal and right-handed"
            )
        return cls(quaternion_of(m))

    @classmethod
    def from_radec_roll(cls, ra_deg: float, dec_deg: float, roll_deg: float) -> Self:
        """Attitude from a boresight and a roll.

        Parameters
        ----------
        ra_deg, dec_deg : float
            Boresight, degrees ICRS; any right ascension, declination within ±90°.
        roll_deg : float
            Angle of celestial north, counter-clockwise in the image, from image up, degrees.

        Raises
        ------
        StaridError
            A value is not finite, or the declination is beyond ±90°.
        """
        if not (math.isfinite(ra_deg) and math.isfinite(roll_deg) and -90.0 <= dec_deg <= 90.0):
            raise StaridError(
                f"attitude: RA {ra_deg}, Dec {dec_deg}, roll {roll_deg}: must be degrees, Dec within ±90"
            )
        north, east, boresight = _local_frame(math.radians(ra_deg % 360.0), math.radians(dec_deg))
        roll = math.radians(roll_deg % 360.0)
        s, c = sin(roll), cos(roll)
        return cls(quaternion_of(np.array([-s * north - c * east, -c * north + s * east, boresight])))

    @classmethod
    def identity(cls) -> Self:
        """Sensor axes along the ICRS axes: boresight at the north celestial pole."""
        return cls(np.array([0.0, 0.0, 0.0, 1.0]))

    @cached_property
    def matrix(self) -> Array:
        """Rotation matrix (3, 3) ICRS→sensor, read-only: ``v_sensor = matrix @ v_icrs``."""
        x, y, z, w = self.quaternion_xyzw.tolist()
        m = np.array(
            [
                [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
                [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
                [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
            ]
        )
        m.flags.writeable = False
        return m

    @property
    def boresight(self) -> Array:
        """Unit vector (3,) of the boresight in ICRS."""
        axis: Array = self.matrix[2]
        return axis

    @cached_property
    def _radec_roll(self) -> tuple[float, float, float]:
        (x0, x1, x2), (y0, y1, y2), (bx, by, bz) = self.matrix.tolist()
        from_axis = hypot(bx, by)
        on_pole = from_axis < _POLE_RADIUS
        ra = 0.0 if on_pole else atan2(by, bx)
        dec = math.copysign(0.5 * math.pi, bz) if on_pole else atan2(bz, from_axis)
        sa, ca, sd, cd = sin(ra), cos(ra), sin(dec), cos(dec)
        x_north, y_north = -sd * (ca * x0 + sa * x1) + cd * x2, -sd * (ca * y0 + sa * y1) + cd * y2
        x_east, y_east = ca * x1 - sa * x0, ca * y1 - sa * y0
        roll = atan2(y_east - x_north, -x_east - y_north)
        return _turn(ra), math.degrees(dec), _turn(roll)

    @property
    def ra_deg(self) -> float:
        """Right ascension of the boresight, degrees in [0, 360); 0 on a pole."""
        return self._radec_roll[0]

    @property
    def dec_deg(self) -> float:
        """Declination of the boresight, degrees in [−90, 90]."""
        return self._radec_roll[1]

    @property
    def roll_deg(self) -> float:
        """Roll, degrees in [0, 360): celestial north, counter-clockwise in the image, from image up."""
        return self._radec_roll[2]

    def to_sensor(self, vectors_icrs: Array) -> Array:
        """Transform vectors (n, 3) or (3,) from ICRS to the sensor frame."""
        return product(vectors_icrs, self.matrix.T)

    def to_icrs(self, vectors_sensor: Array) -> Array:
        """Transform vectors (n, 3) or (3,) from the sensor frame to ICRS."""
        return product(vectors_sensor, self.matrix)

    def rotated(self, rotation_vector_sensor_rad: ArrayLike) -> Attitude:
        """Attitude after the sensor has turned by +v: ``A' = exp(−[v]×)·A``.

        Parameters
        ----------
        rotation_vector_sensor_rad : array (3,)
            Rotation vector in the sensor frame, radians; any size.
        """
        vx, vy, vz = (float(c) for c in np.asarray(rotation_vector_sensor_rad, dtype=np.float64))
        angle = math.sqrt(vx * vx + vy * vy + vz * vz)
        k = -0.5 if angle < _SMALL_ANGLE else -sin(0.5 * angle) / angle
        turn = (k * vx, k * vy, k * vz, cos(0.5 * angle))
        return Attitude(_multiply(turn, self.quaternion_xyzw.tolist()))

    def error_to(self, truth: Attitude) -> AttitudeDifference:
        """Error of this attitude against the truth, split into cross-boresight and roll."""
        tx, ty, tz, tw = truth.quaternion_xyzw.tolist()
        x, y, z, w = _multiply(self.quaternion_xyzw.tolist(), (-tx, -ty, -tz, tw)).tolist()
        if w < 0.0:
            x, y, z, w = -x, -y, -z, -w
        cross = 2.0 * atan2(hypot(x, y), hypot(z, w))
        roll = 2.0 * atan2(abs(z), w)
        half_sine = math.sqrt(x * x + y * y + z * z)
        total = 2.0 * atan2(half_sine, w)
        k = -2.0 if half_sine < _SMALL_ANGLE else -total / half_sine
        return AttitudeDifference(
            cross_boresight_arcsec=cross * ARCSEC_PER_RAD,
            roll_arcsec=roll * ARCSEC_PER_RAD,
            total_arcsec=total * ARCSEC_PER_RAD,
            rotation_vector_rad=np.array([k * x, k * y, k * z]),
        )

    def __str__(self) -> str:
        ra, roll = (turn_text(angle, 4) for angle in (self.ra_deg, self.roll_deg))
        return f"RA {ra}° Dec {self.dec_deg:+.4f}° roll {roll}°"


def turn_text(degrees: float, digits: int) -> str:
    """Format a right ascension or a roll; the result is below 360 even after rounding."""
    return f"{round(degrees % 360.0, digits) % 360.0:.{digits}f}"


def random_attitude(rng: np.random.Generator) -> Attitude:
    """Draw an attitude uniformly from all rotations (normalised four-dimensional Gaussian)."""
    return Attitude(rng.standard_normal(4))


def propagate(attitude: Attitude, rate_rad_s: ArrayLike, dt: float) -> Attitude:
    """Attitude after `dt` seconds at a constant rate (3,) in rad/s, expressed in the sensor frame."""
    return attitude.rotated(np.asarray(rate_rad_s, dtype=np.float64) * dt)


def rate_between(first: Attitude, second: Attitude, dt: float) -> Array:
    """Constant rate (3,) in rad/s, sensor frame, that turns the first into the second in `dt` seconds."""
    return second.error_to(first).rotation_vector_rad / dt


def interpolate(first: Attitude, second: Attitude, fraction: float) -> Attitude:
    """Interpolate along the shortest rotation between two attitudes (fraction 0 = first, 1 = second)."""
    return first.rotated(second.error_to(first).rotation_vector_rad * fraction)


def interpolate_with_rates(
    first: Attitude, second: Attitude, first_rate: Array, second_rate: Array, fraction: float, dt: float
) -> Attitude:
    """Interpolate on the cubic of the rotation vector that also has both rates.

    Parameters
    ----------
    first_rate, second_rate : array (3,)
        Rates in rad/s, sensor frame, at the two attitudes, which are `dt` seconds apart.
    """
    turn = second.error_to(first).rotation_vector_rad
    f, g = fraction, 1.0 - fraction
    start, end = dt * first_rate, dt * _vector_rate(turn, second_rate)
    return first.rotated(f * f * (3.0 - 2.0 * f) * turn + f * g * (g * start - f * end))


def _vector_rate(turn: Array, rate: Array) -> Array:
    """Return the derivative of a rotation vector at a body rate (Bortz 1971, eq. 9)."""
    angle = length(turn)
    second = 1.0 / 12.0
    if angle > _SMALL_TURN:
        second = (1.0 - 0.5 * angle / tan(0.5 * angle)) / square(angle)
    once = np.cross(turn, rate)
    derivative: Array = rate + 0.5 * once + second * np.cross(turn, once)
    return derivative


def _turn(angle: float) -> float:
    """Convert radians to degrees in [0, 360)."""
    degrees = math.degrees(angle) % 360.0
    return 0.0 if degrees == 360.0 else degrees


def _local_frame(ra: float, dec: float) -> tuple[Array, Array, Array]:
    """Return the unit vectors to north, to east and outward at a point of the sky (radians)."""
    sa, ca, sd, cd = sin(ra), cos(ra), sin(dec), cos(dec)
    north = np.array([-sd * ca, -sd * sa, cd])
    return north, np.array([-sa, ca, 0.0]), np.array([cd * ca, cd * sa, sd])


def _multiply(left: tuple[float, ...] | list[float], right: tuple[float, ...] | list[float]) -> Array:
    """Hamilton product of two scalar-last quaternions: the rotation `right`, then `left`."""
    ax, ay, az, aw = left
    bx, by, bz, bw = right
    return np.array(
        [
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
            aw * bw - ax * bx - ay * by - az * bz,
        ]
    )


def quaternion_of(matrix: Array) -> Array:
    """Scalar-last unit quaternion (4,) of a near-rotation matrix, from its largest component (Shepperd)."""
    (a, b, c), (d, e, f), (g, h, i) = matrix.tolist()
    squares = (1.0 + a - e - i, 1.0 - a + e - i, 1.0 - a - e + i, 1.0 + a + e + i)
    rows = (
        (squares[0], b + d, c + g, h - f),
        (b + d, squares[1], f + h, c - g),
        (c + g, f + h, squares[2], d - b),
        (h - f, c - g, d - b, squares[3]),
    )
    q = np.array(rows[squares.index(max(squares))])
    return q / length(q)
