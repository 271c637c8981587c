"""A queue of events in simulation time.

A real clock sleeps until the next event, the stepped clock jumps from event to event. Both run the same actions in
the same order.
"""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import TypeAlias

from starhil.emulator.simulation.signal import Signal

Action: TypeAlias = Callable[[int], None]
"""Called with the simulation time at which the event was due, nanoseconds."""


@dataclass(order=True)
class Event:
    """An action at a simulation time; simultaneous events run in the order in which they were added."""

    due_ns: int
    order: int
    action: Action = field(compare=False)
    cancelled: bool = field(default=False, compare=False)

    def cancel(self) -> None:
        """Cancel the event; a past event is not affected."""
        self.cancelled = True


class Scheduler:
    """A queue of events, ordered by simulation time."""

    def __init__(self) -> None:
        self._queue: list[Event] = []
        self._order = itertools.count()
        self.added = Signal[Event]("event added")
        """An event was added, so that a sleeping loop may have to wake up earlier."""

    @property
    def count(self) -> int:
        """Number of events in the queue, cancelled ones included."""
        return len(self._queue)

    def at(self, due_ns: int, action: Action) -> Event:
        """Schedule an action at a simulation time, nanoseconds."""
        event = Event(due_ns, next(self._order), action)
        heapq.heappush(self._queue, event)
        self.added.emit(event)
        return event

    def add(self, events: Iterable[tuple[int, Action]]) -> None:
        """Schedule actions, each with its simulation time in nanoseconds."""
        for due_ns, action in events:
            self.at(due_ns, action)

    def next_due_ns(self) -> int | None:
        """Return the time of the next event, nanoseconds, or None."""
        while self._queue and self._queue[0].cancelled:
            heapq.heappop(self._queue)
        return self._queue[0].due_ns if self._queue else None

    def pop_due(self, now_ns: int) -> Event | None:
        """Remove and return the next event that is due at `now_ns`, or None."""
        due_ns = self.next_due_ns()
        if due_ns is None or due_ns > now_ns:
            return None
        return heapq.heappop(self._queue)
