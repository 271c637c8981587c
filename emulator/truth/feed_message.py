"""Messages of a live feed, and their format as JSON lines.

::

    {"t": 12.25, "q": [0.0, 0.0, 0.0, 1.0], "rate": [0.0, 0.3, 0.0]}

``t``
    Seconds on the sender's clock, increasing. Optional; default: time of receipt.
``q``
    Quaternion between ICRS and body, of length 1 within 1 %. With ``convention = "rotation"`` it rotates vectors
    (v_body = q ⊗ v_icrs ⊗ q*), with ``"attitude"`` it is the conjugate, like the attitude quaternions of 42,
    Basilisk and most textbooks. ``order`` is ``"xyzw"`` (scalar last) or ``"wxyz"``.
``rate``
    Body rate in the body frame, degrees per second, at most `MAX_RATE_DEG_S` per axis. Optional;
    default: derived from the last two messages, or without ``t`` from messages at least
    `starhil.emulator.truth.feed_rates.RECEIPT_BASELINE_S` apart.
``position_m``, ``velocity_m_s``
    Position and velocity in GCRS (Earth-centred, axes of ICRS), metres and metres per second. Optional, but only
    together.
``unix_s``
    Date from 1970 to 2100, as Unix time. Optional; default: the date of the run.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np

from starhil.emulator.truth.feed_rates import FeedError
from starhil.emulator.truth.json_lines import JsonError, parse_object
from starhil.emulator.truth.orbit import OrbitState
from starhil.emulator.truth.source import MAX_RATE_DEG_S, Vector
from starid.arithmetic.matrices import length
from starid.attitude import Attitude
from starid.catalog.earth import LATEST_UNIX_S

NORM_TOLERANCE: Final = 0.01
"""Largest error of the length of a quaternion that is attributed to rounding."""

KEYS: Final = ("t", "q", "rate", "position_m", "velocity_m_s", "unix_s")

Convention = Literal["rotation", "attitude"]
Order = Literal["xyzw", "wxyz"]


@dataclass(frozen=True)
class FeedMessage:
    """A decoded message."""

    t: float | None
    """Seconds on the sender's clock, or None."""
    attitude: Attitude
    """ICRS→body."""
    rate_rad_s: Vector | None = None
    """Body rate (3,), rad/s, body frame, or None."""
    orbit: OrbitState | None = None
    unix_s: float | None = None


@dataclass(frozen=True)
class JsonFormat:
    """JSON objects, one per line; see the module docstring."""

    convention: Convention = "rotation"
    order: Order = "xyzw"
    end: bytes = b"\n"
    """Bytes that end a message in a stream."""
    max_size: int = 4096
    """Longest accepted message, bytes."""
    always_answers: bool = False
    """Whether the sender expects an answer even without lock-step."""

    def decode(self, data: bytes | str) -> FeedMessage:
        """Decode one line; FeedError names the key that is invalid."""
        try:
            message = parse_object(data)
        except JsonError as error:
            raise FeedError(str(error)) from None
        unknown = sorted(set(message) - set(KEYS))
        if unknown:
            raise FeedError(f"unknown key {unknown[0]!r}; known: {', '.join(KEYS)}")
        if "q" not in message:
            raise FeedError("q is missing")
        quaternion = _numbers("q", message["q"], 4)
        if self.order == "wxyz":
            quaternion = np.roll(quaternion, -1)
        rate = _optional(message, "rate", 3)
        t, unix_s = (_optional_number(message, key) for key in ("t", "unix_s"))
        position, velocity = (_optional(message, key, 3) for key in ("position_m", "velocity_m_s"))
        if (position is None) != (velocity is None):
            raise FeedError("position_m and velocity_m_s: give both or none")
        return FeedMessage(
            t,
            checked_attitude("q", quaternion, self.convention),
            checked_rate("rate", None if rate is None else np.radians(rate)),
            None if position is None or velocity is None else OrbitState(position, velocity),
            checked_date("unix_s", unix_s),
        )

    def answer(self, run_time_s: float, fault: str) -> bytes:
        """Return a line with `ok`, the simulation time, and the fault of a rejected message."""
        body = {"ok": not fault, "run_time_s": run_time_s, **({"error": fault} if fault else {})}
        return json.dumps(body).encode() + b"\n"


def checked_attitude(key: str, quaternion_xyzw: Vector, convention: Convention) -> Attitude:
    """Return the attitude of a scalar-last quaternion (4,); FeedError if it is not of length 1."""
    if not abs(length(np.array(quaternion_xyzw)) - 1.0) <= NORM_TOLERANCE:
        raise FeedError(f"{key} is not of length 1")
    if convention == "attitude":
        quaternion_xyzw = quaternion_xyzw * [-1.0, -1.0, -1.0, 1.0]
    return Attitude(quaternion_xyzw)


def checked_rate(key: str, rate_rad_s: Vector | None) -> Vector | None:
    """Return a body rate in rad/s; FeedError if it is above `MAX_RATE_DEG_S`."""
    if rate_rad_s is not None and not np.degrees(np.abs(rate_rad_s).max()) <= MAX_RATE_DEG_S * (1.0 + 1e-12):
        raise FeedError(f"{key} exceeds {MAX_RATE_DEG_S:g} degrees per second")
    return rate_rad_s


def checked_date(key: str, unix_s: float | None) -> float | None:
    """Return a date as Unix time; FeedError if the sky is not computed for it."""
    if unix_s is not None and not 0.0 <= unix_s <= LATEST_UNIX_S:
        raise FeedError(f"{key} is not a date from 1970 to 2100")
    return unix_s


def _optional(message: dict[str, Any], key: str, count: int) -> Vector | None:
    value = message.get(key)
    return None if value is None else _numbers(key, value, count)


def _optional_number(message: dict[str, Any], key: str) -> float | None:
    value = message.get(key)
    return None if value is None else float(_numbers(key, [value], 1)[0])


def _numbers(key: str, value: object, count: int) -> Vector:
    if not isinstance(value, list) or len(value) != count:
        raise FeedError(f"{key} is not {count} numbers")
    for number in value:
        if isinstance(number, bool) or not isinstance(number, (int, float)) or not abs(number) < 1e15:
            raise FeedError(f"{key}: {number!r} is not a finite number")
    return np.array(value, dtype=np.float64)
