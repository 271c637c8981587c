"""Telemetry that the device sends unasked: lists of rows, each at its rate or with each frame."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from starhil.emulator.clock import NANOSECONDS
from starhil.emulator.device.scheduler import Event, Scheduler
from starhil.protocol.codec import Row


@dataclass(frozen=True)
class Subscription:
    """A telemetry row and its rate, Hz; None: once with each frame."""

    row: Row
    rate_hz: float | None


class Subscriptions:
    """The rows that are sent unasked, and when.

    Attributes
    ----------
    send
        Sends a row now.
    """

    def __init__(self, scheduler: Scheduler, now_ns: Callable[[], int]) -> None:
        self._scheduler = scheduler
        self._now_ns = now_ns
        self._lists: dict[str, Sequence[Subscription]] = {}
        self._events: dict[tuple[str, int], Event] = {}
        self.send: Callable[[Row], None] = lambda _row: None

    def replace(self, origin: str, subscriptions: Sequence[Subscription]) -> None:
        """Replace the list of one origin (a telecommand, or the parameters for it); rates begin now."""
        for key in [key for key in self._events if key[0] == origin]:
            self._events.pop(key).cancel()
        self._lists[origin] = subscriptions
        for number, subscription in enumerate(subscriptions):
            if subscription.rate_hz is not None:
                self._schedule((origin, number), subscription.row, subscription.rate_hz, self._now_ns())

    def clear(self) -> None:
        """Forget all lists, as the device restarts."""
        for origin in list(self._lists):
            self.replace(origin, ())

    def frame_published(self) -> None:
        """Send the rows that go with each frame."""
        for subscriptions in list(self._lists.values()):
            for subscription in subscriptions:
                if subscription.rate_hz is None:
                    self.send(subscription.row)

    def _schedule(self, key: tuple[str, int], row: Row, rate_hz: float, due_ns: int) -> None:
        period_ns = max(1, round(NANOSECONDS / rate_hz))

        def due(at_ns: int) -> None:
            missed = max(0, (self._now_ns() - at_ns) // period_ns)
            self._schedule(key, row, rate_hz, at_ns + (missed + 1) * period_ns)
            self.send(row)

        self._events[key] = self._scheduler.at(due_ns, due)
