"""Serial transports that send at the bit rate of a line, never block, and keep a bounded backlog."""

from __future__ import annotations

import asyncio
import contextlib
import os
import termios
from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Iterator
from functools import partial
from typing import Final

from starhil.protocol.serial_framing import PacingSchedule
from starhil.protocol.transports.base import Statistics, Transport

BACKLOG_LIMIT: Final = 64 * 1024
"""Bytes that wait at most, for the line or for a peer that does not read."""

TICK_S: Final = 0.002
"""Time between two writes of a long message: it leaves in pieces as the line would carry it."""

RETRY_S: Final = 0.005
"""Time until the next try when the port takes no more."""


class PacedWriter:
    """Writes queued bytes to a port no faster than its line.

    Parameters
    ----------
    write:
        Takes bytes without blocking and returns how many it took (0: none now). OSError counts as a lost port; the
        bytes are dropped, as on a line with nobody there.
    schedule:
        The line's byte times, or None for no pacing.
    """

    def __init__(
        self, write: Callable[[bytes], int], schedule: PacingSchedule | None, statistics: Statistics
    ) -> None:
        self._loop = asyncio.get_running_loop()
        self._write = write
        self.schedule = schedule
        self._statistics = statistics
        self._queue: deque[tuple[float, bytes]] = deque()
        """Messages with the time at which their first byte begins."""
        self._gone = 0
        """Bytes of the first message that have been written."""
        self._backlog = 0
        self._timer: asyncio.TimerHandle | None = None
        self._idle = asyncio.Event()
        self._idle.set()
        self._then: Callable[[], None] | None = None

    @property
    def backlog(self) -> int:
        """Bytes that are waiting."""
        return self._backlog

    def send(self, data: bytes) -> bool:
        """Queue a message, whole or not at all."""
        if self._backlog + len(data) > BACKLOG_LIMIT:
            self._statistics.dropped += len(data)
            return False
        if data:
            begin = self._loop.time()
            if self.schedule is not None:
                begin, _ = self.schedule.reserve(begin, len(data))
            self._queue.append((begin, data))
            self._backlog += len(data)
            self._idle.clear()
            if self._timer is None:
                self._work()
        return True

    async def drain(self) -> None:
        """Wait until nothing is waiting."""
        await self._idle.wait()

    def when_idle(self, action: Callable[[], None]) -> None:
        """Do this as soon as nothing is waiting; what was to be done then is forgotten."""
        self._then = action
        if self._idle.is_set():
            self._rest()

    def _rest(self) -> None:
        """Note that nothing is waiting."""
        self._idle.set()
        action, self._then = self._then, None
        if action is not None:
            action()

    def clear(self) -> None:
        """Drop what is waiting; the line is free at once."""
        self._statistics.dropped += self._backlog
        if self.schedule is not None:
            self.schedule.release()
        self._queue.clear()
        self._backlog = self._gone = 0
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._rest()

    def _work(self) -> None:
        """Write what is due, and come back when more is."""
        self._timer = None
        now = self._loop.time()
        due, next_time = self._due(now)
        if due:
            try:
                taken = self._write(due)
            except OSError:
                self.clear()
                return
            self._take_off(taken)
            if taken < len(due):
                next_time = now + RETRY_S
        if self._queue:
            self._timer = self._loop.call_at(max(next_time, now), self._work)
        else:
            self._rest()

    def _due(self, now: float) -> tuple[bytes, float]:
        """Return the bytes whose stop bit has passed by `now`, and when to look again."""
        if self.schedule is None:
            whole = b"".join(data for _, data in self._queue)
            return whole[self._gone :], now
        byte_s = self.schedule.seconds_per_byte
        pieces: list[bytes] = []
        gone = self._gone
        for begin, data in self._queue:
            ready = min(int((now - begin) / byte_s + 1e-6), len(data))
            if ready > gone:
                pieces.append(data[gone:ready])
            if ready < len(data):
                end = begin + len(data) * byte_s
                return b"".join(pieces), min(max(begin + (ready + 1) * byte_s, now + TICK_S), end)
            gone = 0
        return b"".join(pieces), now

    def _take_off(self, count: int) -> None:
        self._statistics.sent += count
        self._backlog -= count
        count += self._gone
        while self._queue and count >= len(self._queue[0][1]):
            count -= len(self._queue.popleft()[1])
        self._gone = count


class SerialTransport(Transport[bytes]):
    """A serial port."""

    @abstractmethod
    def set_baud(self, baud: int) -> None:
        """Go on at another bit rate as soon as all that was queued has left."""


class PacedTransport(SerialTransport):
    """Common part: the paced writer in front of the port."""

    def __init__(self, description: str, schedule: PacingSchedule | None) -> None:
        super().__init__(description)
        self._schedule = schedule
        self._writer: PacedWriter | None = None

    def set_baud(self, baud: int) -> None:
        """Change the bit rate once the queue is empty."""
        if self._writer is None:
            self._change_rate(baud)
        else:
            self._writer.when_idle(partial(self._change_rate, baud))

    def _change_rate(self, baud: int) -> None:
        """Take another bit rate into use; nothing is queued."""
        if self._schedule is not None:
            self._schedule = PacingSchedule(baud)
            if self._writer is not None:
                self._writer.schedule = self._schedule

    @abstractmethod
    def _write(self, data: bytes) -> int:
        """Write without blocking; return how many bytes were taken."""

    def _make_writer(self) -> None:
        self._writer = PacedWriter(self._write, self._schedule, self.statistics)

    def send(self, item: bytes) -> bool:
        """Queue a message, whole or not at all; without an open port it is dropped."""
        if self._writer is None:
            self.statistics.dropped += len(item)
            return False
        return self._writer.send(item)

    async def drain(self) -> None:
        """Wait until the queue is empty."""
        if self._writer is not None:
            await self._writer.drain()

    def _drop_writer(self) -> None:
        if self._writer is not None:
            self._writer.clear()
            self._writer = None

    def _take(self, data: bytes) -> None:
        self.statistics.received += len(data)
        self._receive(data)


def write_fd(fd: int, data: bytes) -> int:
    """Write to a non-blocking descriptor; return how many bytes it accepted, 0 if it is full."""
    try:
        return os.write(fd, data)
    except BlockingIOError:
        return 0


@contextlib.contextmanager
def termios_as_os_error() -> Iterator[None]:
    """Raise what the terminal settings refuse as the OSError that it is, which `termios.error` does not derive from."""
    try:
        yield
    except termios.error as error:
        raise OSError(*error.args) from None
