"""Faults between a link and its transport: delay, loss, corruption, splitting and junk."""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Callable, Sequence
from typing import Annotated, Final, Generic, Protocol, TypeVar

from pydantic import Field

from starhil.emulator.simulation.clock import Clock
from starhil.emulator.simulation.config_model import Strict
from starhil.emulator.simulation.scheduler import Scheduler
from starhil.protocol.icd.conventions import NANOSECONDS

Item = TypeVar("Item")


MAX_DELAYED: Final = 10_000
"""Number of items that are held back; further ones are lost."""

Probability = Annotated[float, Field(ge=0.0, le=1.0)]
Seconds = Annotated[float, Field(ge=0.0, le=60.0)]


class WireFault(Strict):
    """Faults of a link."""

    drop: Probability = 0.0
    """Probability that an outgoing serial reply or CAN frame is lost."""
    corrupt: Probability = 0.0
    """Probability that one of its bits is flipped."""
    junk: Probability = 0.0
    """Probability that random bytes, or a CAN frame with a random CAN ID, are sent before it."""
    delay_s: Seconds = 0.0
    """Delay of everything that is sent."""
    split: Annotated[int, Field(ge=0, le=4096)] = 0
    """Size of the chunks in which serial replies are sent; 0: not split."""
    gap_s: Seconds = 0.02
    """Pause between the chunks."""

    @property
    def none(self) -> bool:
        return not (self.drop or self.corrupt or self.delay_s or self.split or self.junk)


class Damage(Protocol[Item]):
    """Corrupts items of one kind of link."""

    def corrupt(self, item: Item, rng: random.Random) -> Item:
        """Return the item with one bit flipped."""

    def junk(self, rng: random.Random) -> Item:
        """Return a random item."""

    def split(self, item: Item, size: int, /) -> Sequence[Item]:
        """Split into chunks of `size` bytes, if the link allows it."""


class WireFaults(Generic[Item]):
    """The outgoing side of a link, with its faults; items stay in order. Delays are in simulation time."""

    def __init__(
        self,
        send: Callable[[Item], object],
        damage: Damage[Item],
        clock: Clock,
        scheduler: Scheduler,
        seed: int,
    ) -> None:
        self.settings = WireFault()
        self.listener: Callable[[Item], None] | None = None
        """Called with each item that is sent."""
        self._transmit = send
        self._damage = damage
        self._clock = clock
        self._scheduler = scheduler
        self._rng = random.Random(seed)  # noqa: S311 (faults, not secrets)
        self._held: deque[tuple[int, Item]] = deque()
        """Delayed items, each with the simulation time at which it is sent, nanoseconds."""
        self._free_ns = 0
        self._release_scheduled = False

    @property
    def holds(self) -> bool:
        """Whether delayed items have not been sent yet."""
        return bool(self._held)

    def send(self, item: Item) -> None:
        """Send an item, subject to the current faults."""
        settings, rng = self.settings, self._rng
        if settings.none:
            if self._held:
                self._send_or_hold([item], settings)
            else:
                self._send(item)
            return
        if rng.random() < settings.junk:
            self._send_or_hold([self._damage.junk(rng)], settings)
        if rng.random() < settings.drop:
            return
        if rng.random() < settings.corrupt:
            item = self._damage.corrupt(item, rng)
        self._send_or_hold(self._damage.split(item, settings.split) if settings.split else [item], settings)

    def _send(self, item: Item) -> None:
        if self.listener is not None:
            self.listener(item)
        self._transmit(item)

    def _send_or_hold(self, pieces: Sequence[Item], settings: WireFault) -> None:
        """Send the chunks of an item, after all earlier ones, now or with a delay."""
        now_ns = self._clock.now_ns()
        at_ns = max(now_ns + round(settings.delay_s * NANOSECONDS), self._free_ns)
        gap_ns = round(settings.gap_s * NANOSECONDS) if len(pieces) > 1 else 0
        for piece in pieces:
            if len(self._held) >= MAX_DELAYED:
                break
            if at_ns > now_ns or self._held:
                self._held.append((at_ns, piece))
            else:
                self._send(piece)
            at_ns += gap_ns
        self._free_ns = at_ns
        self._schedule_release()

    def _schedule_release(self) -> None:
        if self._held and not self._release_scheduled:
            self._release_scheduled = True
            self._scheduler.at(self._held[0][0], self._release_due)

    def _release_due(self, _due_ns: int) -> None:
        self._release_scheduled = False
        now_ns = self._clock.now_ns()
        while self._held and self._held[0][0] <= now_ns:
            self._send(self._held.popleft()[1])
        self._schedule_release()
