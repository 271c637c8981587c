"""What every transport is: start, send without blocking, close; counters; and how to come back after a loss."""

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

Item = TypeVar("Item")

Receive = Callable[[Item], None]
Complain = Callable[[ProtocolError], None]


class TransportError(ProtocolError):
    """A port or bus that cannot be had, or was lost; the text says which, why and the remedy."""


@dataclass(slots=True)
class Statistics:
    """Counters of one transport since its start, in items (serial: bytes; CAN: frames)."""

    sent: int = 0
    received: int = 0
    dropped: int = 0
    """Not sent because the peer does not read, or the port is gone."""
    errors: int = 0
    """Failures that the error callback was told."""
    reconnects: int = 0
    """Times that a lost port or bus came back."""


class Transport(ABC, Generic[Item]):
    """A port or bus in the running event loop; callbacks run in the loop's thread."""

    def __init__(self, description: str) -> None:
        self.description = description
        """What was taken, as a specification that opens the same again; true once started."""
        self.statistics: Final = Statistics()
        self._on_receive: Receive[Item] | None = None
        self._on_error: Complain | None = None

    async def start(self, on_receive: Receive[Item], on_error: Complain | None = None) -> None:
        """Open the port and hand what arrives to `on_receive`.

        Raises TransportError if the port cannot be had now; what happens later goes to `on_error`, while the
        transport tries to come back by itself.
        """
        self._on_receive = on_receive
        self._on_error = on_error
        await self._open()

    @abstractmethod
    async def _open(self) -> None:
        """Open the port or raise TransportError."""

    @abstractmethod
    def send(self, item: Item) -> bool:
        """Queue an item; never blocks. Returns False if it was dropped, which is counted."""

    @abstractmethod
    async def drain(self) -> None:
        """Wait until what was queued has left."""

    @abstractmethod
    async def close(self) -> None:
        """Give the port back; may be called twice."""

    def _receive(self, item: Item) -> None:
        if self._on_receive is not None:
            self._on_receive(item)

    def _complain(self, text: str) -> None:
        self.statistics.errors += 1
        if self._on_error is not None:
            self._on_error(TransportError(text))


class ReturningTransport(Transport[Item]):
    """A port or bus that may vanish: tells so once, then tries to get it back with growing pauses."""

    what: ClassVar[str]
    """Kind of port, the first word of every message."""

    def __init__(self, description: str) -> None:
        super().__init__(description)
        self._closing = False
        self._comeback: asyncio.Task[None] | None = None

    async def _open(self) -> None:
        await self._connect()

    @abstractmethod
    async def _connect(self) -> None:
        """Open the port or raise TransportError."""

    @abstractmethod
    def _disconnect(self) -> None:
        """Let go of the port and of what was waiting for it, whatever its state."""

    def _lost(self, why: str) -> None:
        """Note that the port is gone."""
        if self._closing or self._comeback is not None:
            return
        self._release()
        self._complain(f"{self.what} {self.description}: lost: {why}; waiting for it to come back")
        self._comeback = asyncio.get_running_loop().create_task(self._come_back())

    def _release(self) -> None:
        """Disconnect; a port that is half gone may resist, which is reported."""
        try:
            self._disconnect()
        except Exception as error:  # noqa: BLE001 (it is to be opened again, or left, all the same)
            self._complain(
                f"{self.what} {self.description}: closing: {type(error).__name__}: {reason(error)}"
            )

    async def _come_back(self) -> None:
        pause = Backoff()
        reported = ""
        while True:
            await asyncio.sleep(pause.next())
            try:
                await self._connect()
            except ProtocolError:
                continue
            except Exception as error:  # noqa: BLE001 (whatever it is, the port may come back)
                self._release()
                text = f"{type(error).__name__}: {reason(error)}"
                if text != reported:  # once, not with every try
                    reported = text
                    self._complain(f"{self.what} {self.description}: not back: {text}; still trying")
                continue
            self.statistics.reconnects += 1
            self._comeback = None
            _LOGGER.warning("%s %s: back", self.what, self.description)
            return

    async def close(self) -> None:
        """Give the port back."""
        self._closing = True
        if self._comeback is not None:
            self._comeback.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._comeback
            self._comeback = None
        self._release()


class Backoff:
    """Waiting times between tries: doubling from the first to the last."""

    def __init__(self, first_s: float = 0.05, last_s: float = 1.0) -> None:
        self._last_s = last_s
        self._next_s = first_s

    def next(self) -> float:
        """Return the time to wait now (s)."""
        wait, self._next_s = self._next_s, min(2 * self._next_s, self._last_s)
        return wait
