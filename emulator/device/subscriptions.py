"""Unsolicited telemetry: lists of rows, each sent at a rate or with each frame."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

from starhil.emulator.clock import NANOSECONDS
from starhil.emulator.device.scheduler import Event, Scheduler
from starhil.protocol.codec import Row

LONGEST_PERIOD_NS: Final = 1e18
"""Period of a row whose rate is hardly above zero, nanoseconds: longer than any run."""


@dataclass(frozen=True)
class Subscription:
    """A telemetry row and its rate, Hz; None: with each frame."""

    row: Row
    rate_hz: float | None


class Subscriptions:
    """Schedule of the rows that are sent unsolicited.

    Attributes
    ----------
    send
        Sends a row.
    """

    def __init__(self, scheduler: Scheduler, now_ns: Callable[[], int]) -> None:
        self._scheduler = scheduler
        self._now_ns = now_ns
        self._lists: dict[str, Sequence[Subscription]] = {}
        self._events: dict[tuple[str, int], Event] = {}
        self.send: Callable[[Row], None] = lambda _row: None

    def replace(self, origin: str, subscriptions: Sequence[Subscription]) -> None:
        """Replace the list of one origin (a telecommand, or parameters) from now on."""
        for key in [key for key in self._events if key[0] == origin]:
            self._events.pop(key).cancel()
        self._lists[origin] = subscriptions
        for number, subscription in enumerate(subscriptions):
            if subscription.rate_hz is not None:
                self._schedule((origin, number), subscription.row, subscription.rate_hz, self._now_ns())

    def clear(self) -> None:
        """Discard all lists, because the device restarts."""
        for origin in list(self._lists):
            self.replace(origin, ())

    def frame_published(self) -> None:
        """Send the rows that are due with each frame."""
        for subscriptions in list(self._lists.values()):
            for subscription in subscriptions:
                if subscription.rate_hz is None:
                    self.send(subscription.row)

    def _schedule(self, key: tuple[str, int], row: Row, rate_hz: float, due_ns: int) -> None:
        period_ns = max(1, round(min(NANOSECONDS / rate_hz, LONGEST_PERIOD_NS)))

        def due(at_ns: int) -> None:
            missed = max(0, (self._now_ns() - at_ns) // period_ns)
            self._schedule(key, row, rate_hz, at_ns + (missed + 1) * period_ns)
            self.send(row)

        self._events[key] = self._scheduler.at(due_ns, due)
