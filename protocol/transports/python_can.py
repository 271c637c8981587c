"""CAN buses of python-can as transports: socketcan, virtual, udp_multicast, slcan and others."""

from __future__ import annotations

import asyncio
import contextlib
import math
import threading
import time
from collections import deque
from collections.abc import Callable
from functools import partial
from types import NoneType
from typing import Final

import can

from starhil.protocol.can.frame import CanFrame
from starhil.protocol.errors import ProtocolError
from starhil.protocol.transports.base import TURN_S, ReconnectingTransport, TransportError

QUEUE_LIMIT: Final = 10_000
"""Maximum number of frames that wait for the bus."""

RETRY_S: Final = 0.001
"""Time until the next attempt if the transmit buffer of the bus is full."""

STALLED_S: Final = 0.5
"""Time for which the bus takes no frame, seconds, after which those that wait are dropped: no other node acknowledges, or the
controller is bus-off, and whoever comes back would take them for present ones."""

READ_TIMEOUT_S: Final = 0.2
"""Timeout of one read in the reader thread (for buses without a file descriptor)."""

READS_PER_TURN: Final = 16
"""Maximum number of frames read per turn of the loop."""

SENDS_PER_TURN: Final = 64
"""Frames sent per turn of the loop."""

ECHO_S: Final = 5.0
"""Time within which a bus that echoes returns a sent frame."""

ECHO_LIMIT: Final = 10_000
"""Maximum number of sent frames whose echo is awaited; one more replaces the oldest."""

BUS_OFF: Final = 0x40
"""Flag in error frames of the kernel: the controller is bus-off."""

BUS_OFF_QUIET_S: Final = 10.0
"""Time without bus-off after which it is reported again, seconds: a controller that restarts by itself may be bus-off at each frame."""

OpenBus = Callable[[], can.BusABC]


