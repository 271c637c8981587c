"""The reported attitude: in the mounting frame, with validity and time."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, reduce
from itertools import product
from typing import Final

import numpy as np

from starhil.emulator.device.measurement import Measurement
from starhil.emulator.device.modes import Mode
from starhil.emulator.device.parameters import ParameterValue
from starhil.emulator.sensor.pipeline.messages import ZERO, Quaternion, Triple, as_quaternion, as_triple
from starhil.protocol.icd.conventions import Conventions
from starid.arithmetic.arrays import Array
from starid.arithmetic.elementary import atan2, hypot
from starid.arithmetic.matrices import length
from starid.attitude import Attitude

_IDENTITY: Final = Attitude.identity()

SEQUENCES: Final = tuple(a + b + c for a, b, c in product("xyz", repeat=3) if a != b != c)
"""Sequences of Euler angles: the axes of three rotations, of which no two successive ones are the same."""

GIMBAL_LOCK_RAD: Final = 1e-7
"""With a second Euler angle this near to where the first and third axes coincide, the third angle is 0."""

SMALLEST_SCALAR: Final = 1e-12
"""Smallest scalar part by which a Gibbs vector is divided."""


@dataclass(frozen=True)
class Reported:
    """Reported attitude and rate."""

    reason: str
    """Why the attitude is invalid, `ok` if it is valid."""
    quaternion_xyzw: Quaternion = (0.0, 0.0, 0.0, 0.0)
    """ICRS → reported frame in the convention of the unit, scalar last; zeros if invalid."""
    rate_rad_s: Triple = ZERO
    """Body rate in the reported frame, rad/s; zeros if unknown."""
    attitude: Attitude = _IDENTITY
    """ICRS → reported frame; the identity if invalid."""
    mounted: Attitude = _IDENTITY
    """ICRS → sensor frame after the mounting angles; the reported frame differs from it in the names of its axes."""
    turns: tuple[Array, ...] = ()
    """Rotation vectors (3,) that turn the sensor frame to the reported frame, one after another, radians."""

    def in_reported_frame(self, vector: Array) -> Array:
        """Turn a vector (3,) from the sensor frame to the reported frame."""
        return _turned(vector, self.turns)

    @property
    def valid(self) -> bool:
        """Whether the attitude is valid."""
        return self.reason == "ok"

    @property
    def rotation_vector_rad(self) -> Triple:
        """Rotation vector of the quaternion in the convention of the unit, of at most π."""
        x, y, z, w = self.quaternion_xyzw
        sine = math.sqrt(x * x + y * y + z * z)
        scale = 2.0 if sine == 0.0 else 2.0 * atan2(math.copysign(sine, w), abs(w)) / sine
        return (scale * x, scale * y, scale * z)

    @property
    def gibbs_vector(self) -> Triple:
        """Gibbs or Rodrigues vector of the quaternion in the convention of the unit, tan(φ/2) along the axis.

        It grows without bound towards half a turn, so that its length ends at about 10¹².
        """
        return self._vector_part_over(
            math.copysign(max(abs(self.quaternion_xyzw[3]), SMALLEST_SCALAR), self.quaternion_xyzw[3])
        )

    @property
    def modified_rodrigues(self) -> Triple:
        """Modified Rodrigues parameters of the quaternion in the convention of the unit, tan(φ/4) along the axis, of at most 1."""
        w = self.quaternion_xyzw[3]
        return self._vector_part_over(w + math.copysign(1.0, w))

    def _vector_part_over(self, divisor: float) -> Triple:
        x, y, z, _ = self.quaternion_xyzw
        return (x / divisor, y / divisor, z / divisor)

    def euler_rad(self, sequence: str) -> Triple:
        """Return the Euler angles that turn the ICRS axes to the reported axes, (3,), rad.

        Each rotation is about an axis as the previous rotations have turned it (an intrinsic sequence). The first
        and third angle are in (−π, π]; the second is in [0, π] if the first and last axis are the same, otherwise
        in [−π/2, π/2]. Where the first and third rotation are about one line, the third angle is 0.

        From the quaternion, by Bernardes and Viollet, PLoS ONE 17(11):e0276302 (2022), whose extrinsic sequence is
        this one in reverse.
        """
        x, y, z, w = self.attitude.quaternion_xyzw.tolist()
        q = (-x, -y, -z, w)
        i, j, k = ("xyz".index(axis) for axis in reversed(sequence))
        proper = i == k
        if proper:
            k = 3 - i - j
        sign = (i - j) * (j - k) * (k - i) // 2
        a, b, c, d = q[3], q[i], q[j], q[k] * sign
        if not proper:
            a, b, c, d = a - c, b + d, c + a, d - b
        second = 2.0 * atan2(hypot(c, d), hypot(a, b))
        half_sum, half_difference = atan2(b, a), atan2(d, c)
        if second < GIMBAL_LOCK_RAD:
            first, third = 2.0 * half_sum, 0.0
        elif second > math.pi - GIMBAL_LOCK_RAD:
            first, third = 2.0 * half_difference, 0.0
        else:
            first, third = half_sum + half_difference, half_sum - half_difference
        if not proper:
            first, second = first * sign, second - 0.5 * math.pi
        return _half_turn(first), second, _half_turn(third)


def _half_turn(angle: float) -> float:
    """Return an angle in (−π, π]."""
    return math.pi - (math.pi - angle) % (2.0 * math.pi)


def reported(
    frame: Measurement | None,
    mode: Mode,
    parameters: Mapping[str, ParameterValue],
    conventions: Conventions,
    last: Quaternion,
) -> Reported:
    """Return the attitude of a frame, in the conventions of the unit.

    `last` is the last valid quaternion before it, for the sign of this one.
    """
    if frame is None:
        no_frame = "no_frame" if mode.makes_frames else "not_running"
        return Reported("processing_error" if mode is Mode.ERROR else no_frame)
    if not frame.valid:
        return Reported(frame.reason)
    measured = Attitude(np.array(frame.result.quaternion_xyzw))
    mounting, axes = mounting_turns(parameters), axes_turns(conventions.rows)
    mounted = reduce(Attitude.rotated, mounting, measured)
    attitude = reduce(Attitude.rotated, axes, mounted)
    turns = mounting + axes
    rate = as_triple(_turned(np.array(frame.rate_rad_s), turns))
    return Reported("ok", _in_convention(attitude, conventions, last), rate, attitude, mounted, turns)


def _turned(vector: Array, turns: Sequence[Array]) -> Array:
    """Return a vector (3,) in a frame that has been turned by rotation vectors, one after another."""
    for turn in turns:
        vector = Attitude.identity().rotated(turn).to_sensor(vector)
    return vector


def _in_convention(attitude: Attitude, conventions: Conventions, last: Quaternion) -> Quaternion:
    """Return a quaternion with the direction and sign of the unit's convention."""
    x, y, z, w = as_quaternion(attitude)
    if conventions.quaternion == "attitude":
        x, y, z = -x, -y, -z
    if conventions.scalar_sign == "any" and x * last[0] + y * last[1] + z * last[2] + w * last[3] < 0.0:
        x, y, z, w = -x, -y, -z, -w
    return x, y, z, w


@cache
def axes_turns(rows: tuple[tuple[int, int, int], ...]) -> tuple[Array, ...]:
    """Return the rotation vector from sensor axes to reported axes, radians, for the rows of `Conventions.rows`."""
    matrix = np.array(rows, dtype=np.float64)
    *axis, w = Attitude.from_matrix(matrix.T).quaternion_xyzw.tolist()
    sine = length(np.array(axis))
    return (_read_only(np.array(axis) / sine * 2.0 * atan2(sine, w)),) if sine > 0.0 else ()


def mounting_turns(parameters: Mapping[str, ParameterValue]) -> tuple[Array, ...]:
    """Return the rotation vectors from sensor frame to reported frame, radians; zero angles are omitted.

    The reported frame is the sensor frame turned by alpha about x, then by beta about the new y, then by
    gamma about the new z.
    """
    turns = []
    for axis, name in enumerate(("mounting_alpha", "mounting_beta", "mounting_gamma")):
        angle = np.radians(float(parameters[name]))
        if angle != 0.0:
            turn = np.zeros(3)
            turn[axis] = angle
            turns.append(_read_only(turn))
    return tuple(turns)


def _read_only(vector: Array) -> Array:
    vector.flags.writeable = False
    return vector
