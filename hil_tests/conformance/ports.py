"""Ports and buses for the cases, each with a clock."""

from __future__ import annotations

import asyncio
import queue
import time
from typing import Generic, Protocol, Self, TypeVar

from starhil.hil_tests.client.loop_thread import LoopThread
from starhil.hil_tests.errors import LinkLostError
from starhil.protocol.can.frame import CanFrame
from starhil.protocol.errors import ProtocolError
from starhil.protocol.transports.base import Transport

__all__ = ["CanFrame", "LivePort", "Port"]

Item = TypeVar("Item")


class Port(Protocol[Item]):
    """A serial port (items are bytes) or a CAN bus (items are frames) with synchronous calls and a clock."""

    def send(self, item: Item) -> None:
        """Send an item."""

    def receive(self, timeout_s: float) -> Item | None:
        """Return the next item, or None if none arrives in time."""

    def now(self) -> float:
        """Time, s, from any origin."""


class LivePort(Generic[Item]):
    """A port over an asyncio transport, whose loop runs in a separate thread; a context manager.

    `speed` is the seconds on its clock per second of the wall clock.
    """

    def __init__(self, transport: Transport[Item], speed: float = 1.0) -> None:
        self._transport = transport
        self._speed = speed
        self._loop = LoopThread("conformance")
        self._arrived: queue.SimpleQueue[Item] = queue.SimpleQueue()
        self._lost: ProtocolError | None = None

    def send(self, item: Item) -> None:
        """Send an item.

        Raises LinkLostError: the port or bus was lost.
        """
        if not self._loop.run(self._send(item)):
            raise LinkLostError(f"{self._transport.description}: {self._lost or 'accepts no more data'}")

    async def _send(self, item: Item) -> bool:
        return self._transport.send(item)

    def receive(self, timeout_s: float) -> Item | None:
        """Return the next item, or None if none arrives in time."""
        try:
            if timeout_s > 0:
                return self._arrived.get(timeout=timeout_s / self._speed)
            return self._arrived.get_nowait()
        except queue.Empty:
            return None

    def now(self) -> float:
        """Time, s, from any origin."""
        return time.monotonic() * self._speed

    def _record_loss(self, error: ProtocolError) -> None:
        self._lost = error

    def __enter__(self) -> Self:
        try:
            self._loop.run(self._transport.start(self._arrived.put, self._record_loss))
        except BaseException:
            self._loop.close()
            raise
        return self

    def __exit__(self, *_error: object) -> None:
        self._loop.run(self._close_transport())
        self._loop.close()

    async def _close_transport(self) -> None:
        await asyncio.sleep(0)
        await self._transport.close()
