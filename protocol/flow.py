"""How connections share one event loop: each reads little a turn, and nobody's traffic waits behind another's backlog."""

from __future__ import annotations

import asyncio
import socket
from abc import abstractmethod
from collections import deque
from collections.abc import Hashable, Sequence
from typing import Final

TURN: Final = 4 * 1024
"""Bytes that one connection reads in a turn of the loop at most: some 100 CAN frames in text, 10 ms of a device's work."""

WINDOW: Final = 16 * 1024
"""Bytes that each buffer on the way of a connection holds at most: what lies there delays what comes after it."""


class TurnProtocol(asyncio.BufferedProtocol):
    """A connection that reads at most `TURN` bytes before the loop serves the others."""

    def __init__(self) -> None:
        self._buffer = bytearray(TURN)

    def get_buffer(self, sizehint: int) -> bytearray:
        """Return where the next bytes go."""
        _ = sizehint
        return self._buffer

    def buffer_updated(self, nbytes: int) -> None:
        """Hand over the bytes that came."""
        self.data_received(bytes(self._buffer[:nbytes]))

    @abstractmethod
    def data_received(self, data: bytes) -> None:
        """Take the bytes that came."""


def limit_buffers(transport: asyncio.BaseTransport) -> None:
    """Let the kernel hold little of a TCP connection: by itself it takes megabytes, which are seconds of work."""
    connection: socket.socket | None = transport.get_extra_info("socket")
    if connection is not None and connection.family in (socket.AF_INET, socket.AF_INET6):
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, WINDOW)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, WINDOW)


class FairQueue:
    """Lines that wait for one receiver; their senders take turns, a line each.

    Lines of one sender keep their order. Where there is no more room, the sender that has most waiting loses its newest.

    Parameters
    ----------
    limit
        Bytes that wait at most.
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._lines: dict[Hashable, deque[bytes]] = {}
        self._sizes: dict[Hashable, int] = {}
        self.size = 0
        """Bytes that wait."""

    def put(self, sender: Hashable, lines: Sequence[bytes]) -> int:
        """Add lines of a sender; return how many lines, of whatever sender, had to be dropped."""
        if not lines:
            return 0
        added = sum(map(len, lines))
        self._lines.setdefault(sender, deque()).extend(lines)
        self._sizes[sender] = self._sizes.get(sender, 0) + added
        self.size += added
        dropped = 0
        while self.size > self._limit:
            longest = max(self._sizes, key=lambda each: self._sizes[each])
            self._note_removed(longest, self._lines[longest].pop())
            dropped += 1
        return dropped

    def take(self, size: int) -> list[bytes]:
        """Remove and return the next lines: at least `size` bytes, or all."""
        taken: list[bytes] = []
        rest = size
        while self._lines and rest > 0:
            for sender in tuple(self._lines):
                line = self._lines[sender].popleft()
                self._note_removed(sender, line)
                taken.append(line)
                rest -= len(line)
        return taken

    def _note_removed(self, sender: Hashable, line: bytes) -> None:
        self.size -= len(line)
        self._sizes[sender] -= len(line)
        if not self._lines[sender]:
            del self._lines[sender], self._sizes[sender]
