"""Transports: one behaviour suite over every kind of serial port and CAN bus that this machine has, and their failures."""

from __future__ import annotations

import asyncio
import contextlib
import os
import subprocess
import time
import tty
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path

import can
import pytest
import serial

from protocol.can_framing import CanFrame
from protocol.errors import ProtocolError
from protocol.hub import CanHub
from protocol.transports import CanTransport, SerialTransport, TransportError, open_can, open_serial
from protocol.transports.can import kernel_can_is_up
from protocol.transports.hub_client import BACKLOG_LIMIT as HUB_BACKLOG
from protocol.transports.paced_writer import BACKLOG_LIMIT
from protocol.transports.python_can import PythonCanTransport

DEADLINE_S = 10.0
HAS_VCAN = kernel_can_is_up("vcan0")


async def until(condition: Callable[[], bool]) -> None:
    """Wait until something is true; the deadline only ends a test that fails."""
    async with asyncio.timeout(DEADLINE_S):
        while not condition():
            await asyncio.sleep(0.002)


# -- serial: the same behaviour over each pair of ends -----------------------------------------------------------------


class SerialPair:
    """Two connected ends and what each has received."""

    def __init__(self, one: SerialTransport, two: SerialTransport) -> None:
        self.one, self.two = one, two
        self.got_one, self.got_two = bytearray(), bytearray()
        self.errors: list[ProtocolError] = []

    async def start(self, transport: SerialTransport, got: bytearray) -> None:
        await transport.start(got.extend, self.errors.append)


@contextlib.asynccontextmanager
async def serial_pair(kind: str, tmp_path: Path, baud: int = 921600) -> AsyncIterator[SerialPair]:
    link = tmp_path / "tty"
    specs = {
        "pty and tty": ("pty", str(link)),
        "listen and socket": ("listen://127.0.0.1:0", None),
    }[kind]
    one = open_serial(specs[0], baud, symlink=link if specs[1] else None)
    pair = SerialPair(one, one)
    await pair.start(one, pair.got_one)
    pair.two = open_serial(specs[1] or one.description, baud)
    await pair.start(pair.two, pair.got_two)
    try:
        yield pair
    finally:
        await pair.two.close()
        await pair.one.close()


SERIAL_KINDS = ["pty and tty", "listen and socket"]


@pytest.mark.parametrize("kind", SERIAL_KINDS)
def test_bytes_of_every_value_pass_both_ways(kind: str, tmp_path: Path) -> None:
    async def main() -> None:
        async with serial_pair(kind, tmp_path) as pair:
            data = bytes(range(256)) * 8
            assert pair.one.send(data)
            assert pair.two.send(data[::-1])
            await until(lambda: len(pair.got_one) >= len(data) and len(pair.got_two) >= len(data))
            assert bytes(pair.got_two) == data
            assert bytes(pair.got_one) == data[::-1]
            assert pair.one.statistics.sent == pair.two.statistics.received == len(data)
            assert not pair.errors

    asyncio.run(main())


@pytest.mark.parametrize("kind", SERIAL_KINDS)
def test_bytes_leave_no_faster_than_the_bit_rate(kind: str, tmp_path: Path) -> None:
    async def main() -> None:
        async with serial_pair(kind, tmp_path, baud=115200) as pair:
            loop = asyncio.get_running_loop()
            received_at: list[tuple[float, int]] = []
            pair.two._on_receive = lambda data: (
                pair.got_two.extend(data),
                received_at.append((loop.time(), len(pair.got_two))),
            )  # type: ignore[assignment]
            begin = loop.time()
            pair.one.send(bytes(576))
            pair.one.send(bytes(576))
            await until(lambda: len(pair.got_two) == 1152)
            for moment, count in received_at:
                assert moment - begin >= count * 10 / 115200 - 1e-6

    asyncio.run(main())


