"""Body rates of a feed: taken from its attitudes where it gives none, and held against them where it does.

Attitudes and rates that contradict each other come from another convention: a conjugated quaternion, another order of its
numbers, rates in radians or in another frame. Each message is held against the ones before it, whether those were taken or
not, so that a single jump costs one message and a wrong convention all but the first.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Final

import numpy as np

from starhil.emulator.errors import EmulatorError
from starhil.emulator.truth.source import MAX_RATE_DEG_S, ZERO_RATE, Vector
from starid.attitude import Attitude, rate_between

SHORTEST_S: Final = 1e-9
"""Least time between two messages, seconds: what run time tells apart."""

RECEIPT_BASELINE_S: Final = 0.05
"""Least time over which a rate is taken from times of receipt, seconds: messages may arrive in bunches."""

NOISE_RAD: Final = math.radians(0.01)
"""By how much attitudes may be off without contradicting a rate, radians."""

CONCLUSIVE_RAD: Final = 2.0 * NOISE_RAD
"""Turn from which on it says something about a rate, radians."""

AMBIGUOUS_RAD: Final = 2.0
"""Turn between two messages beyond which its direction says nothing, radians."""

PATIENCE_S: Final = 1.0
"""Time after which a smaller turn is judged too, seconds."""

TIME_FACTOR: Final = 8.0
"""By how much a sender's steps of time may be off: it may repeat an attitude until it has the next."""

DIRECTION_TOLERANCE: Final = 0.5
"""By which part of the expected turn the turn may differ, its length apart."""


class FeedError(EmulatorError):
    """A live message that is refused; the text says why."""


@dataclass(frozen=True)
class _Seen:
    at_s: float
    attitude: Attitude
    rate_rad_s: Vector | None


class FeedRates:
    """Rates of one feed, message by message.

    Parameters
    ----------
    timed
        Whether times are the sender's own; else they are times of receipt, and only the directions of turns are judged.
    """

    def __init__(self, *, timed: bool) -> None:
        self.timed = timed
        self._baseline_s = 0.0 if timed else RECEIPT_BASELINE_S
        self._seen: deque[_Seen] = deque()
        self._rate = ZERO_RATE
        self._reference: _Seen | None = None
        self._expected: Vector = np.zeros(3)
        self._change_rad = 0.0
        self._contradicts = False

    def take(self, at_s: float, attitude: Attitude, given_rad_s: Vector | None) -> Vector:
        """Return the body rate of a message, radians a second of the times that are given.

        Raises
        ------
        FeedError
            The given rate contradicts the attitudes, or the attitude has jumped.
        """
        before = self._seen[-1] if self._seen else None
        message = _Seen(at_s, attitude, given_rad_s)
        rate = given_rad_s
        if rate is None:
            rate = self._from_attitudes(message)
            self._reference = None
        self._seen.append(message)
        if given_rad_s is not None:
            self._hold_against_attitudes(before, message, given_rad_s)
        elif np.abs(rate).max() > math.radians(MAX_RATE_DEG_S):
            raise FeedError(
                f"q jumps by {_degrees(rate)} degrees a second from the message before, "
                f"beyond {MAX_RATE_DEG_S:g}; send smaller steps"
            )
        self._rate = rate
        return rate

    def _from_attitudes(self, message: _Seen) -> Vector:
        seen = self._seen
        while len(seen) > 1 and message.at_s - seen[1].at_s >= self._baseline_s:
            seen.popleft()
        if not seen:
            return ZERO_RATE
        span_s = message.at_s - seen[0].at_s
        if span_s < max(self._baseline_s, SHORTEST_S):
            return self._rate
        return rate_between(seen[0].attitude, message.attitude, span_s)

    def _hold_against_attitudes(self, before: _Seen | None, message: _Seen, rate: Vector) -> None:
        while len(self._seen) > 1:
            self._seen.popleft()
        if self._reference is None or before is None or before.rate_rad_s is None:
            self._begin(message)
            return
        step_s = max(message.at_s - before.at_s, SHORTEST_S)
        self._expected = self._expected + 0.5 * step_s * (before.rate_rad_s + rate)
        self._change_rad += 0.5 * step_s * float(np.linalg.norm(rate - before.rate_rad_s))
        elapsed_s = message.at_s - self._reference.at_s
        turned = rate_between(self._reference.attitude, message.attitude, 1.0)
        size = max(float(np.linalg.norm(turned)), float(np.linalg.norm(self._expected)))
        repeated = np.array_equal(before.attitude.quaternion_xyzw, message.attitude.quaternion_xyzw)
        conclusive = size >= CONCLUSIVE_RAD and not repeated
        if conclusive or elapsed_s >= PATIENCE_S:
            self._contradicts = self._disagree(turned)
        expected = self._expected
        if conclusive or self._contradicts:
            self._begin(message)
        if self._contradicts:
            raise FeedError(
                f"rate contradicts q, which turned by {_degrees(turned)} degrees where rate makes {_degrees(expected)}; "
                "q must be ICRS to sensor as x, y, z, w (else conjugate it), rate in degrees a second in the sensor frame"
            )

    def _disagree(self, turned: Vector) -> bool:
        """Whether no way to go from the reference agrees with the rates given since."""
        length, expected = float(np.linalg.norm(turned)), float(np.linalg.norm(self._expected))
        if max(length, expected) > AMBIGUOUS_RAD:
            return False
        factor = length / expected if expected > 0.0 else 1.0
        if self.timed:
            factor = min(max(factor, 1.0 / TIME_FACTOR), TIME_FACTOR)
        allowed = NOISE_RAD + factor * (self._change_rad + DIRECTION_TOLERANCE * expected)
        return float(np.linalg.norm(turned - factor * self._expected)) > allowed

    def _begin(self, message: _Seen) -> None:
        self._reference = message
        self._expected = np.zeros(3)
        self._change_rad = 0.0


def _degrees(vector: Vector) -> str:
    return "(" + ", ".join(f"{value:.3g}" for value in np.degrees(vector)) + ")"
