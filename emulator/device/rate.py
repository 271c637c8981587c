"""The body rate, from the attitudes of the last frames."""

from __future__ import annotations

from collections import deque
from typing import Final

import numpy as np

from starhil.emulator.clock import NANOSECONDS
from starhil.emulator.pipeline.messages import Triple
from starid.attitude import Attitude

HISTORY: Final = 10
RATE_GAP_PERIODS: Final = 2.5
RATE_SPAN_S: Final = 2.0
"""Time back to which attitudes count for the rate, seconds; the last two always count."""


class RateEstimator:
    """Body rate from the attitudes of the last valid frames."""

    def __init__(self) -> None:
        self._fixes: deque[tuple[int, Attitude]] = deque(maxlen=HISTORY)

    def clear(self) -> None:
        """Forget all."""
        self._fixes.clear()

    @property
    def last(self) -> tuple[int, Attitude] | None:
        """The last valid attitude and its time, or None."""
        return self._fixes[-1] if self._fixes else None

    def add(self, mid_ns: int, attitude: Attitude, period_s: float) -> None:
        """Take in a valid attitude; after a gap of more than `RATE_GAP_PERIODS` the ones before it say nothing."""
        if self._fixes and mid_ns - self._fixes[-1][0] > RATE_GAP_PERIODS * period_s * NANOSECONDS:
            self._fixes.clear()
        self._fixes.append((mid_ns, attitude))

    def rate(self, window: int) -> Triple | None:
        """Least-squares rate, radians a second, over the last `window` fixes; None from fewer than two."""
        if len(self._fixes) < 2:
            return None
        newest_ns, newest = self._fixes[-1]
        recent = [
            (ns, attitude)
            for n, (ns, attitude) in enumerate(reversed(self._fixes))
            if n < 2 or (n < window and (newest_ns - ns) <= RATE_SPAN_S * NANOSECONDS)
        ]
        times = np.array([(ns - newest_ns) / NANOSECONDS for ns, _ in recent])
        turns = np.array([attitude.error_to(newest).rotation_vector_rad for _, attitude in recent])
        times -= times.mean()
        x, y, z = (times @ turns / (times @ times)).tolist()
        return (x, y, z)
