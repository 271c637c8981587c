"""A CAN bus over TCP: client of `CanHub` or any socketcand server, with reconnection."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from typing import Final

from starhil.protocol.can.frame import CanFrame
from starhil.protocol.can.socketcand import CommandError, CommandSplitter, format_send, parse_frame
from starhil.protocol.errors import ProtocolError, reason
from starhil.protocol.transports.base import TURN_S, ReconnectingTransport, TransportError
from starhil.protocol.transports.connections import detect_lost_peer, limit_buffers
from starhil.protocol.transports.hub import DEFAULT_BUS, CanHub

_LOGGER: Final = logging.getLogger("starhil.transport")

BACKLOG_LIMIT: Final = 4 * 1024 * 1024
"""Maximum number of bytes that wait for a hub that does not read."""

READ_SIZE: Final = 512
"""Maximum number of bytes that are read per turn of the loop: some 15 frames."""

HANDSHAKE_S: Final = 5.0
"""Longest time for the server's greeting and answers."""

CLOSE_S: Final = 0.5
"""Longest time that close waits for the hub to read the queue."""


class HubTransport(ReconnectingTransport[CanFrame]):
    """A bus of a socketcand server."""

    kind = "CAN"

    def __init__(self, host: str, port: int, bus: str) -> None:
        super().__init__(f"socketcand:{host}:{port}/{bus}")
        self._host = host
        self._port = port
        self._bus = bus
        self._writer: asyncio.StreamWriter | None = None
        self._reading: asyncio.Task[None] | None = None
        self._outbox: list[bytes] = []

    async def _open(self) -> None:
        try:
            reader, writer = await asyncio.open_connection(self._host, self._port)
        except (OSError, ValueError) as error:  # an invalid host name raises ValueError
            raise TransportError(
                f"CAN {self.description}: cannot connect: {reason(error)}; start `starhil hub --port {self._port}` first"
            ) from None
        detect_lost_peer(writer.transport, must_read=True)
        limit_buffers(writer.transport)
        writer.transport.set_write_buffer_limits(high=0)
        try:
            async with asyncio.timeout(HANDSHAKE_S):
                await self._shake_hands(reader, writer)
        except TimeoutError:
            writer.transport.abort()
            raise TransportError(
                f"CAN {self.description}: no answer within {HANDSHAKE_S:g} s; is this a socketcand server?"
            ) from None
        except BaseException:
            writer.transport.abort()
            raise
        self._writer = writer
        self._reading = asyncio.get_running_loop().create_task(self._read(reader, writer))
        self._reading.add_done_callback(self._on_reading_ended)

    async def _shake_hands(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Open the bus, if possible with remote frames, which a plain socketcand server does not have."""
        for command, expected in (
            ("", b"hi"),
            (f"open {self._bus}", b"ok"),
            ("remote", b""),
            ("rawmode", b"ok"),
        ):
            if command:
                writer.write(f"< {command} >".encode())
            try:
                answer = (await reader.readuntil(b">"))[:-1].rpartition(b"<")[2].strip()
            except (EOFError, OSError, asyncio.LimitOverrunError):
                answer = b""
            if expected not in (b"", answer):
                raise TransportError(
                    f"CAN {self.description}: answer {answer[:40].decode(errors='replace')!r} to {command!r} instead of "
                    f"{expected.decode()!r}; is this a socketcand server with bus {self._bus}?"
                )

    async def _read(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Receive frames until the connection ends.

        While the server does not read, nothing is read from it either, because replies to more requests could
        not be sent.
        """
        splitter = CommandSplitter()
        while data := await reader.read(READ_SIZE):
            begin_s = time.monotonic()
            for command in splitter.feed(data):
                if time.monotonic() - begin_s > TURN_S:
                    await asyncio.sleep(0)
                    begin_s = time.monotonic()
                self._receive_command(command)
            await asyncio.sleep(0)  # the loop serves other connections, and the outbox is written
            await writer.drain()

    def _on_reading_ended(self, reading: asyncio.Task[None]) -> None:
        if not reading.cancelled():
            error = reading.exception()
            self._lost(f"{type(error).__name__}: {error}" if error else "the hub closed the connection")

    def _receive_command(self, command: bytes | None) -> None:
        """Receive a frame; ignore any other text."""
        try:
            frame = parse_frame(command or b"")
        except CommandError:
            return
        self.statistics.received += 1
        self._receive(frame)

    def _disconnect(self) -> None:
        if self._reading is not None:
            self._reading.cancel()
        if self._writer is not None:
            self._writer.close()
        self._reading = self._writer = None

    def send(self, item: CanFrame) -> bool:
        """Queue a frame; all frames of one turn of the loop are sent together."""
        if self._writer is None or self._writer.transport.get_write_buffer_size() > BACKLOG_LIMIT:
            self.statistics.dropped += 1
            return False
        if not self._outbox:
            asyncio.get_running_loop().call_soon(self._flush_outbox)
        self._outbox.append(format_send(item))
        self.statistics.sent += 1
        return True

    def _flush_outbox(self) -> None:
        if self._writer is not None:
            self._writer.write(b"".join(self._outbox))
        else:
            self.statistics.sent -= len(self._outbox)
            self.statistics.dropped += len(self._outbox)
        self._outbox.clear()

    async def drain(self) -> None:
        """Wait until the socket has accepted the queue."""
        await asyncio.sleep(0)
        if self._writer is not None:
            with contextlib.suppress(OSError):  # the connection was lost
                await self._writer.drain()

    async def close(self) -> None:
        """Leave the bus; send the queue first if the hub reads it."""
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(self.drain(), CLOSE_S)
        await super().close()


class AutoHubTransport(HubTransport):
    """Joins the hub at an address, and starts it in this process if there is none.

    Port 0 starts a new hub at a free port.
    """

    def __init__(self, host: str, port: int) -> None:
        super().__init__(host, port, DEFAULT_BUS)
        self._hub: CanHub | None = None

    async def _open(self) -> None:
        if self._hub is None:
            hub = CanHub(self._host, self._port)
            try:
                await hub.start()
            except ProtocolError:
                pass  # somebody listens there
            else:
                self._hub = hub
                if self._reconnection is not None:
                    _LOGGER.warning(
                        "CAN %s: the hub there has ended; this process serves it now", self.description
                    )
                self._port = hub.port
                self.description = f"socketcand:{self._host}:{self._port}/{self._bus}"
        await super()._open()

    async def close(self) -> None:
        """Leave the bus, and stop the hub if it runs in this process."""
        await super().close()
        if self._hub is not None:
            await self._hub.close()
            self._hub = None
