"""Faults of the wire, laid between a link and its transport: delayed, dropped, corrupted, split replies, and junk."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

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
    """The outgoing side of a wire, as bad as it is told to be.

    Parameters
    ----------
    send
        Where undamaged pieces go.
    pieces
        How pieces of this wire are damaged.
    call_later
        Runs a function after some seconds.
    seed
        Seed of what goes wrong.
    """

    def __init__(
        self,
        send: Callable[[Item], object],
        pieces: Pieces[Item],
        call_later: Callable[[float, Callable[[], None]], object],
        seed: int,
    ) -> None:
        self.settings = WireFaultSettings()
        self.dropped = self.corrupted = 0
        self._send = send
        self._pieces = pieces
        self._call_later = call_later
        self._rng = random.Random(seed)  # noqa: S311 (faults, not secrets)

    def send(self, item: Item) -> None:
        """Send a piece, or what becomes of it."""
        settings, rng = self.settings, self._rng
        if settings.none:
            self._send(item)
            return
        if rng.random() < settings.junk:
            self._after(settings.delay_s, self._pieces.junk(rng))
        if rng.random() < settings.drop:
            self.dropped += 1
            return
        if rng.random() < settings.corrupt:
            self.corrupted += 1
            item = self._pieces.corrupt(item, rng)
        parts = self._pieces.split(item, settings.split) if settings.split else [item]
        for number, part in enumerate(parts):
            self._after(settings.delay_s + number * settings.gap_s, part)

    def _after(self, seconds: float, item: Item) -> None:
        def send() -> None:
            self._send(item)

        if seconds > 0.0:
            self._call_later(seconds, send)
        else:
            send()
