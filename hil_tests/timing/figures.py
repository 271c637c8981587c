"""Figures of a link under load."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass


def percentile(values: Sequence[float], part: float) -> float:
    """Return a percentile of values by the nearest rank, NaN without values; `part` is 0 to 1."""
    if not values:
        return math.nan
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, max(0, math.ceil(part * len(ordered)) - 1))]


@dataclass(frozen=True)
class Spread:
    """Median, 99th percentile and maximum of durations in milliseconds."""

    p50_ms: float
    p99_ms: float
    max_ms: float

    @classmethod
    def of(cls, seconds: Sequence[float]) -> Spread:
        """Summarise the finite durations in seconds; NaN if there are none."""
        found = list(filter(math.isfinite, seconds))
        return cls(*(round(1e3 * percentile(found, part), 3) for part in (0.5, 0.99, 1.0)))


@dataclass(frozen=True)
class CanLoad:
    """A CAN bus under load."""

    seconds: float
    offered_per_s: float
    """Frames per second of the other traffic, as sent."""
    sent: int
    lost: int
    """Frames of the other traffic that did not arrive."""
    disordered: int
    requests: int
    unanswered: int
    wrong: int
    """Refusals, replies with a wrong length or value, and framing faults."""
    latency: Spread
    machine: Spread
    """Latency of an echo process on the same bus, which is caused by the machine."""

    @property
    def good(self) -> bool:
        """Whether nothing was lost and every reply was right."""
        return not (self.lost or self.disordered or self.unanswered or self.wrong) and self.requests > 0


@dataclass(frozen=True)
class SerialLoad:
    """A serial line busy in both directions."""

    seconds: float
    baud: int
    sent_bytes: int
    received_bytes: int
    sent_share: float
    """Fraction of the line's capacity that was used, 0 to 1."""
    received_share: float
    exchanges: int
    wrong: int
    """Wrong replies, framing faults, and error flags reported by the device."""

    @property
    def good(self) -> bool:
        """Whether every exchange was right."""
        return self.wrong == 0 and self.exchanges > 0


@dataclass(frozen=True)
class Jitter:
    """Regularity of a periodic message."""

    what: str
    period_ms: float
    """Mean interval."""
    messages: int
    deviation: Spread
    """Deviation of each interval from the mean."""