@pytest.mark.parametrize("kind", SERIAL_KINDS)
def test_a_peer_that_does_not_read_neither_blocks_nor_fills_memory(kind: str, tmp_path: Path) -> None:
    async def main() -> None:
        async with serial_pair(kind, tmp_path, baud=4_000_000) as pair:
            if kind == "pty and tty":
                asyncio.get_running_loop().remove_reader(pair.two._port.fileno())  # type: ignore[attr-defined]
            else:
                pair.two._stream.pause_reading()  # type: ignore[attr-defined]
            refused = 0
            while refused < 3:
                refused += not pair.one.send(bytes(1024))
                if pair.one.statistics.sent > 50_000_000:
                    pytest.fail("the peer's buffers never fill")
                await asyncio.sleep(0)
            assert pair.one.statistics.dropped == 3 * 1024
            assert pair.one._writer.backlog <= BACKLOG_LIMIT  # type: ignore[attr-defined]
            pair.two.send(b"still alive")
            await until(lambda: bytes(pair.got_one) == b"still alive")

    asyncio.run(main())


def test_a_vanished_port_is_told_once_and_comes_back_by_itself(tmp_path: Path) -> None:
    async def main() -> None:
        link = tmp_path / "tty"
        async with serial_pair("pty and tty", tmp_path) as pair:
            await pair.one.close()
            await until(lambda: bool(pair.errors))
            assert str(pair.errors[0]).startswith(f"serial {link}: lost: ")
            assert not pair.two.send(b"into the void")
            assert pair.two.statistics.dropped == len(b"into the void")
            again = open_serial("pty", symlink=link)
            got = bytearray()
            await again.start(got.extend)
            await until(lambda: pair.two.statistics.reconnects == 1)
            pair.two.send(b"hello again")
            await until(lambda: bytes(got) == b"hello again")
            assert len(pair.errors) == 1
            await again.close()

    asyncio.run(main())


def test_a_lost_connection_comes_back_by_itself() -> None:
    async def main() -> None:
        one = open_serial("listen://127.0.0.1:0")
        await one.start(lambda _: None)
        port = int(one.description.rpartition(":")[2])
        two = open_serial(one.description)
        errors: list[ProtocolError] = []
        await two.start(lambda _: None, errors.append)
        await one.close()
        await until(lambda: bool(errors))
        again = open_serial(f"listen://127.0.0.1:{port}")
        got = bytearray()
        await again.start(got.extend)
        await until(lambda: two.statistics.reconnects == 1)
        two.send(b"back")
        await until(lambda: bytes(got) == b"back")
        await two.close()
        await again.close()

    asyncio.run(main())


def test_a_listening_port_serves_one_peer_at_a_time_and_the_next_after_it() -> None:
    async def main() -> None:
        one = open_serial("listen://127.0.0.1:0")
        got = bytearray()
        await one.start(got.extend)
        host, _, port = one.description.removeprefix("socket://").rpartition(":")
        _, first = await asyncio.open_connection(host, int(port))
        first.write(b"first")
        await until(lambda: bytes(got) == b"first")
        reader, _ = await asyncio.open_connection(host, int(port))
        assert await reader.read() == b""
        first.close()
        for _ in range(100):
            reader, third = await asyncio.open_connection(host, int(port))
            third.write(b"third")
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(until(lambda: got.endswith(b"third")), 0.2)
            if got.endswith(b"third"):
                break
        one.send(b"reply")
        assert await asyncio.wait_for(reader.readexactly(5), DEADLINE_S) == b"reply"
        third.close()
        await one.close()

    asyncio.run(main())


def test_pyserial_opens_our_pseudo_terminal_and_our_socket(tmp_path: Path) -> None:
    def echo(url: str) -> bytes:
        with serial.serial_for_url(url, 115200, timeout=DEADLINE_S) as port:
            port.write(b"\x1f\x7f\x80\x1f\xff")
            return bytes(port.read(5))

    async def main() -> None:
        for spec, link in (("pty", tmp_path / "star"), ("listen://127.0.0.1:0", None)):
            transport = open_serial(spec, symlink=link)
            await transport.start(transport.send)
            assert await asyncio.to_thread(echo, transport.description) == b"\x1f\x7f\x80\x1f\xff"
            await transport.close()

    asyncio.run(main())


def test_the_symlink_replaces_a_stale_one_and_goes_at_close(tmp_path: Path) -> None:
    async def main() -> None:
        link = tmp_path / "tty"
        link.symlink_to("/nowhere")
        transport = open_serial("auto", symlink=link)
        await transport.start(lambda _: None)
        assert os.path.realpath(link).startswith("/dev/pts/")
        assert transport.description == str(link)
        await transport.close()
        await transport.close()
        assert list(tmp_path.iterdir()) == []

    asyncio.run(main())


