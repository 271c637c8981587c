"""Faults of the wire, laid between a link and its transport: delayed, dropped, corrupted, split replies, and junk."""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

from starhil.emulator.clock import NANOSECONDS, Clock
from starhil.emulator.device.scheduler import Scheduler

Item = TypeVar("Item")


@dataclass(frozen=True)
class WireFaultSettings:
    """What goes wrong on a wire.

    Attributes
    ----------
    drop, corrupt
        Chance that an outgoing piece (a serial reply, a CAN frame) is lost, or has one bit turned.
    delay_s
        Time that every outgoing piece is held back, seconds.
    split
        A serial reply leaves in pieces of this many bytes with `gap_s` between them; 0: whole.
    gap_s
        Pause between the pieces of a split reply, seconds.
    junk
        Chance that random bytes (serial) or a frame with a random identifier (CAN) go before a piece.
    """

    drop: float = 0.0
    corrupt: float = 0.0
    delay_s: float = 0.0
    split: int = 0
    gap_s: float = 0.02
    junk: float = 0.0

    @property
    def none(self) -> bool:
        """Whether nothing goes wrong."""
        return not (self.drop or self.corrupt or self.delay_s or self.split or self.junk)


class Pieces(Protocol[Item]):
    """How pieces of one kind of wire are damaged."""

    def corrupt(self, item: Item, rng: random.Random) -> Item:
        """Turn one bit."""

    def junk(self, rng: random.Random) -> Item:
        """Make something that nobody sent."""

    def split(self, item: Item, size: int) -> Sequence[Item]:
        """Cut into pieces."""


class WireFaults(Generic[Item]):
    """The outgoing side of a wire, as bad as it is told to be. What is held back leaves in the order in which it came.

    Parameters
    ----------
    send
        Where undamaged pieces go.
    pieces
        How pieces of this wire are damaged.
    clock, scheduler
        The device's: what is held back leaves in run time, so that it does at the same frames whatever the clock.
    seed
        Seed of what goes wrong.
    """

    def __init__(
        self,
        send: Callable[[Item], object],
        pieces: Pieces[Item],
        clock: Clock,
        scheduler: Scheduler,
        seed: int,
    ) -> None:
        self.settings = WireFaultSettings()
        self.dropped = self.corrupted = 0
        self._send = send
        self._pieces = pieces
        self._clock = clock
        self._scheduler = scheduler
        self._rng = random.Random(seed)  # noqa: S311 (faults, not secrets)
        self._waiting: deque[tuple[int, Item]] = deque()
        """What is held back, with the run time at which it leaves, nanoseconds."""
        self._free_ns = 0
        self._awaited = False

    def send(self, item: Item) -> None:
        """Send a piece, or what becomes of it."""
        settings, rng = self.settings, self._rng
        if settings.none:
            if self._waiting:
                self._leave([item], settings)
            else:
                self._send(item)
            return
        if rng.random() < settings.junk:
            self._leave([self._pieces.junk(rng)], settings)
        if rng.random() < settings.drop:
            self.dropped += 1
            return
        if rng.random() < settings.corrupt:
            self.corrupted += 1
            item = self._pieces.corrupt(item, rng)
        self._leave(self._pieces.split(item, settings.split) if settings.split else [item], settings)

    def _leave(self, parts: Sequence[Item], settings: WireFaultSettings) -> None:
        """Let the parts of one piece go, behind all that was sent before."""
        now_ns = self._clock.now_ns()
        at_ns = max(now_ns + round(settings.delay_s * NANOSECONDS), self._free_ns)
        gap_ns = round(settings.gap_s * NANOSECONDS) if len(parts) > 1 else 0
        for part in parts:
            if at_ns > now_ns or self._waiting:
                self._waiting.append((at_ns, part))
            else:
                self._send(part)
            at_ns += gap_ns
        self._free_ns = at_ns
        self._await()

    def _await(self) -> None:
        if self._waiting and not self._awaited:
            self._awaited = True
            self._scheduler.at(self._waiting[0][0], self._send_due)

    def _send_due(self, _due_ns: int) -> None:
        self._awaited = False
        now_ns = self._clock.now_ns()
        while self._waiting and self._waiting[0][0] <= now_ns:
            self._send(self._waiting.popleft()[1])
        self._await()
