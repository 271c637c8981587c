"""Recent attitudes of a sensor: its body rate, and the attitude that follows from it."""

from __future__ import annotations

from collections import deque
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from starid.arithmetic.arrays import Array
from starid.arithmetic.elementary import square
from starid.attitude import Attitude, propagate

RATE_SPAN_S: Final = 2.0
"""Age up to which attitudes are used for the rate, seconds; the last two are always used."""


class AttitudeHistory:
    """The last `window` valid attitudes, on any monotonic clock, which counts `per_second` (nanoseconds: 10⁹)."""

    def __init__(self, window: int, per_second: float = 1.0) -> None:
        self._per_second = per_second
        self._fixes: deque[tuple[float, Attitude]] = deque(maxlen=window)
        self._errors: deque[Array] = deque(maxlen=window)
        self._interrupted = False

    def interrupt(self) -> None:
        """End the history with the last attitude: the rate between it and the next one is not that of the motion."""
        self._interrupted = True

    def clear(self) -> None:
        """Discard all attitudes."""
        self._fixes.clear()
        self._errors.clear()
        self._interrupted = False

    @property
    def last(self) -> tuple[float, Attitude] | None:
        """Time and value of the last attitude, or None."""
        return self._fixes[-1] if self._fixes else None

    def add(
        self, at: float, attitude: Attitude, longest_gap_s: float, covariance: Array | None = None
    ) -> None:
        """Add an attitude, with the covariance (3, 3) of its error, rad², if known.

        Older ones are discarded after an interruption, after a longer gap, or if time has not passed.
        """
        follows = self._fixes and 0 < at - self._fixes[-1][0] <= longest_gap_s * self._per_second
        if self._interrupted or not follows:
            self._fixes.clear()
            self._errors.clear()
        self._interrupted = False
        self._fixes.append((at, attitude))
        self._errors.append(np.full((3, 3), np.nan) if covariance is None else covariance)

    def rate(self) -> tuple[float, float, float] | None:
        """Return the least-squares body rate over the attitudes, sensor frame, rad/s; None for fewer than two."""
        if len(self._fixes) < 2:
            return None
        latest, newest = self._fixes[-1]
        recent = [
            (time, attitude)
            for n, (time, attitude) in enumerate(reversed(self._fixes))
            if n < 2 or latest - time <= RATE_SPAN_S * self._per_second
        ]
        times = np.array([(time - latest) / self._per_second for time, _ in recent])
        turns = np.array([attitude.error_to(newest).rotation_vector_rad for _, attitude in recent])
        times -= times.mean()
        x, y, z = (np.sum(times[:, None] * turns, axis=0) / np.sum(square(times))).tolist()
        return (x, y, z)

    def predict(self, at: float, rate_rad_s: ArrayLike | None) -> Attitude | None:
        """Return the attitude at a later time, with a body rate since the last one; without a rate, the last one."""
        if not self._fixes:
            return None
        since, last = self._fixes[-1]
        return last if rate_rad_s is None else propagate(last, rate_rad_s, (at - since) / self._per_second)

    def covariance(self, at: float) -> Array | None:
        """Return the covariance (3, 3), rad², of the error of `predict` with the rate of `rate`; None if it is not known.

        At a constant rate, a line through two attitudes with errors of covariances C₁ and C₂, a time Δ apart, has an error of
        ``(1 + n)² C₂ + n² C₁`` a time n·Δ after the second. More attitudes have less.
        """
        if len(self._fixes) < 2 or at <= self._fixes[-1][0]:
            return None
        before, last = self._fixes[-2][0], self._fixes[-1][0]
        steps = (at - last) / (last - before)
        covariance = square(1.0 + steps) * self._errors[-1] + square(steps) * self._errors[-2]
        return covariance if np.isfinite(covariance).all() else None
