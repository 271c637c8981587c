"""A connected console page: its subscriptions and its send queue."""

from __future__ import annotations

import asyncio
from collections import deque
from typing import Final, Protocol

QUEUE_LIMIT: Final = 256
"""Send-queue limit; the oldest messages are dropped."""


class Socket(Protocol):
    """The methods of a WebSocket that a viewer uses."""

    async def send_str(self, data: str, /) -> None:
        """Send a text message."""

    async def send_bytes(self, data: bytes, /) -> None:
        """Send a binary message."""


class Viewer:
    """The server side of a page; a page that reads too slowly loses messages but delays nothing.

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

    def __init__(self, socket: Socket, *, commands: bool = True) -> None:
        self._socket = socket
        self.commands = commands
        self._texts: deque[str] = deque()
        self._frame: bytes | None = None
        self._wake = asyncio.Event()
        self.frames = False
        self.wire = False
        self.rows: frozenset[str] = frozenset()
        self.dropped = 0

    @property
    def waiting(self) -> int:
        """Number of queued messages, including an image."""
        return len(self._texts) + (self._frame is not None)

    def send(self, text: str) -> None:
        """Queue a message."""
        if len(self._texts) >= QUEUE_LIMIT:
            self._texts.popleft()
            self.dropped += 1
        self._texts.append(text)
        self._wake.set()

    def send_frame(self, data: bytes) -> None:
        """Queue an image, replacing one that is still queued."""
        self.dropped += self._frame is not None
        self._frame = data
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
        """Send all queued messages.

        Raises
        ------
        ConnectionError
            The page has closed.
        """
        self._wake.clear()
        while self._texts:
            await self._socket.send_str(self._texts.popleft())
        frame, self._frame = self._frame, None
        if frame is not None:
            await self._socket.send_bytes(frame)
