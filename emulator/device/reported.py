"""The reported attitude: in the mounting frame, with validity and time."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np

from starhil.emulator.clock import NANOSECONDS
from starhil.emulator.device.device import Device
from starhil.emulator.device.measurement import as_quaternion
from starhil.emulator.device.modes import Mode
from starhil.emulator.device.parameters import Parameters
from starhil.emulator.pipeline.messages import ZERO, Quaternion, Triple
from starhil.protocol.conventions import SENSOR_AXES, Conventions
from starid.attitude import Attitude


@dataclass(frozen=True)
class Reported:
    """Reported attitude and rate.

    Attributes
    ----------
    valid, reason
        Whether the attitude is valid, and the reason if not.
    quaternion_xyzw
        ICRS → reported frame in the convention of the unit, scalar last; zeros if invalid.
    rate_rad_s
        Body rate in the reported frame, rad/s; zeros if unknown.
    mid_unix_s
        Unix time of mid-exposure on the device's clock, seconds.
    """

    valid: bool
    reason: str
    quaternion_xyzw: Quaternion = (0.0, 0.0, 0.0, 0.0)
    rate_rad_s: Triple = ZERO
    mid_unix_s: float = 0.0


def reported(device: Device) -> Reported:
    """Return the currently reported attitude, in the conventions of the unit."""
    last = device.fresh
    if last is None:
        running = device.modes.mode.makes_frames
        failed = device.modes.mode is Mode.ERROR
        return Reported(False, "processing_error" if failed else "no_frame" if running else "not_running")  # noqa: FBT003
    mid_unix_s = last.mid_unix_ns / NANOSECONDS
    if not last.valid:
        return Reported(False, last.reason, mid_unix_s=mid_unix_s)  # noqa: FBT003
    attitude = Attitude(np.array(last.result.quaternion_xyzw))
    rate = np.array(last.rate_rad_s)
    turns = _turns(device)
    for turn in turns:
        attitude = attitude.rotated(turn)
        rate = Attitude.identity().rotated(turn).to_sensor(rate)
    x, y, z = rate.tolist()
    return Reported(True, "ok", _in_convention(attitude, device), (x, y, z), mid_unix_s)  # noqa: FBT003


def to_reported_frame(device: Device, vector: np.ndarray) -> np.ndarray:
    """Turn a vector (3,) from the sensor frame to the reported frame."""
    for turn in _turns(device):
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


def _turns(device: Device) -> list[np.ndarray]:
    """Return the rotation vectors from the sensor frame to the reported frame: mounting, then axes."""
    turns, conventions = mounting_turns(device.parameters), device.icd.conventions
    return turns if conventions.axes == SENSOR_AXES else turns + axes_turns(conventions)


@cache
def axes_turns(conventions: Conventions) -> list[np.ndarray]:
    """Return the rotation vector from sensor axes to reported axes, radians."""
    matrix = np.array(conventions.rows, dtype=np.float64)
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