class PythonCanTransport(ReconnectingTransport[CanFrame]):
    """Frames over a python-can bus.

    `open_bus` runs in a thread, since it may block. If the bus `echoes`, i.e. returns sent frames (udp_multicast), the
    transport removes these echoes.
    """

    kind = "CAN"

    def __init__(self, description: str, open_bus: OpenBus, *, echoes: bool = False) -> None:
        super().__init__(description)
        self._open_bus = open_bus
        self._echoes: deque[tuple[float, CanFrame]] | None = deque(maxlen=ECHO_LIMIT) if echoes else None
        self._bus: can.BusABC | None = None
        self._fd = -1
        self._next_read: asyncio.Handle | None = None
        """The next read, scheduled while frames may be waiting."""
        self._thread: threading.Thread | None = None
        self._queue: deque[CanFrame] = deque()
        self._bus_off_s = -math.inf
        """Time at which the bus was last off, on the monotonic clock, seconds."""
        self._full_since_s: float | None = None
        """Time since which the transmit buffer is full, on the monotonic clock, seconds; None if it is not."""
        self._timer: asyncio.Handle | None = None
        self._idle = asyncio.Event()
        self._idle.set()

    async def _open(self) -> None:
        loop = asyncio.get_running_loop()
        try:
            bus = await self._open_in_thread()
        except (can.CanError, OSError, ValueError, ImportError, TypeError) as error:
            # python-can's text, unlike the system's, names the interface
            reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
            raise TransportError(f"CAN {self.description}: cannot open: {reason}") from None
        self._bus = bus
        self._fd = _descriptor(bus)
        if self._fd >= 0:
            loop.add_reader(self._fd, self._woken)
        else:
            self._thread = threading.Thread(
                target=self._read_in_thread, args=(bus, loop), name="can-reader", daemon=True
            )
            self._thread.start()

    async def _open_in_thread(self) -> can.BusABC:
        opening = asyncio.ensure_future(asyncio.to_thread(self._open_bus))
        try:
            return await asyncio.shield(opening)
        except asyncio.CancelledError:
            opening.add_done_callback(_close_unused_bus)
            raise

    def _woken(self) -> None:
        if self._next_read is None:
            self._readable()

    def _readable(self) -> None:
        """Read once per turn of the loop while frames are waiting."""
        self._next_read = None
        until_s = time.monotonic() + TURN_S
        for _ in range(READS_PER_TURN):
            if time.monotonic() > until_s:
                break
            bus = self._bus
            if bus is None:
                return
            try:
                message = bus.recv(0)
            except (can.CanError, OSError, ValueError) as error:
                if _is_unreadable(error):
                    self.statistics.dropped += 1
                    continue
                self._lost(str(error))
                return
            if message is None:
                return
            self._process_message(message)
        # frames that the bus object has buffered raise no event
        self._next_read = asyncio.get_running_loop().call_soon(self._readable)

    def _read_in_thread(self, bus: can.BusABC, loop: asyncio.AbstractEventLoop) -> None:
        while self._bus is bus:
            try:
                message = bus.recv(READ_TIMEOUT_S)
            except (can.CanError, OSError, ValueError) as error:
                if _is_unreadable(error):
                    continue
                if self._bus is bus:
                    self._from_thread(loop, partial(self._lost, str(error)))
                return
            if message is not None:
                self._from_thread(loop, partial(self._process_message, message))

    @staticmethod
    def _from_thread(loop: asyncio.AbstractEventLoop, call: Callable[[], None]) -> None:
        # the loop may have ended while the bus was being read
        with contextlib.suppress(RuntimeError):
            loop.call_soon_threadsafe(call)

    def _process_message(self, message: can.Message) -> None:
        if self._bus is None or message.is_fd:
            return
        if message.is_error_frame:
            if message.arbitration_id & BUS_OFF:
                self._report_bus_off()
            return
        try:
            frame = CanFrame(
                message.arbitration_id,
                b"" if message.is_remote_frame else bytes(message.data),
                message.is_extended_id,
                message.is_remote_frame,
                message.timestamp or None,
            )
        except ProtocolError:  # no node can send it
            self.statistics.dropped += 1
            return
        if self._is_echo(frame):
            return
        self.statistics.received += 1
        self._receive(frame)

    def _report_bus_off(self) -> None:
        last_s, self._bus_off_s = self._bus_off_s, time.monotonic()
        if self._bus_off_s - last_s > BUS_OFF_QUIET_S:
            self._report_error(f"CAN {self.description}: bus-off; check the wiring and restart the interface")

    def _is_echo(self, frame: CanFrame) -> bool:
        """Return whether a frame is an awaited echo, and stop waiting for it."""
        if self._echoes is None:
            return False
        now = time.monotonic()
        while self._echoes and now - self._echoes[0][0] > ECHO_S:
            self._echoes.popleft()
        for index, (_, own) in enumerate(self._echoes):
            if own == frame:
                del self._echoes[index]
                return True
        return False

    def send(self, item: CanFrame) -> bool:
        """Queue a frame for the next turn of the loop."""
        if self._bus is None or len(self._queue) >= QUEUE_LIMIT:
            self.statistics.dropped += 1
            return False
        self._queue.append(item)
        if self._timer is None:
            self._idle.clear()
            self._timer = asyncio.get_running_loop().call_soon(self._send_queued)
        return True

    def _send_queued(self) -> None:
        """Send a few frames per turn; the kernel drops frames that are not read in between."""
        self._timer = None
        loop = asyncio.get_running_loop()
        for _ in range(SENDS_PER_TURN):
            if not self._queue or self._bus is None:
                break
            frame = self._queue[0]
            try:
                self._bus.send(_message(frame), timeout=0)
            except (can.CanError, OSError) as error:
                if not _is_full(error):
                    self._lost(str(error))
                    return
                if not self._is_stalled():
                    self._timer = loop.call_later(RETRY_S, self._send_queued)
                    return
                self._drop_queue()
                break
            self._full_since_s = None
            self._queue.popleft()
            self.statistics.sent += 1
            if self._echoes is not None:
                self._echoes.append((time.monotonic(), frame))
        if self._queue:
            self._timer = loop.call_soon(self._send_queued)
        else:
            self._idle.set()

    def _is_stalled(self) -> bool:
        """Return whether the transmit buffer, which is full, has been so for a long time."""
        now_s = time.monotonic()
        if self._full_since_s is None:
            self._full_since_s = now_s
        return now_s - self._full_since_s > STALLED_S

    def _drop_queue(self) -> None:
        self.statistics.dropped += len(self._queue)
        self._queue.clear()
        self._full_since_s = None

    def _disconnect(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._drop_queue()
        self._idle.set()
        if self._fd >= 0:
            asyncio.get_running_loop().remove_reader(self._fd)
            self._fd = -1
        bus, self._bus = self._bus, None
        if bus is not None:
            with contextlib.suppress(can.CanError, OSError):
                bus.shutdown()

    async def drain(self) -> None:
        """Wait until the bus has accepted the queue."""
        await self._idle.wait()

    async def close(self) -> None:
        await super().close()
        thread, self._thread = self._thread, None
        if thread is not None:
            await asyncio.to_thread(thread.join, 2 * READ_TIMEOUT_S)


def _close_unused_bus(opening: asyncio.Future[can.BusABC]) -> None:
    """Close a bus whose opening was cancelled."""
    if not opening.cancelled() and opening.exception() is None:
        opening.result().shutdown()


def _descriptor(bus: can.BusABC) -> int:
    """Return the descriptor that is readable when the bus has frames, or -1 if it has none."""
    try:
        return bus.fileno()
    except (NotImplementedError, OSError):
        return -1


def _message(frame: CanFrame) -> can.Message:
    return can.Message(
        arbitration_id=frame.id,
        data=frame.data,
        is_extended_id=frame.extended,
        is_remote_frame=frame.remote,
    )


def _is_unreadable(error: Exception) -> bool:
    """Return whether what has been received is no message, on a bus that works: anybody can send to a group of UDP."""
    return isinstance(error, can.CanOperationError) and not isinstance(error.__cause__, (OSError, NoneType))


def _is_full(error: Exception) -> bool:
    """Return whether a send failed only because the transmit buffer is full."""
    if isinstance(error, can.CanTimeoutError):
        return True
    code = getattr(error, "error_code", None) or getattr(error, "errno", None)
    return code in (11, 105) or "buffer full" in str(error).lower()