def test_a_symlink_taken_over_by_another_is_left_alone(tmp_path: Path) -> None:
    async def main() -> None:
        link = tmp_path / "tty"
        one, two = open_serial("pty", symlink=link), open_serial("pty", symlink=link)
        await one.start(lambda _: None)
        await two.start(lambda _: None)
        await one.close()
        assert link.is_symlink()
        await two.close()

    asyncio.run(main())


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("/dev/does-not-exist", "no such port"),
        ("/etc/passwd", "is no tty"),
        ("/dev/null", "cannot open"),
        ("socket://127.0.0.1:1", "cannot connect"),
        ("socket://127.0.0.1", "must be socket://HOST:PORT"),
        ("listen://127.0.0.1:x", "must be listen://HOST:PORT"),
        ("rfc2217://host:1", "must be auto, a tty's path"),
    ],
)
def test_ports_that_cannot_be_had_are_told_in_one_line(spec: str, message: str) -> None:
    async def main() -> None:
        with pytest.raises(TransportError, match=message) as caught:
            await open_serial(spec).start(lambda _: None)
        assert str(caught.value).startswith(f"serial {spec}")
        assert "\n" not in str(caught.value)

    asyncio.run(main())


def test_a_busy_port_is_told() -> None:
    async def main() -> None:
        master, slave = os.openpty()
        tty.setraw(slave)
        path = os.ttyname(slave)
        with serial.Serial(path, exclusive=True), pytest.raises(TransportError, match="busy"):
            await open_serial(path).start(lambda _: None)
        os.close(slave)
        os.close(master)

    asyncio.run(main())


def test_a_file_in_the_symlinks_place_is_not_overwritten(tmp_path: Path) -> None:
    async def main() -> None:
        link = tmp_path / "precious"
        link.write_text("data")
        transport = open_serial("pty", symlink=link)
        with pytest.raises(TransportError, match="is no symlink"):
            await transport.start(lambda _: None)
        await transport.close()
        assert link.read_text() == "data"

    asyncio.run(main())


# -- CAN: the same behaviour over each bus -----------------------------------------------------------------------------

FRAMES = [
    CanFrame(0x08AA0401, bytes(range(8))),
    CanFrame(0x123, b"\x1f", extended=False),
    CanFrame(0x123, b"\x1f"),
    CanFrame(0, b"", extended=False),
    CanFrame(0x1FFFFFFF, b""),
]

CAN_KINDS = [
    "hub",
    "virtual",
    "udp_multicast",
    "slcan",
    pytest.param(
        "socketcan", marks=[pytest.mark.socketcan, pytest.mark.skipif(not HAS_VCAN, reason="no vcan0 here")]
    ),
]


class CanPair:
    """Two transports on one bus and what each has received."""

    def __init__(self, one: CanTransport, two: CanTransport) -> None:
        self.one, self.two = one, two
        self.got_one: list[CanFrame] = []
        self.got_two: list[CanFrame] = []
        self.errors: list[ProtocolError] = []

    async def start(self) -> None:
        await self.one.start(lambda frame: self.got_one.append(bare(frame)), self.errors.append)
        await self.two.start(lambda frame: self.got_two.append(bare(frame)), self.errors.append)


def bare(frame: CanFrame) -> CanFrame:
    """The frame without its time."""
    return CanFrame(frame.id, frame.data, frame.extended, frame.remote)


@contextlib.asynccontextmanager
async def crossed_ptys() -> AsyncIterator[tuple[str, str]]:
    """Two tty paths with a cable between them."""
    loop = asyncio.get_running_loop()
    masters, slaves = zip(os.openpty(), os.openpty(), strict=True)
    for source, sink in (masters, masters[::-1]):
        loop.add_reader(source, lambda source=source, sink=sink: os.write(sink, os.read(source, 4096)))
    for slave in slaves:
        tty.setraw(slave)
    try:
        yield os.ttyname(slaves[0]), os.ttyname(slaves[1])
    finally:
        for master in masters:
            loop.remove_reader(master)
        for end in (*masters, *slaves):
            os.close(end)


