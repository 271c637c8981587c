"""A connected console page: its subscriptions and its send queue."""

from __future__ import annotations

import asyncio
import itertools
from collections import OrderedDict
from typing import Final, Protocol

QUEUE_LIMIT: Final = 1000
"""Send-queue limit; the oldest messages are dropped."""

BEHIND: Final = 20
"""Number of queued messages above which a page gets no trace, and its requests wait."""


class Socket(Protocol):
    """The methods of a WebSocket that a viewer uses."""

    async def send_str(self, data: str, /) -> None:
        """Send a text message."""

    async def send_bytes(self, data: bytes, /) -> None:
        """Send a binary message."""


class Viewer:
    """The server side of a page; a page that reads too slowly loses images and parts of the trace, but delays nothing.

    An image is sent when the page has acknowledged the one before, so that no images are under way over a slow link.

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
    wire_end, wire_left_out
        Number of the next item of the trace for the page, and how many it has not got since the last one.
    """

    def __init__(self, socket: Socket, *, commands: bool = True) -> None:
        self._socket = socket
        self.commands = commands
        self._texts: OrderedDict[str | int, str] = OrderedDict()
        self._numbers = itertools.count()
        self._frame: tuple[bytes, str] | None = None
        self._acknowledged = True
        self._wake = asyncio.Event()
        self.frames = False
        self.wire = False
        self.rows: frozenset[str] = frozenset()
        self.dropped = 0
        self.wire_end = 0
        self.wire_left_out = 0

    @property
    def waiting(self) -> int:
        """Number of queued messages, including an image."""
        return len(self._texts) + (self._frame is not None)

    @property
    def behind(self) -> bool:
        """Whether the page reads more slowly than it is sent messages."""
        return len(self._texts) > BEHIND

    def send(self, text: str, *, state: str = "") -> None:
        """Queue a message; if it is a state, it replaces the queued one with its name."""
        if state:
            self._texts.pop(state, None)
        if len(self._texts) >= QUEUE_LIMIT:
            self._texts.popitem(last=False)
            self.dropped += 1
        self._texts[state or next(self._numbers)] = text
        self._wake.set()

    def send_frame(self, data: bytes, numbers: str = "") -> None:
        """Queue an image; one that is still queued is dropped, and only its numbers are sent, a message."""
        if self._frame is not None:
            self.dropped += 1
            if self._frame[1]:
                self.send(self._frame[1])
        self._frame = data, numbers
        self._wake.set()

    def acknowledge(self) -> None:
        """Note that the page has received the last image."""
        self._acknowledged = True
        self._wake.set()

    async def pump(self) -> None:
        """Send queued messages until cancelled.

        Raises
        ------
        ConnectionError
            The page has closed.
        """
        while True:
            await self._wake.wait()
            await self.flush()

    async def flush(self) -> None:
        """Send all queued messages, and the image if the page has acknowledged the last one.

        Raises
        ------
        ConnectionError
            The page has closed.
        """
        self._wake.clear()
        while self._texts:
            _, text = self._texts.popitem(last=False)
            await self._socket.send_str(text)
        if self._frame is not None and self._acknowledged:
            (data, _), self._frame, self._acknowledged = self._frame, None, False
            await self._socket.send_bytes(data)
