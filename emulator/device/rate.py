"""Estimation of the body rate from recent attitudes."""

from __future__ import annotations

from collections import deque
from typing import Final

import numpy as np

from starhil.emulator.sensor.pipeline.messages import Triple
from starhil.protocol.icd.conventions import NANOSECONDS
from starid.attitude import Attitude

HISTORY: Final = 10
RATE_GAP_PERIODS: Final = 2.5
RATE_SPAN_S: Final = 2.0
"""Age up to which attitudes are used for the rate, seconds; the last two are always used."""


class RateEstimator:
    """Estimates the body rate from recent valid attitudes."""

    def __init__(self) -> None:
        self._fixes: deque[tuple[int, Attitude]] = deque(maxlen=HISTORY)
        self._interrupted = False

    def interrupt(self) -> None:
        """End the history with the last attitude: the rate between it and the next one is not that of the motion."""
        self._interrupted = True

    def clear(self) -> None:
        """Discard all attitudes."""
        self._fixes.clear()
        self._interrupted = False

    @property
    def last(self) -> tuple[int, Attitude] | None:
        """Simulation time in nanoseconds and value of the last attitude, or None."""
        return self._fixes[-1] if self._fixes else None

    def add(self, mid_ns: int, attitude: Attitude, period_s: float) -> None:
        """Add a valid attitude; after an interruption or a gap of more than `RATE_GAP_PERIODS`, older ones are discarded."""
        late = self._fixes and mid_ns - self._fixes[-1][0] > RATE_GAP_PERIODS * period_s * NANOSECONDS
        if late or self._interrupted:
            self._fixes.clear()
        self._interrupted = False
        self._fixes.append((mid_ns, attitude))

    def rate(self, window: int) -> Triple | None:
        """Return the least-squares rate over the last `window` attitudes, rad/s; None for fewer than two."""
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
