"""Recent attitudes of a sensor: its body rate, and the attitude that follows from it."""

from __future__ import annotations

import math
from collections import deque
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from starid.arithmetic.arrays import Array
from starid.arithmetic.elementary import square
from starid.attitude import Attitude, propagate
from starid.identification.error_risk import combined_freedom

RATE_SPAN_S: Final = 2.0
"""Age up to which attitudes are used for the rate, seconds; the last two are always used."""


class AttitudeHistory:
    """The last `window` valid attitudes, on any monotonic clock, which counts `per_second` (nanoseconds: 10⁹)."""

    def __init__(self, window: int, per_second: float = 1.0) -> None:
        self._per_second = per_second
        self._fixes: deque[tuple[float, Attitude]] = deque(maxlen=window)
        self._errors: deque[tuple[Array, float]] = deque(maxlen=window)
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
        self,
        at: float,
        attitude: Attitude,
        longest_gap_s: float,
        covariance: Array | None = None,
        freedom: float = math.inf,
    ) -> None:
        """Add an attitude, with the covariance (3, 3) of its error, rad², if known, and the degrees of freedom of that.

        Older ones are discarded after an interruption, after a longer gap, or if time has not passed.
        """
        follows = self._fixes and 0 < at - self._fixes[-1][0] <= longest_gap_s * self._per_second
        if self._interrupted or not follows:
            self._fixes.clear()
            self._errors.clear()
        self._interrupted = False
        self._fixes.append((at, attitude))
        self._errors.append((np.full((3, 3), np.nan) if covariance is None else covariance, freedom))

    def rate(self) -> tuple[float, float, float] | None:
        """Return the least-squares body rate over the attitudes, sensor frame, rad/s; None for fewer than two."""
        if len(self._fixes) < 2:
            return None
        _, newest = self._fixes[-1]
        weights = self._rate_weights()
        recent = list(self._fixes)[: -len(weights) - 1 : -1]
        turns = np.array([attitude.error_to(newest).rotation_vector_rad for _, attitude in recent])
        x, y, z = np.sum(weights[:, None] * turns, axis=0).tolist()
        return (x, y, z)

    def _rate_weights(self) -> Array:
        """Weights, 1/s, of the last attitudes in the rate, newest first: those of a straight line fitted to them."""
        latest, _ = self._fixes[-1]
        ages = [(time - latest) / self._per_second for time, _ in reversed(self._fixes)]
        times = np.array([age for n, age in enumerate(ages) if n < 2 or -age <= RATE_SPAN_S])
        times -= times.mean()
        return np.asarray(times / np.sum(square(times)))

    def predict(self, at: float, rate_rad_s: ArrayLike | None) -> Attitude | None:
        """Return the attitude at a later time, with a body rate since the last one; without a rate, the last one."""
        if not self._fixes:
            return None
        since, last = self._fixes[-1]
        return last if rate_rad_s is None else propagate(last, rate_rad_s, (at - since) / self._per_second)

    def uncertainty(self, at: float) -> tuple[Array, float] | None:
        """Return the covariance (3, 3), rad², of the error of `predict` with the rate of `rate`, and its degrees of freedom.

        None if it is not known. At a constant rate the prediction is a sum of the attitudes, with the weights of the rate times the time
        since the last one, and one more for that; their errors are taken to be independent.
        """
        if len(self._fixes) < 2 or at <= self._fixes[-1][0]:
            return None
        weights = self._rate_weights() * ((at - self._fixes[-1][0]) / self._per_second)
        weights[0] += 1.0
        recent = list(self._errors)[: -len(weights) - 1 : -1]
        parts = [
            (square(weight) * covariance, freedom)
            for weight, (covariance, freedom) in zip(weights.tolist(), recent, strict=True)
        ]
        covariance = np.sum([part for part, _ in parts], axis=0)
        return (covariance, combined_freedom(*parts)) if np.isfinite(covariance).all() else None
