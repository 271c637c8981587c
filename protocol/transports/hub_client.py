"""A CAN bus over TCP: client of `CanHub` or any socketcand server, with reconnection."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Awaitable, Callable
from typing import Final, cast

from starhil.protocol.can_framing import CanFrame
from starhil.protocol.errors import ProtocolError, reason
from starhil.protocol.flow import WINDOW, TurnProtocol, detect_lost_peer, limit_buffers
from starhil.protocol.hub import DEFAULT_BUS, CanHub
from starhil.protocol.socketcand import CommandError, CommandSplitter, format_send, parse_frame
from starhil.protocol.transports.base import ReconnectingTransport, TransportError

_LOGGER: Final = logging.getLogger("starhil.transport")

BACKLOG_LIMIT: Final = 4 * 1024 * 1024
"""Maximum number of bytes that wait for a hub that does not read."""

HANDSHAKE_S: Final = 5.0
"""Longest time for the server's greeting and answers."""

CLOSE_S: Final = 0.5
"""Longest time that close waits for the hub to read the queue."""

EnsureServer = Callable[[], Awaitable[None]]


class _Connection(TurnProtocol):
    """One connection to a server: answers during the handshake, frames after it.

    While the server does not read, nothing is read from it either, because replies to more requests could not
    be sent.
    """

    def __init__(
        self, on_frame: Callable[[CanFrame], None], on_lost: Callable[[_Connection, str], None]
    ) -> None:
        super().__init__()
        self._on_frame = on_frame
        self._on_lost = on_lost
        self._splitter = CommandSplitter()
        self._answers: asyncio.Queue[bytes] = asyncio.Queue()
        self._drained = asyncio.Event()
        self._drained.set()
        self.transport: asyncio.Transport | None = None
        self.raw = False
        self.bad = 0
        """Invalid commands received from the server."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = cast("asyncio.Transport", transport)
        detect_lost_peer(transport, must_read=True)
        limit_buffers(transport)
        self.transport.set_write_buffer_limits(high=0)

    def connection_lost(self, exc: Exception | None) -> None:
        self.transport = None
        self._drained.set()
        self._answers.put_nowait(b"")
        self._on_lost(self, str(exc) if exc else "the hub closed the connection")

    def pause_writing(self) -> None:
        self._drained.clear()

    def resume_writing(self) -> None:
        self._drained.set()
        if self.transport is not None:
            self.transport.resume_reading()

    def write(self, text: bytes) -> None:
        """Send frames."""
        if self.transport is None:
            return
        self.transport.write(text)
        if self.transport.get_write_buffer_size() > WINDOW:
            self.transport.pause_reading()

    def data_received(self, data: bytes) -> None:
        """Process answers and frames."""
        for command in self._splitter.feed(data):
            if command is None:
                self.bad += 1
            elif command.startswith(b"frame "):
                try:
                    frame = parse_frame(command)
                except CommandError:
                    self.bad += 1
                else:
                    self._on_frame(frame)
            elif self.raw:
                self.bad += 1
            else:
                self._answers.put_nowait(command)

    async def ask(self, command: str | None) -> bytes:
        """Send a command and return the answer; with None, wait for the greeting."""
        if command is not None:
            if self.transport is None:
                return b""
            self.transport.write(f"< {command} >".encode())
        return await self._answers.get()

    async def drain(self) -> None:
        """Wait until the socket has accepted everything."""
        await self._drained.wait()


class HubTransport(ReconnectingTransport[CanFrame]):
    """A bus of a socketcand server.

    `ensure_server` is awaited before each connection; it starts a server if there is none (used by `auto`).
    """

    kind = "CAN"

    def __init__(self, host: str, port: int, bus: str, ensure_server: EnsureServer | None = None) -> None:
        super().__init__(f"socketcand:{host}:{port}/{bus}")
        self._host = host
        self._port = port
        self._bus = bus
        self._ensure_server = ensure_server
        self._connection: _Connection | None = None
        self._outbox: list[bytes] = []

    async def _connect(self) -> None:
        if self._ensure_server is not None:
            await self._ensure_server()
        loop = asyncio.get_running_loop()
        try:
            _, connection = await loop.create_connection(
                lambda: _Connection(self._on_frame, self._on_lost), self._host, self._port
            )
        except (OSError, ValueError) as error:  # an invalid host name raises ValueError
            raise TransportError(
                f"CAN {self.description}: cannot connect: {reason(error)}; start `starhil hub --port {self._port}` first"
            ) from None
        try:
            await asyncio.wait_for(self._shake_hands(connection), HANDSHAKE_S)
        except (TransportError, TimeoutError) as error:
            if connection.transport is not None:
                connection.transport.abort()
            if isinstance(error, TransportError):
                raise
            raise TransportError(
                f"CAN {self.description}: no answer within {HANDSHAKE_S:g} s; is this a socketcand server?"
            ) from None
        if connection.transport is None:  # lost after its last answer, before `_on_lost` could know it
            raise TransportError(f"CAN {self.description}: lost: the hub closed the connection")
        self._connection = connection

    async def _shake_hands(self, connection: _Connection) -> None:
        for command, expected in ((None, b"hi"), (f"open {self._bus}", b"ok")):
            answer = await connection.ask(command)
            if answer != expected:
                raise TransportError(
                    f"CAN {self.description}: answer {answer[:40].decode(errors='replace')!r} instead of "
                    f"{expected.decode()!r}; is this a socketcand server with bus {self._bus}?"
                )
        # a plain socketcand server rejects this; there are no remote frames then
        await connection.ask("remote")
        answer = await connection.ask("rawmode")
        if answer != b"ok":
            raise TransportError(f"CAN {self.description}: the server refuses raw mode")
        connection.raw = True

    def _on_frame(self, frame: CanFrame) -> None:
        self.statistics.received += 1
        self._receive(frame)

    def _on_lost(self, connection: _Connection, why: str) -> None:
        if connection is self._connection:
            self._lost(why)

    def _disconnect(self) -> None:
        connection, self._connection = self._connection, None
        if connection is not None and connection.transport is not None:
            connection.transport.close()

    def send(self, item: CanFrame) -> bool:
        """Queue a frame; all frames of one turn of the loop are sent together."""
        connection = self._connection
        if (
            connection is None
            or connection.transport is None
            or connection.transport.get_write_buffer_size() > BACKLOG_LIMIT
        ):
            self.statistics.dropped += 1
            return False
        if not self._outbox:
            asyncio.get_running_loop().call_soon(self._flush_outbox)
        self._outbox.append(format_send(item))
        self.statistics.sent += 1
        return True

    def _flush_outbox(self) -> None:
        text = b"".join(self._outbox)
        count = len(self._outbox)
        self._outbox.clear()
        if self._connection is not None and self._connection.transport is not None:
            self._connection.write(text)
        else:
            self.statistics.sent -= count
            self.statistics.dropped += count

    async def drain(self) -> None:
        """Wait until the socket has accepted the queue."""
        await asyncio.sleep(0)
        if self._connection is not None:
            await self._connection.drain()

    async def close(self) -> None:
        """Leave the bus; send the queue first if the hub reads it."""
        if self._outbox:
            self._flush_outbox()
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(self.drain(), CLOSE_S)
        await super().close()


class AutoHubTransport(HubTransport):
    """Joins the hub at an address, and starts it in this process whenever none answers there.

    Port 0 starts a new hub at a free port.
    """

    def __init__(self, host: str, port: int) -> None:
        super().__init__(host, port, DEFAULT_BUS, self._ensure_hub)
        self._hub: CanHub | None = None

    async def _ensure_hub(self) -> None:
        if self._hub is not None or (self._port and await self._is_served()):
            return
        hub = CanHub(self._host, self._port)
        try:
            await hub.start()
        except ProtocolError:
            if not await self._is_served():
                raise
            return
        self._hub = hub
        if self._reconnection is not None:
            _LOGGER.warning("CAN %s: the hub there has ended; this process serves it now", self.description)
        self._port = hub.port
        self.description = f"socketcand:{self._host}:{self._port}/{self._bus}"

    async def _is_served(self) -> bool:
        """Return whether a server listens at the address."""
        try:
            _, writer = await asyncio.open_connection(self._host, self._port)
        except OSError:
            return False
        writer.close()
        return True

    async def close(self) -> None:
        """Leave the bus, and stop the hub if it runs in this process."""
        await super().close()
        if self._hub is not None:
            await self._hub.close()
            self._hub = None
