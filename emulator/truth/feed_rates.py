"""Body rates of a live feed: derived from its attitudes, or checked against them.

Contradictions between attitudes and rates reveal a wrong convention: a conjugated or reordered quaternion, rates in
radians or in another frame. Each message is checked against earlier ones, whether accepted or not, so a single jump
causes one rejection, and a wrong convention causes the rejection of all messages except the first.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Final

import numpy as np

from starhil.emulator.errors import EmulatorError
from starhil.emulator.truth.source import MAX_RATE_DEG_S, ZERO_RATE, Vector
from starid.arithmetic.matrices import length
from starid.attitude import Attitude, rate_between

SHORTEST_S: Final = 1e-9
"""Shortest time between two messages, seconds: the resolution of simulation time."""

RECEIPT_BASELINE_S: Final = 0.05
"""Shortest time over which a rate is derived from times of receipt, seconds; longer than a burst."""

NOISE_RAD: Final = math.radians(0.01)
"""Tolerated error of attitudes in comparisons with a rate, radians."""

CONCLUSIVE_RAD: Final = 2.0 * NOISE_RAD
"""Smallest rotation that is compared with a rate immediately, radians."""

AMBIGUOUS_RAD: Final = 2.0
"""Rotation between two messages above which its direction is ambiguous, radians."""

PATIENCE_S: Final = 1.0
"""Time after which smaller rotations are compared too, seconds."""

TIME_FACTOR: Final = 8.0
"""Tolerated factor of a sender's time steps, because it may repeat an attitude until the next is computed."""

DIRECTION_TOLERANCE: Final = 0.5
"""Tolerated difference in direction, as a fraction of the expected rotation."""


class FeedError(EmulatorError):
    """A rejected message of a live feed; the text gives the reason."""


@dataclass(frozen=True)
class _Message:
    at_s: float
    attitude: Attitude
    rate_rad_s: Vector | None


class FeedRates:
    """Derives and checks the body rates of one feed, message by message.

    Times are from the sender's clock if `timed`; otherwise they are times of receipt, and only the directions of
    rotations are checked.
    """

    def __init__(self, *, timed: bool) -> None:
        self.timed = timed
        self._baseline_s = 0.0 if timed else RECEIPT_BASELINE_S
        self._seen: deque[_Message] = deque()
        self._rate = ZERO_RATE
        self._reference: _Message | None = None
        self._expected: Vector = np.zeros(3)
        self._change_rad = 0.0
        self._contradicts = False

    def body_rate(self, at_s: float, attitude: Attitude, given_rad_s: Vector | None) -> Vector:
        """Return the body rate in the next message, rad/s on the time scale of `at_s`.

        FeedError if the given rate contradicts the attitudes, or the attitude has jumped.
        """
        before = self._seen[-1] if self._seen else None
        message = _Message(at_s, attitude, given_rad_s)
        rate = given_rad_s
        if rate is None:
            rate = self._from_attitudes(message)
            self._reference = None
        self._seen.append(message)
        if given_rad_s is not None:
            self._check_against_attitudes(before, message, given_rad_s)
        elif np.abs(rate).max() > math.radians(MAX_RATE_DEG_S):
            raise FeedError(
                f"q jumps by {_degrees(rate)} degrees per second from the previous message, "
                f"more than {MAX_RATE_DEG_S:g}; send smaller steps"
            )
        self._rate = rate
        return rate

    def _from_attitudes(self, message: _Message) -> Vector:
        messages = self._seen
        while len(messages) > 1 and message.at_s - messages[1].at_s >= self._baseline_s:
            messages.popleft()
        if not messages:
            return ZERO_RATE
        span_s = message.at_s - messages[0].at_s
        if span_s < max(self._baseline_s, SHORTEST_S):
            return self._rate
        return rate_between(messages[0].attitude, message.attitude, span_s)

    def _check_against_attitudes(self, before: _Message | None, message: _Message, rate: Vector) -> None:
        while len(self._seen) > 1:
            self._seen.popleft()
        if self._reference is None or before is None or before.rate_rad_s is None:
            self._set_reference(message)
            return
        step_s = max(message.at_s - before.at_s, SHORTEST_S)
        self._expected = self._expected + 0.5 * step_s * (before.rate_rad_s + rate)
        self._change_rad += 0.5 * step_s * length(rate - before.rate_rad_s)
        elapsed_s = message.at_s - self._reference.at_s
        turned = rate_between(self._reference.attitude, message.attitude, 1.0)
        size = max(length(turned), length(self._expected))
        repeated = np.array_equal(before.attitude.quaternion_xyzw, message.attitude.quaternion_xyzw)
        conclusive = size >= CONCLUSIVE_RAD and not repeated
        if conclusive or elapsed_s >= PATIENCE_S:
            self._contradicts = self._disagree(turned)
        expected = self._expected
        if conclusive or self._contradicts:
            self._set_reference(message)
        if self._contradicts:
            raise FeedError(
                f"rate contradicts q, which turned by {_degrees(turned)} degrees instead of {_degrees(expected)}; "
                "q must be ICRS to body as x, y, z, w (else set truth.convention and truth.order, or conjugate it), "
                "rate in degrees per second in the body frame"
            )

    def _disagree(self, turned: Vector) -> bool:
        """Return whether the rotation since the reference contradicts the received rates."""
        seen, expected = length(turned), length(self._expected)
        if max(seen, expected) > AMBIGUOUS_RAD:
            return False
        factor = seen / expected if expected > 0.0 else 1.0
        if self.timed:
            factor = min(max(factor, 1.0 / TIME_FACTOR), TIME_FACTOR)
        allowed = NOISE_RAD + factor * (self._change_rad + DIRECTION_TOLERANCE * expected)
        return length(turned - factor * self._expected) > allowed

    def _set_reference(self, message: _Message) -> None:
        self._reference = message
        self._expected = np.zeros(3)
        self._change_rad = 0.0


def _degrees(vector: Vector) -> str:
    return "(" + ", ".join(f"{value:.3g}" for value in np.round(np.degrees(vector), 6) + 0.0) + ")"