@contextlib.asynccontextmanager
async def can_pair(kind: str) -> AsyncIterator[CanPair]:
    async with contextlib.AsyncExitStack() as stack:
        specs = {
            "virtual": "virtual:pair",
            "udp_multicast": "udp_multicast:239.74.163.9",
            "socketcan": "vcan0",
        }
        if kind == "hub":
            hub = CanHub(port=0)
            await hub.start()
            stack.push_async_callback(hub.close)
            one = two = f"socketcand:127.0.0.1:{hub.port}/vcan0"
        elif kind == "slcan":
            paths = await stack.enter_async_context(crossed_ptys())
            one, two = (f"slcan:{path}" for path in paths)
        else:
            one = two = specs[kind]
        pair = CanPair(open_can(one), open_can(two))
        await pair.start()
        stack.push_async_callback(pair.one.close)
        stack.push_async_callback(pair.two.close)
        yield pair


@pytest.mark.parametrize("kind", CAN_KINDS)
def test_frames_pass_both_ways_whole_in_order_and_without_echo(kind: str) -> None:
    async def main() -> None:
        async with can_pair(kind) as pair:
            for frame in FRAMES:
                assert pair.one.send(frame)
            await pair.one.drain()
            await until(lambda: len(pair.got_two) >= len(FRAMES))
            for frame in FRAMES[::-1]:
                assert pair.two.send(frame)
            await until(lambda: len(pair.got_one) >= len(FRAMES))
            await asyncio.sleep(0.05)
            assert pair.got_two == FRAMES
            assert pair.got_one == FRAMES[::-1]
            assert not pair.errors
            assert pair.one.statistics.sent == pair.one.statistics.received == len(FRAMES)

    asyncio.run(main())


@pytest.mark.parametrize("kind", ["hub", "virtual", "udp_multicast", CAN_KINDS[-1]])
def test_remote_frames_pass(kind: str) -> None:
    async def main() -> None:
        async with can_pair(kind) as pair:
            remote = CanFrame(0x701, extended=False, remote=True)
            pair.one.send(remote)
            await until(lambda: pair.got_two == [remote])

    asyncio.run(main())


@pytest.mark.parametrize("kind", ["hub", "virtual", CAN_KINDS[-1]])
def test_a_burst_passes_whole(kind: str) -> None:
    async def main() -> None:
        async with can_pair(kind) as pair:
            burst = [CanFrame(number, number.to_bytes(4, "little")) for number in range(3000)]
            for frame in burst:
                assert pair.one.send(frame)
            await until(lambda: len(pair.got_two) >= len(burst))
            assert pair.got_two == burst

    asyncio.run(main())


def test_identical_frames_of_two_nodes_are_no_echo() -> None:
    async def main() -> None:
        async with can_pair("udp_multicast") as pair:
            for _ in range(20):
                pair.one.send(FRAMES[0])
                pair.two.send(FRAMES[0])
            await until(lambda: len(pair.got_one) >= 20 and len(pair.got_two) >= 20)
            await asyncio.sleep(0.05)
            assert pair.got_one == pair.got_two == [FRAMES[0]] * 20

    asyncio.run(main())


def test_a_hub_that_goes_and_comes_back_is_found_again() -> None:
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
        assert transport._connection.transport.get_write_buffer_size() < HUB_BACKLOG + 100_000  # type: ignore[attr-defined]
        await transport.close()
        server.close()

    asyncio.run(main())


def _set_link(state: str) -> None:
    result = subprocess.run(
        ["ip", "link", "set", "vcan0", state], capture_output=True, text=True, check=False
    )
    if result.returncode:
        pytest.skip(f"vcan0 cannot be set {state} here: {result.stderr.strip()}")


@pytest.mark.socketcan
@pytest.mark.skipif(not HAS_VCAN, reason="no vcan0 here")
def test_an_interface_that_goes_down_is_told_and_found_again() -> None:
    async def main() -> None:
        async with can_pair("socketcan") as pair:
            _set_link("down")
            try:
                pair.one.send(FRAMES[0])
                await until(lambda: len(pair.errors) == 2)
                assert "lost" in str(pair.errors[0])
            finally:
                _set_link("up")
            await until(lambda: pair.one.statistics.reconnects == pair.two.statistics.reconnects == 1)
            pair.one.send(FRAMES[1])
            await until(lambda: pair.got_two == [FRAMES[1]])

    asyncio.run(main())


