"""The CAN bus over TCP from its clients' side: a hub that ends, hangs, restarts, or is no hub."""

from __future__ import annotations

import asyncio
import socket
import subprocess
import sys
import threading
from pathlib import Path

import can
import pytest

from starhil.protocol.can.frame import CanFrame
from starhil.protocol.transports.base import TransportError
from starhil.protocol.transports.can import new_hub, open_can
from starhil.protocol.transports.hub import DEFAULT_HOST, CanHub
from starhil.protocol.transports.hub_client import BACKLOG_LIMIT as HUB_BACKLOG
from starhil.protocol.transports.hub_client import AutoHubTransport
from tests.protocol.transports.pairs import FRAMES, CanPair
from tests.waiting import until

pytestmark = pytest.mark.long


def test_a_restarted_hub_is_found_again() -> None:
    async def main() -> None:
        hub = CanHub(port=0)
        await hub.start()
        pair = CanPair(*(open_can(f"socketcand:127.0.0.1:{hub.port}/vcan0") for _ in range(2)))
        await pair.start()
        await hub.close()
        await until(lambda: len(pair.errors) == 2)
        assert "lost" in str(pair.errors[0])
        assert not pair.one.send(FRAMES[0])
        again = CanHub(port=hub.port)
        await again.start()
        await until(lambda: pair.one.statistics.reconnects == pair.two.statistics.reconnects == 1)
        pair.one.send(FRAMES[0])
        await until(lambda: pair.got_two == FRAMES[:1])
        assert len(pair.errors) == 2
        await pair.one.close()
        await pair.two.close()
        await again.close()

    asyncio.run(main())


def test_a_hub_that_stops_reading_neither_blocks_nor_fills_memory() -> None:
    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(b"< hi >")
        for _ in range(3):
            await reader.readuntil(b">")
            writer.write(b"< ok >")
        await asyncio.Event().wait()

    async def main() -> None:
        server = await asyncio.start_server(serve, "127.0.0.1", 0, limit=64)
        transport = open_can(f"socketcand:127.0.0.1:{server.sockets[0].getsockname()[1]}/vcan0")
        await transport.start(lambda _: None)
        for number in range(1_000_000):
            if not transport.send(FRAMES[0]):
                break
            if number % 500 == 0:
                await asyncio.sleep(0)
        assert transport.statistics.dropped == 1
        assert transport._writer.transport.get_write_buffer_size() < HUB_BACKLOG + 100_000  # type: ignore[attr-defined]
        await transport.close()
        server.close()

    asyncio.run(main())


def test_auto_starts_a_hub_joins_it_and_takes_over_when_its_owner_leaves() -> None:
    async def main() -> None:
        probe = CanHub(port=0)
        await probe.start()
        port = probe.port
        await probe.close()
        one, two, three = (AutoHubTransport(DEFAULT_HOST, port) for _ in range(3))
        got: list[CanFrame] = []
        await one.start(lambda _: None)
        await two.start(lambda _: None)
        await three.start(got.append)
        assert one.description == two.description == f"socketcand:127.0.0.1:{port}/vcan0"
        await one.close()
        await until(lambda: two.statistics.reconnects == three.statistics.reconnects == 1)
        two.send(FRAMES[0])
        await until(lambda: got == FRAMES[:1])
        await two.close()
        await three.close()

    asyncio.run(main())


FOUNDER = """
import asyncio
from starhil.protocol.transports.hub_client import AutoHubTransport
async def main():
    await AutoHubTransport("127.0.0.1", {port}).start(lambda _: None)
    print("founded", flush=True)
    await asyncio.Event().wait()
asyncio.run(main())
"""


def test_the_bus_survives_the_process_that_started_it(caplog: pytest.LogCaptureFixture) -> None:
    async def main() -> None:
        with socket.create_server(("127.0.0.1", 0)) as probe:
            port = probe.getsockname()[1]
        founder = await asyncio.create_subprocess_exec(
            sys.executable, "-c", FOUNDER.format(port=port), stdout=asyncio.subprocess.PIPE
        )
        try:
            assert founder.stdout is not None
            assert await founder.stdout.readline() == b"founded\n"
            heirs = [AutoHubTransport(DEFAULT_HOST, port) for _ in range(3)]
            bench = open_can(f"socketcand:127.0.0.1:{port}/vcan0")
            got: list[CanFrame] = []
            for transport in (*heirs, bench):
                await transport.start(got.append)
            assert [heir._hub for heir in heirs] == [None] * 3
        finally:
            founder.kill()
            await founder.wait()
        await until(lambda: all(each.statistics.reconnects == 1 for each in (*heirs, bench)))
        assert sum(heir._hub is not None for heir in heirs) == 1
        assert heirs[0].send(FRAMES[0])
        await until(lambda: got == [FRAMES[0]] * 3)
        for transport in (bench, *heirs):
            await transport.close()

    asyncio.run(main())
    texts = [record.getMessage() for record in caplog.records]
    assert sum("the hub there has ended; this process serves it now" in text for text in texts) == 1
    assert sum(text.endswith("/vcan0: back") for text in texts) == 4


