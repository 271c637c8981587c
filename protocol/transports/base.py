"""Base classes of all transports: non-blocking send, counters, and reconnection."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Final, Generic, TypeVar

from starhil.protocol.errors import ProtocolError, reason

_LOGGER: Final = logging.getLogger("starhil.transport")

FIRST_PAUSE_S: Final = 0.05
LAST_PAUSE_S: Final = 1.0
"""Pauses between attempts to reconnect double from the first to the last."""

TURN_S: Final = 0.002
"""Time after which a transport leaves the loop to others, if more has arrived, seconds: a frame may be any amount of work."""

Item = TypeVar("Item")

Receive = Callable[[Item], None]
ReportError = Callable[[ProtocolError], None]


class TransportError(ProtocolError):
    """A port or bus that is not available or was lost.

    The text names the port or bus, the reason and the remedy.
    """


@dataclass(slots=True)
class Statistics:
    """Counters of one transport since its start, in items (serial: bytes; CAN: frames)."""

    sent: int = 0
    received: int = 0
    dropped: int = 0
    """Items not sent because the peer did not read or the port was lost."""
    reconnects: int = 0
    """Number of times that a lost port or bus came back."""


class Transport(ABC, Generic[Item]):
    """A port or bus in the running event loop; callbacks run in the loop's thread."""

    immediate: ClassVar[bool] = False
    """Whether an item has arrived when `send` returns, so that `drain` has nothing to wait for."""

    def __init__(self, description: str, statistics: Statistics | None = None) -> None:
        self.description = description
        """Specification that opens the same port again; valid once started."""
        self.statistics: Final = statistics or Statistics()
        self._on_receive: Receive[Item] | None = None
        self._on_error: ReportError | None = None
        self.listener: Receive[Item] | None = None
        """Called with each received item before it is processed."""

    async def start(self, on_receive: Receive[Item], on_error: ReportError | None = None) -> None:
        """Open the port and pass received items to `on_receive`.

        Raises TransportError if the port is not available. Later failures are passed to `on_error`, and the
        transport reconnects automatically.
        """
        self._on_receive = on_receive
        self._on_error = on_error
        await self._open()

    @abstractmethod
    async def _open(self) -> None:
        """Open the port or raise TransportError."""

    def publish(self) -> None:
        """Let peers find the open port under its other name, if it has one.

        Raises TransportError: the name is not available.
        """

    @abstractmethod
    def send(self, item: Item) -> bool:
        """Queue an item without blocking. Returns False if it was dropped; drops are counted."""

    async def drain(self) -> None:
        """Wait until the queue has been sent; without a queue (`immediate`), return at once."""

    @abstractmethod
    async def close(self) -> None:
        """Close the port; may be called twice."""

    def stop_receiving(self) -> None:
        """Drop whatever arrives from now on, before the port is closed."""
        self._on_receive = self.listener = None

    def _receive(self, item: Item) -> None:
        if self.listener is not None:
            self.listener(item)
        if self._on_receive is not None:
            self._on_receive(item)

    def _report_error(self, text: str) -> None:
        if self._on_error is not None:
            self._on_error(TransportError(text))


class ReconnectingTransport(Transport[Item]):
    """A port or bus that may disappear: reports the loss once, then retries with increasing pauses."""

    kind: ClassVar[str]
    """Kind of port, the first word of every error text."""

    def __init__(self, description: str) -> None:
        super().__init__(description)
        self._closing = False
        self._reconnection: asyncio.Task[None] | None = None

    @abstractmethod
    def _disconnect(self) -> None:
        """Release the port and drop its queue, in any state."""

    def _lost(self, why: str) -> None:
        """Disconnect, report the loss once and start to reconnect."""
        if self._closing or self._reconnection is not None:
            return
        self._disconnect_safely()
        self._report_error(f"{self.kind} {self.description}: lost: {why}; waiting for it to come back")
        self._reconnection = asyncio.get_running_loop().create_task(self._reconnect())

    def _disconnect_safely(self) -> None:
        """Disconnect, and report a failure to do so."""
        try:
            self._disconnect()
        except Exception as error:  # noqa: BLE001 (the port is opened again or abandoned in any case)
            self._report_error(
                f"{self.kind} {self.description}: closing: {type(error).__name__}: {reason(error)}"
            )

    async def _reconnect(self) -> None:
        pause_s, reported = FIRST_PAUSE_S, ""
        while True:
            await asyncio.sleep(pause_s)
            pause_s = min(2 * pause_s, LAST_PAUSE_S)
            try:
                await self._open()
            except ProtocolError:
                continue
            except Exception as error:  # noqa: BLE001 (after any failure the port may come back)
                self._disconnect_safely()
                text = f"{type(error).__name__}: {reason(error)}"
                if text != reported:  # once, not at every attempt
                    reported = text
                    self._report_error(f"{self.kind} {self.description}: not back: {text}; still trying")
                continue
            self.statistics.reconnects += 1
            self._reconnection = None
            _LOGGER.warning("%s %s: back", self.kind, self.description)
            return

    async def close(self) -> None:
        self._closing = True
        if self._reconnection is not None:
            self._reconnection.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._reconnection
            self._reconnection = None
        self._disconnect_safely()