class _BusInTrouble(can.BusABC):
    """A bus that reports bus-off once and is silent then."""

    def __init__(self) -> None:
        super().__init__(channel="trouble")
        self._messages = [
            can.Message(arbitration_id=0x40, is_error_frame=True, is_extended_id=True, data=bytes(8))
        ]

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if self._messages:
            return self._messages.pop(), True
        time.sleep(timeout or 0.0)
        return None, True

    def send(self, msg: can.Message, timeout: float | None = None) -> None:  # noqa: ARG002
        raise can.CanOperationError("bus-off")


def test_bus_off_is_told_and_no_frame() -> None:
    async def main() -> None:
        transport = PythonCanTransport("trouble:0", _BusInTrouble)
        errors: list[ProtocolError] = []
        got: list[CanFrame] = []
        await transport.start(got.append, errors.append)
        await until(lambda: bool(errors))
        assert "bus-off; check the wiring" in str(errors[0])
        transport.send(FRAMES[0])
        await until(lambda: len(errors) >= 2)
        assert "lost: bus-off" in str(errors[1])
        await transport.close()
        assert got == []
        assert transport.statistics.dropped == 1

    asyncio.run(main())


@pytest.mark.skipif(HAS_VCAN, reason="auto takes vcan0 here")
def test_auto_starts_a_hub_joins_it_and_takes_over_when_its_owner_leaves() -> None:
    async def main() -> None:
        probe = CanHub(port=0)
        await probe.start()
        port = probe.port
        await probe.close()
        one, two, three = (open_can("auto", hub_port=port) for _ in range(3))
        got: list[CanFrame] = []
        await one.start(lambda _: None)
        await two.start(lambda _: None)
        await three.start(lambda frame: got.append(bare(frame)))
        assert one.description == two.description == f"socketcand:127.0.0.1:{port}/vcan0"
        await one.close()
        await until(lambda: two.statistics.reconnects == three.statistics.reconnects == 1)
        two.send(FRAMES[0])
        await until(lambda: got == FRAMES[:1])
        await two.close()
        await three.close()

    asyncio.run(main())


@pytest.mark.skipif(HAS_VCAN, reason="auto takes vcan0 here")
def test_auto_with_port_0_is_a_bus_of_its_own() -> None:
    async def main() -> None:
        one, two = open_can("auto", hub_port=0), open_can("auto", hub_port=0)
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
        await transport.start(lambda frame: got.append(bare(frame)))
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
def test_a_server_that_is_no_socketcand_is_told(greeting: bytes) -> None:
    async def main() -> None:
        async with await _wrong_server(greeting) as server:
            port = server.sockets[0].getsockname()[1]
            with pytest.raises(TransportError, match="is this a socketcand server"):
                await open_can(f"socketcand:127.0.0.1:{port}/vcan0").start(lambda _: None)

    asyncio.run(main())


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("nonsense:1", "must be auto, a kernel interface"),
        ("socketcand:127.0.0.1", "must be socketcand:HOST:PORT/BUS"),
        ("socketcand:127.0.0.1:1/vcan0", "start `starhil hub --port 1` first"),
        ("slcan:/dev/does-not-exist", "cannot open"),
        pytest.param(
            "vcan0",
            "this kernel has no CAN",
            marks=pytest.mark.skipif(HAS_VCAN, reason="this kernel has CAN"),
        ),
        pytest.param(
            "can77",
            "no such interface",
            marks=[pytest.mark.socketcan, pytest.mark.skipif(not HAS_VCAN, reason="this kernel has no CAN")],
        ),
    ],
)
def test_buses_that_cannot_be_had_are_told_in_one_line(spec: str, message: str) -> None:
    async def main() -> None:
        with pytest.raises(TransportError, match=message) as caught:
            await open_can(spec).start(lambda _: None)
        assert "\n" not in str(caught.value)

    asyncio.run(main())


def test_closing_twice_or_unopened_is_harmless(tmp_path: Path) -> None:
    async def main() -> None:
        closers: list[Callable[[], Awaitable[None]]] = []
        for transport in (
            open_serial("pty", symlink=tmp_path / "t"),
            open_serial("listen://127.0.0.1:0"),
            open_serial("/dev/nope"),
        ):
            closers += [transport.close] * 2
        for bus in (open_can("virtual:x"), open_can("auto"), open_can("socketcand:127.0.0.1:1/vcan0")):
            closers += [bus.close] * 2
        for close in closers:
            await close()

    asyncio.run(main())