def test_auto_with_port_0_is_a_private_bus() -> None:
    async def main() -> None:
        one, two = new_hub(), new_hub()
        await one.start(lambda _: None)
        await two.start(lambda _: None)
        assert one.description != two.description
        await one.close()
        await two.close()

    asyncio.run(main())


def test_python_can_joins_the_bus_that_auto_made() -> None:
    def send(description: str) -> None:
        address, _, bus_name = description.removeprefix("socketcand:").partition("/")
        host, _, port = address.rpartition(":")
        with can.Bus(interface="socketcand", host=host, port=int(port), channel=bus_name) as bus:
            bus.send(can.Message(arbitration_id=0x123, is_extended_id=False, data=b"\x1f"))

    async def main() -> None:
        hub = CanHub(port=0)
        await hub.start()
        transport = open_can(f"socketcand:127.0.0.1:{hub.port}/vcan0")
        got: list[CanFrame] = []
        await transport.start(got.append)
        await asyncio.to_thread(send, transport.description)
        await until(lambda: got == [FRAMES[1]])
        await transport.close()
        await hub.close()

    asyncio.run(main())


async def _wrong_server(greeting: bytes) -> asyncio.Server:
    async def serve(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(greeting)
        await writer.drain()
        writer.close()

    return await asyncio.start_server(serve, "127.0.0.1", 0)


@pytest.mark.parametrize("greeting", [b"SSH-2.0-OpenSSH", b"< error busy >", b"", b"< hi >"])
def test_a_server_other_than_socketcand_is_reported(greeting: bytes) -> None:
    async def main() -> None:
        async with await _wrong_server(greeting) as server:
            port = server.sockets[0].getsockname()[1]
            with pytest.raises(TransportError, match="is this a socketcand server"):
                await open_can(f"socketcand:127.0.0.1:{port}/vcan0").start(lambda _: None)

    asyncio.run(main())


IN_GUEST = Path("/run/vcan-guest").is_dir()


@pytest.mark.socketcan
@pytest.mark.skipif(not IN_GUEST, reason="takes the loopback interface down: in the guest only")
def test_a_hub_lost_without_a_close_is_noticed_and_found_again() -> None:
    """The connection is half open: no FIN, no RST, packets simply vanish."""

    async def main() -> None:
        hub = CanHub(port=0)
        await hub.start()
        pair = CanPair(*(open_can(f"socketcand:127.0.0.1:{hub.port}/vcan0") for _ in range(2)))
        await pair.start()
        subprocess.run(["ip", "link", "set", "lo", "down"], check=True)
        try:
            pair.one.send(FRAMES[0])
            await until(
                lambda: len(pair.errors) >= 2
            )  # the one by its unanswered frame, the other by the silence
        finally:
            subprocess.run(["ip", "link", "set", "lo", "up"], check=True)
        await until(lambda: pair.one.statistics.reconnects == pair.two.statistics.reconnects == 1)
        pair.one.send(FRAMES[1])
        await until(lambda: pair.got_two == [FRAMES[1]])
        await pair.one.close()
        await pair.two.close()
        await hub.close()

    asyncio.run(main())


def test_the_library_s_client_takes_a_closed_server_for_a_silent_bus_and_loses_remote_frames() -> None:
    """Why this project has a client of its own; if python-can mends it, use it."""
    listening = socket.create_server(("127.0.0.1", 0))
    sent: list[bytes] = []

    def serve() -> None:
        connection, _ = listening.accept()
        with connection:
            for answer in (b"< hi >", b"< ok >", b"< ok >"):
                connection.sendall(answer)
                sent.append(connection.recv(256))

    server = threading.Thread(target=serve)
    server.start()
    port = listening.getsockname()[1]
    with can.Bus(interface="socketcand", host="127.0.0.1", port=port, channel="vcan0") as bus:
        bus.send(can.Message(arbitration_id=0x123, is_extended_id=False, is_remote_frame=True))
        server.join()
        assert [bus.recv(0.1) for _ in range(3)] == [None] * 3
    listening.close()
    assert sent[-1] == b"< send 123 0  >"
