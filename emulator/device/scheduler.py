"""The order of events in run time: what happens next, and what is due.

The real clock's loop sleeps until the next event; the stepped clock goes from event to event. Both call the same actions in
the same order.
"""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeAlias

Action: TypeAlias = Callable[[int], None]
"""Called with the run time at which the event was due, nanoseconds."""


@dataclass(order=True)
class Event:
    """An action at a run time; equal times keep the order of their entry."""

    due_ns: int
    order: int
    action: Action = field(compare=False)
    cancelled: bool = field(default=False, compare=False)

    def cancel(self) -> None:
        """Take the event out; nothing happens if it has passed."""
        self.cancelled = True


class Scheduler:
    """A queue of events in run time."""

    def __init__(self) -> None:
        self._queue: list[Event] = []
        self._order = itertools.count()
        self.on_change: Callable[[], None] | None = None
        """Called when an event was entered, so that a sleeping loop looks anew."""

    def at(self, due_ns: int, action: Action) -> Event:
        """Enter an action at a run time."""
        event = Event(due_ns, next(self._order), action)
        heapq.heappush(self._queue, event)
        if self.on_change is not None:
            self.on_change()
        return event

    def next_due_ns(self) -> int | None:
        """Run time of the next event, or None if there is none."""
        while self._queue and self._queue[0].cancelled:
            heapq.heappop(self._queue)
        return self._queue[0].due_ns if self._queue else None

    def pop_due(self, now_ns: int) -> Event | None:
        """Take out the next event that is due at `now_ns`, or None."""
        due_ns = self.next_due_ns()
        if due_ns is None or due_ns > now_ns:
            return None
        return heapq.heappop(self._queue)
