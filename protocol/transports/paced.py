"""Serial transports that send at the bit rate of the line and never block."""

from __future__ import annotations

import asyncio
import contextlib
import os
import termios
import time
from abc import abstractmethod
from collections import deque
from collections.abc import Iterator
from itertools import takewhile
from typing import Final

from starhil.protocol.transports.base import Transport

BACKLOG_LIMIT: Final = 64 * 1024
"""Maximum number of bytes that wait for the line or for a peer that does not read."""

READ_SIZE: Final = 256
"""Maximum number of bytes that a port reads per turn of the loop: 80 faults or 50 requests, some 5 ms of work for a
device; at 921 600 baud they arrive in 3 ms."""

SMALLEST_READ: Final = 8
"""Fewest bytes that a port reads per turn when they are much work, as lines of one byte are."""

LONG_TURN_S: Final = 0.005
"""Time that a turn takes if it was too much work: the next ones read half as much, seconds."""

GRAIN_S: Final = 1e-6
"""A timer may fire this much early."""

RETRY_S: Final = 0.005
"""Time until the next attempt if the port is full."""

BITS_PER_BYTE: Final = 10
"""Start bit, 8 data bits, stop bit."""


class SerialTransport(Transport[bytes]):
    """A serial port."""

    @abstractmethod
    def set_baud(self, baud: int) -> None:
        """Change the bit rate as soon as the queue has been sent."""


class PacedTransport(SerialTransport):
    """Base of the ports that write each message whole, at the time at which its last byte would arrive over the line.

    A UART has no gaps within a message. Bytes written one by one would have some whenever the machine is busy. `pace` is the
    bit rate of the line, or None for no pacing.
    """

    def __init__(self, description: str, pace: int | None) -> None:
        super().__init__(description)
        self._pace = pace
        self._free_at = float("-inf")
        """When the last byte of the queue will have been sent."""
        self._queue: deque[tuple[float, bytes]] = deque()
        """Messages, each with the time at which it is due."""
        self._written = 0
        """Number of bytes of the first message that have been written."""
        self._backlog = 0
        """Number of waiting bytes."""
        self._timer: asyncio.TimerHandle | None = None
        self._idle = asyncio.Event()
        self._idle.set()
        self._next_baud: int | None = None
        """Bit rate from the end of the queue on."""
        self.read_size = READ_SIZE
        """Number of bytes that are read per turn of the loop."""

    @abstractmethod
    def _has_peer(self) -> bool:
        """Return whether the port is open, with a peer as far as that is known."""

    @abstractmethod
    def _write(self, data: bytes) -> int:
        """Write without blocking; return how many bytes were accepted, 0 if the port is full.

        Raises OSError: the port is lost; the bytes are dropped, as on a line without a peer.
        """

    def send(self, item: bytes) -> bool:
        """Queue a complete message, or drop it; without a peer it is dropped."""
        if not self._has_peer() or self._backlog + len(item) > BACKLOG_LIMIT:
            self.statistics.dropped += len(item)
            return False
        if item:
            due = asyncio.get_running_loop().time()
            if self._pace is not None:
                due = self._free_at = max(due, self._free_at) + len(item) * BITS_PER_BYTE / self._pace
            self._queue.append((due, item))
            self._backlog += len(item)
            self._idle.clear()
            if self._timer is None:
                self._write_due()
        return True

    async def drain(self) -> None:
        """Wait until the queue is empty."""
        await self._idle.wait()

    def set_baud(self, baud: int) -> None:
        """Change the bit rate once the queue is empty."""
        self._next_baud = baud
        if not self._queue:
            self._become_idle()

    def _change_rate(self, baud: int) -> None:
        """Change the bit rate; the queue is empty."""
        if self._pace is not None:
            self._pace = baud

    def _become_idle(self) -> None:
        self._idle.set()
        baud, self._next_baud = self._next_baud, None
        if baud is not None:
            self._change_rate(baud)

    def _clear(self) -> None:
        """Drop the queue and free the line."""
        self.statistics.dropped += self._backlog
        self._free_at = float("-inf")
        self._queue.clear()
        self._backlog = self._written = 0
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._become_idle()

    def _write_due(self) -> None:
        """Write the messages that are due and set the timer for the next one."""
        self._timer = None
        loop = asyncio.get_running_loop()
        now = loop.time()
        waiting = takewhile(lambda item: item[0] <= now + GRAIN_S, self._queue)
        due = b"".join(data for _, data in waiting)[self._written :]
        accepted = 0
        if due:
            try:
                accepted = self._write(due)
            except OSError:
                self._clear()
                return
            self._remove_written(accepted)
        if self._queue:
            next_time = now + RETRY_S if accepted < len(due) else self._queue[0][0]
            self._timer = loop.call_at(next_time, self._write_due)
        else:
            self._become_idle()

    def _remove_written(self, count: int) -> None:
        self.statistics.sent += count
        self._backlog -= count
        count += self._written
        while self._queue and count >= len(self._queue[0][1]):
            count -= len(self._queue.popleft()[1])
        self._written = count

    def _process_received(self, data: bytes) -> None:
        self.statistics.received += len(data)
        begin_s = time.monotonic()
        self._receive(data)
        too_long = time.monotonic() - begin_s > LONG_TURN_S
        self.read_size = (
            max(SMALLEST_READ, self.read_size // 2) if too_long else min(READ_SIZE, 2 * self.read_size)
        )


def write_fd(fd: int, data: bytes) -> int:
    """Write to a non-blocking descriptor; return how many bytes it accepted, 0 if it is full."""
    try:
        return os.write(fd, data)
    except BlockingIOError:
        return 0


@contextlib.contextmanager
def termios_as_os_error() -> Iterator[None]:
    """Convert `termios.error`, which does not derive from OSError, to OSError."""
    try:
        yield
    except termios.error as error:
        raise OSError(*error.args) from None
