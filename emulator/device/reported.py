"""The reported attitude: in the mounting frame, with validity and time."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache, reduce
from itertools import product
from typing import Final

import numpy as np

from starhil.emulator.device.device import Device
from starhil.emulator.device.modes import Mode
from starhil.emulator.device.parameters import Parameters
from starhil.emulator.pipeline.messages import ZERO, Quaternion, Triple, as_quaternion, as_triple
from starid.attitude import Attitude

_IDENTITY: Final = Attitude.identity()

SEQUENCES: Final = tuple(a + b + c for a, b, c in product("xyz", repeat=3) if a != b != c)
"""Sequences of Euler angles: the axes of three rotations, of which no two successive ones are the same."""

GIMBAL_LOCK_RAD: Final = 1e-7
"""With a second Euler angle this near to where the first and third axes coincide, the third angle is 0."""


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

    @property
    def valid(self) -> bool:
        """Whether the attitude is valid."""
        return self.reason == "ok"

    @property
    def rotation_vector_rad(self) -> Triple:
        """Rotation vector of the quaternion in the convention of the unit, of at most π."""
        x, y, z, w = self.quaternion_xyzw
        sine = math.sqrt(x * x + y * y + z * z)
        scale = 2.0 if sine == 0.0 else 2.0 * math.atan2(math.copysign(sine, w), abs(w)) / sine
        return (scale * x, scale * y, scale * z)

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
        second = 2.0 * math.atan2(math.hypot(c, d), math.hypot(a, b))
        half_sum, half_difference = math.atan2(b, a), math.atan2(d, c)
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


def reported(device: Device) -> Reported:
    """Return the currently reported attitude, in the conventions of the unit."""
    last = device.fresh
    if last is None:
        running = device.modes.mode.makes_frames
        failed = device.modes.mode is Mode.ERROR
        return Reported("processing_error" if failed else "no_frame" if running else "not_running")
    if not last.valid:
        return Reported(last.reason)
    measured = Attitude(np.array(last.result.quaternion_xyzw))
    mounting, axes = mounting_turns(device.parameters), axes_turns(device.icd.conventions.rows)
    mounted = reduce(Attitude.rotated, mounting, measured)
    attitude = reduce(Attitude.rotated, axes, mounted)
    rate = as_triple(_turned(np.array(last.rate_rad_s), mounting + axes))
    return Reported("ok", _in_convention(attitude, device), rate, attitude, mounted)


def to_reported_frame(device: Device, vector: np.ndarray) -> np.ndarray:
    """Turn a vector (3,) from the sensor frame to the reported frame."""
    return _turned(vector, mounting_turns(device.parameters) + axes_turns(device.icd.conventions.rows))


def _turned(vector: np.ndarray, turns: list[np.ndarray]) -> np.ndarray:
    """Return a vector (3,) in a frame that has been turned by rotation vectors, one after another."""
    for turn in turns:
        vector = Attitude.identity().rotated(turn).to_sensor(vector)
    return vector


def _in_convention(attitude: Attitude, device: Device) -> Quaternion:
    """Return a quaternion with the direction and sign of the unit's convention."""
    conventions = device.icd.conventions
    x, y, z, w = as_quaternion(attitude)
    if conventions.quaternion == "attitude":
        x, y, z = -x, -y, -z
    if conventions.scalar_sign == "any":
        before = device.reported_quaternion
        if x * before[0] + y * before[1] + z * before[2] + w * before[3] < 0.0:
            x, y, z, w = -x, -y, -z, -w
        device.reported_quaternion = (x, y, z, w)
    return x, y, z, w


@cache
def axes_turns(rows: tuple[tuple[int, int, int], ...]) -> list[np.ndarray]:
    """Return the rotation vector from sensor axes to reported axes, radians, for the rows of `Conventions.rows`."""
    matrix = np.array(rows, dtype=np.float64)
    *axis, w = Attitude.from_matrix(matrix.T).quaternion_xyzw.tolist()
    sine = float(np.linalg.norm(axis))
    return [np.array(axis) / sine * 2.0 * math.atan2(sine, w)] if sine > 0.0 else []


def mounting_turns(parameters: Parameters) -> list[np.ndarray]:
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
            turns.append(turn)
    return turns
