"""A connected console page: its subscriptions, and what it lacks.

What a page needs is sent in turns, each of them one message, and the next turn when the page has acknowledged the last:
nothing queues in buffers on the way, so that over a slow link a page loses images and parts of the trace, but what it shows is
young, and no number of a frame is lost. Numbers of frames and events that a page lacks are sent newest first.

A turn is the size of a JSON object (u32), the object, blocks of rows of the history, and an image (JPEG).
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
import struct
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final, Protocol

from starhil.emulator.console.history import History, Image

QUEUE_LIMIT: Final = 1000
"""Send-queue limit; the oldest messages are dropped."""

WAIT_ABOVE: Final = 20
"""Number of queued messages above which the requests of a page wait."""

BEAT_S: Final = 0.25
"""Longest time between two turns to a page that acknowledges them, seconds: by it a page knows how old what it shows is."""

PAUSE_S: Final = 0.2
"""Shortest time between two turns to a page that lacks nothing of the past, seconds: each makes the page draw."""

TURN_TEXT: Final = 32 * 1024
"""Length of queued messages above which the rest waits for the next turn, characters."""

TURN_ROWS: Final = 100
"""Maximum number of rows of the history in a turn: 15 kB."""

TURN_ITEMS: Final = 200
"""Maximum number of items of the trace, or of events, in a turn."""


class Socket(Protocol):
    """The method of a WebSocket that a viewer uses."""

    async def send_bytes(self, data: bytes, /) -> None:
        """Send a binary message."""


class Log(Protocol):
    """A log of numbered items, of which the latest are kept."""

    @property
    def start(self) -> int:
        """Number of the first item that is kept."""

    @property
    def end(self) -> int:
        """Number of the next item."""

    def texts(self, numbers: range) -> list[str]:
        """Return items as JSON."""


@dataclass
class Lacking:
    """The items of a log that a page lacks, from a number on."""

    next: int
    gaps: list[tuple[int, int]] = field(default_factory=list)
    """Items that were passed over: first, and the one after the last."""

    def take(self, start: int, end: int, most: int) -> range:
        """Return the next items to send, the newest first, of a log that keeps those from `start` to before `end`."""
        if self.next < end:
            self.gaps.append((self.next, end))
            self.next = end
        while self.gaps:
            low, high = self.gaps.pop()
            low = max(low, start)
            first = max(low, high - most)
            if first > low:
                self.gaps.append((low, first))
            if first < high:
                return range(first, high)
        return range(0)


class Viewer:
    """The server side of a page.

    Attributes
    ----------
    commands
        Whether the page may command.
    frames, wire
        Whether the page shows images, and whether it shows the trace.
    rows
        Telemetry rows that the page shows.
    dropped
        Number of messages and images dropped because the page read too slowly.
    """

    def __init__(
        self,
        socket: Socket,
        history: History,
        trace: Log,
        events: Log,
        *,
        commands: bool = True,
        clock: Callable[[], float] | None = None,
    ) -> None:
        self._socket = socket
        self._history = history
        self._trace = trace
        self._events = events
        self._clock = clock or asyncio.get_running_loop().time
        self.commands = commands
        self._texts: OrderedDict[str | int, str] = OrderedDict()
        self._numbers = itertools.count()
        self._image: Image | None = None
        self._free = asyncio.Event()
        self._free.set()
        self._wake = asyncio.Event()
        self._echo: tuple[float, float] | None = None
        """The page's time of the last acknowledgement, and the time at which it came, milliseconds."""
        self._lacking_rows = Lacking(history.end)
        self._lacking_events = Lacking(events.end)
        self._lacking_items = Lacking(trace.end)
        self.turn = asyncio.Lock()
        """Held by the request of the page that is to begin next."""
        self.frames = False
        self.wire = False
        self.rows: frozenset[str] = frozenset()
        self.dropped = 0

    @property
    def waiting(self) -> int:
        """Number of queued messages, including an image."""
        return len(self._texts) + (self._image is not None)

    @property
    def behind(self) -> bool:
        """Whether the page reads more slowly than it is sent messages."""
        return len(self._texts) > WAIT_ABOVE

    def subscribe(self, *, frames: bool, wire: bool, history: int, events: int) -> None:
        """Set what the page shows; it has the rows of the history, and the events, before a number."""
        if frames and not self.frames:
            self._lacking_rows = Lacking(history if 0 <= history <= self._history.end else 0)
            self._lacking_events = Lacking(events if 0 <= events <= self._events.end else 0)
        if wire and not self.wire:
            self._lacking_items = Lacking(max(self._trace.start, self._trace.end - TURN_ITEMS))
        self.frames, self.wire = frames, wire
        self._wake.set()

    def send(self, text: str, *, state: str = "") -> None:
        """Queue a message; if it is a state, it replaces the queued one with its name."""
        if state:
            self._texts.pop(state, None)
        if len(self._texts) >= QUEUE_LIMIT:
            self._texts.popitem(last=False)
            self.dropped += 1
        self._texts[state or next(self._numbers)] = text
        self._wake.set()

    def send_image(self, image: Image) -> None:
        """Queue an image; one that is still queued is dropped."""
        self.dropped += self._image is not None
        self._image = image
        self._wake.set()

    def wake(self) -> None:
        """Note that a log has new items."""
        self._wake.set()

    def acknowledge(self, page_ms: object) -> None:
        """Note that the page has received the last turn, at a time of its clock."""
        if isinstance(page_ms, (int, float)) and abs(page_ms) < 1e15:
            self._echo = float(page_ms), self._clock() * 1e3
        self._free.set()

    async def pump(self) -> None:
        """Send turns until cancelled.

        Raises
        ------
        ConnectionError
            The page has closed.
        """
        while True:
            await self.flush()
            if not (self._lacking_rows.gaps or self._lacking_events.gaps):
                await asyncio.sleep(PAUSE_S)
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(BEAT_S - PAUSE_S):
                        await self._wake.wait()
            await self._free.wait()

    async def flush(self) -> None:
        """Send a turn, unless the page has not acknowledged the last one.

        Raises
        ------
        ConnectionError
            The page has closed.
        """
        if self._free.is_set():
            self._wake.clear()
            self._free.clear()
            await self._socket.send_bytes(self._turn())

    def _turn(self) -> bytes:
        """Return what the page lacks, as much as fits in a turn."""
        messages: list[str] = []
        room = TURN_TEXT
        while self._texts and room > 0:
            _, text = self._texts.popitem(last=False)
            room -= len(text)
            messages.append(text)
        if self._texts:
            self._wake.set()
        rows = range(0)
        if self.frames:
            history = self._history
            rows = self._lacking_rows.take(history.start, history.end, TURN_ROWS)
            events = self._lacking_events.take(self._events.start, self._events.end, TURN_ITEMS)
            if events:
                messages.append(_message("events", self._events.texts(events)))
        if self.wire:
            before = self._lacking_items.next
            items = self._lacking_items.take(self._trace.start, self._trace.end, TURN_ITEMS)
            self._lacking_items.gaps.clear()
            if items:
                left_out = items.start - before
                messages.append(_message("wire", self._trace.texts(items), f', "left_out": {left_out}'))
        image, self._image = self._image, None
        head = [
            f'"at": {self._clock() * 1e3:.3f}',
            f'"echo": {json.dumps(self._echo)}',
            f'"messages": [{", ".join(messages)}]',
            f'"rows": [{rows.start}, {len(rows)}]',
        ]
        if image is not None:
            head.append(f'"image": {{{image.description}}}')
        content = f"{{{', '.join(head)}}}".encode()
        jpeg = b"" if image is None else image.jpeg
        return b"".join((struct.pack("<I", len(content)), content, self._history.block(rows), jpeg))


def _message(kind: str, items: list[str], more: str = "") -> str:
    return f'{{"type": "{kind}", "items": [{", ".join(items)}]{more}}}'
