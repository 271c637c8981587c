"""The peer leaves and comes back: one table over every transport, serial lines slow enough to have much in the queue."""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
import tty
from abc import ABC, abstractmethod
from pathlib import Path

import pytest

from starhil.protocol.can.frame import CanFrame
from starhil.protocol.transports.base import Transport
from starhil.protocol.transports.can import open_can
from starhil.protocol.transports.hub import CanHub
from starhil.protocol.transports.paced import SerialTransport
from starhil.protocol.transports.serial import open_serial
from tests.protocol.transports.pairs import FRAMES
from tests.waiting import until

pytestmark = pytest.mark.long

SLOW_BAUD = 9600
QUEUED = (bytes(120),) * 100
"""Messages for 12.5 s of a line at 9600 baud: longer than `until` waits."""
NEWS = b"news"


class Peer(ABC):
    """The other end of a line, which comes and goes."""

    waits_for_the_transport = False
    """Whether the transport has to be open before this end can."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.got = bytearray()

    @property
    def spec(self) -> str:
        """What the transport under test opens."""
        return "pty"

    @abstractmethod
    async def come(self, address: str) -> None:
        """Open the line."""

    @abstractmethod
    async def leave(self) -> None:
        """Close it."""


class PtyReader(Peer):
    """A program that opens the pseudo-terminal."""

    waits_for_the_transport = True

    async def come(self, address: str) -> None:
        self.fd = os.open(address, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        tty.setraw(self.fd)
        asyncio.get_running_loop().add_reader(self.fd, lambda: self.got.extend(os.read(self.fd, 4096)))

    async def leave(self) -> None:
        asyncio.get_running_loop().remove_reader(self.fd)
        os.close(self.fd)


class PtyOwner(Peer):
    """A program that owns the pseudo-terminal which the transport opens by its path."""

    @property
    def spec(self) -> str:
        return str(self.folder / "tty")

    async def come(self, address: str) -> None:  # noqa: ARG002
        self.ends = os.openpty()
        tty.setraw(self.ends[1])
        fresh = self.folder / "fresh"
        fresh.symlink_to(os.ttyname(self.ends[1]))
        fresh.replace(self.folder / "tty")
        master = self.ends[0]
        asyncio.get_running_loop().add_reader(master, lambda: self.got.extend(os.read(master, 4096)))

    async def leave(self) -> None:
        asyncio.get_running_loop().remove_reader(self.ends[0])
        for end in self.ends:
            os.close(end)


class TcpClient(Peer):
    """A program that connects to the listening transport."""

    waits_for_the_transport = True

    @property
    def spec(self) -> str:
        return "listen://127.0.0.1:0"

    async def come(self, address: str) -> None:
        host, port = address.removeprefix("socket://").split(":")
        reader, self.writer = await asyncio.open_connection(host, int(port))
        self.task = asyncio.create_task(self._read(reader))

    async def _read(self, reader: asyncio.StreamReader) -> None:
        while data := await reader.read(4096):
            self.got += data

    async def leave(self) -> None:
        self.task.cancel()
        self.writer.transport.abort()


class TcpServer(Peer):
    """A serial server that the transport connects to."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        with socket.create_server(("127.0.0.1", 0)) as probe:
            self.port = probe.getsockname()[1]

    @property
    def spec(self) -> str:
        return f"socket://127.0.0.1:{self.port}"

    async def come(self, address: str) -> None:  # noqa: ARG002
        self.server = await asyncio.start_server(self._serve, "127.0.0.1", self.port)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.writer = writer
        with contextlib.suppress(ConnectionError):
            while data := await reader.read(4096):
                self.got += data

    async def leave(self) -> None:
        self.server.close()
        self.writer.transport.abort()


LINES = {"pty": PtyReader, "tty": PtyOwner, "listen": TcpClient, "socket": TcpServer}
BUSES = {"hub": "", "virtual": "virtual:returns", "udp_multicast": "udp_multicast:239.74.163.11"}


@pytest.mark.parametrize("kind", LINES)
def test_a_line_carries_only_bytes_sent_after_the_peer_returned(kind: str, tmp_path: Path) -> None:
    async def main() -> None:
        peer = LINES[kind](tmp_path)
        line = open_serial(peer.spec, SLOW_BAUD, paced=True)
        if peer.waits_for_the_transport:
            await line.start(lambda _: None)
            await peer.come(line.description)
        else:
            await peer.come("")
            await line.start(lambda _: None)
        await _hears(peer, line)
        assert all(line.send(message) for message in QUEUED)
        await until(lambda: len(peer.got) > len(NEWS))
        await peer.leave()
        await until(lambda: line.statistics.dropped > 0)
        line.send(b"to nobody")
        await until(lambda: line._backlog == 0)  # type: ignore[attr-defined]
        peer.got.clear()
        await peer.come(line.description)
        await _hears(peer, line)
        assert bytes(peer.got) == NEWS
        await peer.leave()
        await line.close()

    asyncio.run(main())


async def _hears(peer: Peer, line: SerialTransport) -> None:
    """Send as soon as the line has its peer, and wait until the peer has it."""
    await until(lambda: getattr(line, "_stream", line) is not None and line.send(NEWS))
    await until(lambda: len(peer.got) >= len(NEWS))


@pytest.mark.parametrize("kind", BUSES)
def test_a_bus_carries_to_a_returned_peer_only_later_frames(kind: str) -> None:
    async def main() -> None:
        async with contextlib.AsyncExitStack() as stack:
            spec = BUSES[kind]
            if kind == "hub":
                hub = CanHub(port=0)
                await hub.start()
                stack.push_async_callback(hub.close)
                spec = f"socketcand:127.0.0.1:{hub.port}/vcan0"
            node: Transport[CanFrame] = open_can(spec)
            await node.start(lambda _: None)
            stack.push_async_callback(node.close)
            for sent in (FRAMES[0], FRAMES[2]):
                got: list[CanFrame] = []
                peer = open_can(spec)
                await peer.start(got.append)
                assert node.send(sent)
                await until(lambda got=got: len(got) > 0)
                assert got == [sent]
                await peer.close()
                assert node.send(FRAMES[1])
                await node.drain()

    asyncio.run(main())
