"""Serial ports: one behaviour suite over every kind, and their failures."""

from __future__ import annotations

import asyncio
import errno
import os
import socket
import termios
import time
import tty
from pathlib import Path
from typing import NoReturn

import pytest
import serial

from starhil.protocol.errors import ProtocolError
from starhil.protocol.transports.base import TransportError
from starhil.protocol.transports.connections import ACCEPTING_S
from starhil.protocol.transports.paced import BACKLOG_LIMIT, LONG_TURN_S, PacedTransport
from starhil.protocol.transports.serial import _ListenTransport, open_serial
from tests.conformance.simulated import SimulatedLoop
from tests.protocol.transports.pairs import SERIAL_KINDS, serial_pair
from tests.waiting import PATIENCE_S, until

pytestmark = [pytest.mark.long, pytest.mark.lowest("pyserial")]


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
def test_a_paced_message_arrives_whole_with_its_last_byte(kind: str, tmp_path: Path) -> None:
    """As on a UART, there are no gaps within a message, however busy the machine is."""

    async def main() -> None:
        async with serial_pair(kind, tmp_path, baud=9600) as pair:
            loop = asyncio.get_running_loop()
            arrived: list[tuple[float, bytes]] = []
            pair.two._on_receive = lambda data: arrived.append((loop.time(), data))  # type: ignore[assignment]
            begin = loop.time()
            pair.one.send(bytes(60))
            pair.one.send(bytes(30))
            await until(lambda: sum(len(data) for _, data in arrived) == 90)
            assert [len(data) for _, data in arrived] == [60, 30]
            assert arrived[0][0] - begin >= 60 * 10 / 9600 - 1e-6
            assert arrived[1][0] - begin >= 90 * 10 / 9600 - 1e-6

    asyncio.run(main())


class Line(PacedTransport):
    """A line that notes when it is written to, and how much."""

    def __init__(self) -> None:
        super().__init__("line", 1000)
        self.written: list[tuple[float, int]] = []

    async def _open(self) -> None: ...

    async def close(self) -> None: ...

    def _has_peer(self) -> bool:
        return True

    def _write(self, data: bytes) -> int:
        self.written.append((asyncio.get_running_loop().time(), len(data)))
        return len(data)


def test_a_paced_message_is_written_at_the_moment_its_last_byte_ends() -> None:
    async def main() -> None:
        line = Line()
        for size in (60, 3):
            line.send(bytes(size))
        await line.drain()
        await asyncio.sleep(1.0)
        line.send(bytes(10))
        await line.drain()
        assert [size for _, size in line.written] == [60, 3, 10]
        assert [moment for moment, _ in line.written] == pytest.approx([0.60, 0.63, 1.73])

    loop = SimulatedLoop()
    loop.run_until_complete(main())
    loop.close()


@pytest.mark.parametrize("baud", [0, -1])
def test_a_bit_rate_must_be_positive(baud: int) -> None:
    with pytest.raises(TransportError, match="must be positive"):
        open_serial("auto", baud)


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
            assert pair.one._backlog <= BACKLOG_LIMIT  # type: ignore[attr-defined]
            pair.two.send(b"still alive")
            await until(lambda: bytes(pair.got_one) == b"still alive")

    asyncio.run(main())


def test_a_vanished_port_is_reported_once_and_reopened(tmp_path: Path) -> None:
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
            again.publish()
            await until(lambda: pair.two.statistics.reconnects == 1)
            pair.two.send(b"hello again")
            await until(lambda: bytes(got) == b"hello again")
            assert len(pair.errors) == 1
            await again.close()

    asyncio.run(main())


def test_a_lost_connection_is_restored() -> None:
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
        await until(lambda: one._stream is None)  # type: ignore[attr-defined]
        reader, third = await asyncio.open_connection(host, int(port))
        third.write(b"third")
        await until(lambda: bytes(got) == b"firstthird")
        one.send(b"reply")
        assert await asyncio.wait_for(reader.readexactly(5), PATIENCE_S) == b"reply"
        third.close()
        await one.close()

    asyncio.run(main())


def test_a_listening_port_accepts_connections_with_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    accepted: list[float] = []
    made = _ListenTransport.connection_made

    def noted(self: _ListenTransport, transport: asyncio.BaseTransport) -> None:
        accepted.append(asyncio.get_running_loop().time())
        made(self, transport)

    monkeypatch.setattr(_ListenTransport, "connection_made", noted)

    async def main() -> float:
        port = open_serial("listen://127.0.0.1:0")
        await port.start(lambda _: None)
        host, _, number = port.description.removeprefix("socket://").rpartition(":")
        begin = asyncio.get_running_loop().time()
        peers = [socket.create_connection((host, int(number))) for _ in range(10)]
        await until(lambda: len(accepted) == len(peers))
        for peer in peers:
            peer.close()
        await port.close()
        return begin

    begin = asyncio.run(main())
    # a loop that is held up makes two connections together, but never the last one before all pauses
    assert accepted[-1] - begin >= (len(accepted) - 1) * ACCEPTING_S


def test_pyserial_opens_our_pseudo_terminal_and_our_socket(tmp_path: Path) -> None:
    def echo(url: str) -> bytes:
        with serial.serial_for_url(url, 115200, timeout=PATIENCE_S) as port:
            port.write(b"\x1f\x7f\x80\x1f\xff")
            return bytes(port.read(5))

    async def main() -> None:
        for spec, link in (("pty", tmp_path / "star"), ("listen://127.0.0.1:0", None)):
            transport = open_serial(spec, symlink=link)
            await transport.start(transport.send)
            transport.publish()
            assert await asyncio.to_thread(echo, transport.description) == b"\x1f\x7f\x80\x1f\xff"
            await transport.close()

    asyncio.run(main())


def test_the_symlink_replaces_a_stale_one_once_published_and_is_removed_at_close(tmp_path: Path) -> None:
    async def main() -> None:
        link = tmp_path / "tty"
        link.symlink_to("/nowhere")
        transport = open_serial("auto", symlink=link)
        await transport.start(lambda _: None)
        assert transport.description == str(link)
        assert list(tmp_path.iterdir()) == []
        transport.publish()
        assert os.path.realpath(link).startswith("/dev/pts/")
        await transport.close()
        await transport.close()
        assert list(tmp_path.iterdir()) == []

    asyncio.run(main())


def test_a_symlink_that_cannot_be_replaced_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As one of another user in /tmp."""
    link = tmp_path / "tty"
    link.symlink_to("/nowhere")

    removed = type(link).unlink

    def not_permitted(path: Path, *, missing_ok: bool = False) -> None:
        if path == link:
            raise PermissionError(1, "Operation not permitted")
        removed(path, missing_ok=missing_ok)

    async def main() -> None:
        transport = open_serial("auto", symlink=link)
        with pytest.raises(TransportError, match=r"cannot make the symlink .*: Operation not permitted"):
            await transport.start(lambda _: None)
        await transport.close()

    monkeypatch.setattr(type(link), "unlink", not_permitted)
    asyncio.run(main())
    assert list(tmp_path.iterdir()) == [link]


def test_a_symlink_taken_over_by_another_is_left_alone(tmp_path: Path) -> None:
    async def main() -> None:
        link = tmp_path / "tty"
        one, two = open_serial("pty", symlink=link), open_serial("pty", symlink=link)
        for transport in (one, two):
            await transport.start(lambda _: None)
            transport.publish()
        await one.close()
        assert link.is_symlink()
        await two.close()

    asyncio.run(main())


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("/dev/does-not-exist", "no such port"),
        ("/etc/passwd", "is not a tty"),
        ("/dev/null", "cannot open"),
        ("socket://127.0.0.1:1", "cannot connect"),
        ("socket://127.0.0.1", "must be socket://HOST:PORT"),
        ("listen://127.0.0.1:x", "must be listen://HOST:PORT"),
        ("rfc2217://host:1", "must be auto, a tty's path"),
        ("socket://[::1", "must be socket://HOST:PORT"),
    ],
)
def test_unavailable_ports_are_reported_in_one_line(spec: str, message: str) -> None:
    async def main() -> None:
        with pytest.raises(TransportError, match=message) as caught:
            await open_serial(spec).start(lambda _: None)
        assert str(caught.value).startswith(f"serial {spec}")
        assert "\n" not in str(caught.value)

    asyncio.run(main())


def test_a_busy_port_is_reported() -> None:
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
        with pytest.raises(TransportError, match="is not a symlink"):
            await transport.start(lambda _: None)
        await transport.close()
        assert link.read_text() == "data"

    asyncio.run(main())


def test_closing_twice_or_unopened_is_harmless(tmp_path: Path) -> None:
    async def main() -> None:
        for transport in (
            open_serial("pty", symlink=tmp_path / "t"),
            open_serial("listen://127.0.0.1:0"),
            open_serial("/dev/nope"),
        ):
            await transport.close()
            await transport.close()

    asyncio.run(main())


@pytest.mark.parametrize("kind", SERIAL_KINDS)
def test_a_new_bit_rate_takes_effect_after_all_earlier_bytes(kind: str, tmp_path: Path) -> None:
    async def main() -> None:
        async with serial_pair(kind, tmp_path, baud=19200) as pair:
            loop = asyncio.get_running_loop()
            begin = loop.time()
            pair.one.send(bytes(192))
            pair.one.set_baud(9600)
            await pair.one.drain()
            assert loop.time() - begin >= 0.1 - 1e-6
            begin = loop.time()
            pair.one.send(bytes(96))
            await pair.one.drain()
            assert loop.time() - begin >= 0.1 - 1e-6
            await until(lambda: len(pair.got_two) == 288)

    asyncio.run(main())


def test_a_tty_takes_another_bit_rate_and_keeps_it_when_it_comes_back(tmp_path: Path) -> None:
    async def main() -> None:
        async with serial_pair("pty and tty", tmp_path, baud=19200) as pair:
            pair.two.send(b"before")
            pair.two.set_baud(115200)
            await until(lambda: pair.two._port.baudrate == 115200)  # type: ignore[attr-defined]
            await until(lambda: bytes(pair.got_one) == b"before")
            pair.two._lost("pulled")  # type: ignore[attr-defined]
            await until(lambda: pair.two.statistics.reconnects == 1)
            assert pair.two._port.baudrate == 115200  # type: ignore[attr-defined]
            assert len(pair.errors) == 1

    asyncio.run(main())


def test_an_impossible_bit_rate_is_reported_and_the_old_one_kept(tmp_path: Path) -> None:
    async def main() -> None:
        async with serial_pair("pty and tty", tmp_path, baud=19200) as pair:
            pair.two.set_baud(-1)
            await until(lambda: bool(pair.errors))
            assert "bit rate -1 is not possible here; 19200 stays in use" in str(pair.errors[0])
            pair.two.send(b"alive")
            await until(lambda: bytes(pair.got_one) == b"alive")

    asyncio.run(main())


def no_terminal(*_args: object, **_options: object) -> NoReturn:
    raise termios.error(errno.EIO, "Input/output error")


def test_a_tty_whose_settings_are_rejected_is_reported_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    async def main() -> None:
        master, slave = os.openpty()
        monkeypatch.setattr(serial, "Serial", no_terminal)
        with pytest.raises(TransportError, match="cannot open: Input/output error"):
            await open_serial(os.ttyname(slave)).start(lambda _: None)
        monkeypatch.setattr(tty, "setraw", no_terminal)
        with pytest.raises(TransportError, match=r"serial pty: .*Input/output error"):
            await open_serial("pty").start(lambda _: None)
        os.close(slave)
        os.close(master)

    asyncio.run(main())


@pytest.mark.parametrize("error", [termios.error(errno.EIO, "Input/output error"), RuntimeError("odd")])
def test_a_port_is_reopened_after_any_error(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, error: Exception
) -> None:
    real, raised = serial.Serial, []

    def refuse_twice(*args: object, **options: object) -> serial.Serial:
        if len(raised) < 2:
            raised.append(error)
            raise error
        return real(*args, **options)

    async def main() -> None:
        async with serial_pair("pty and tty", tmp_path, baud=19200) as pair:
            monkeypatch.setattr(serial, "Serial", refuse_twice)
            pair.two._lost("pulled")  # type: ignore[attr-defined]
            await until(lambda: pair.two.statistics.reconnects == 1)
            assert len(raised) == 2
            assert len(pair.errors) == 1 + isinstance(error, RuntimeError)
            pair.two.send(b"alive")
            await until(lambda: bytes(pair.got_one) == b"alive")

    asyncio.run(main())


@pytest.mark.parametrize("name", ["out_waiting", "baudrate"])
def test_a_port_that_goes_while_its_bit_rate_changes_comes_back_at_the_new_one(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, name: str
) -> None:
    async def main() -> None:
        async with serial_pair("pty and tty", tmp_path, baud=19200) as pair:
            with monkeypatch.context() as patch:
                patch.setattr(type(pair.two._port), name, property(no_terminal, no_terminal))  # type: ignore[attr-defined]
                pair.two.set_baud(38400)
            await until(lambda: pair.two.statistics.reconnects == 1)
            assert pair.two._port.baudrate == 38400  # type: ignore[attr-defined]
            assert "lost: Input/output error" in str(pair.errors[0])

    asyncio.run(main())


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (PermissionError(errno.EACCES, "Permission denied"), "no permission; join the group that owns it"),
        (ValueError("Not a valid baudrate: 7"), "bit rate 7 is not possible here"),
        (OSError("no number"), "cannot open: no number"),
    ],
)
def test_the_remedy_of_a_port_that_does_not_open_depends_on_the_reason(
    monkeypatch: pytest.MonkeyPatch, error: Exception, message: str
) -> None:
    def fail(*_args: object, **_options: object) -> NoReturn:
        raise error

    monkeypatch.setattr(serial, "Serial", fail)
    with pytest.raises(TransportError, match=f"^serial /dev/ttyUSB7: {message}"):
        asyncio.run(open_serial("/dev/ttyUSB7", 7).start(lambda _: None))


def test_only_a_pseudo_terminal_has_a_symlink(tmp_path: Path) -> None:
    with pytest.raises(TransportError, match=r"serial /dev/ttyS0: a symlink needs a pseudo-terminal"):
        open_serial("/dev/ttyS0", symlink=tmp_path / "tty")


def test_a_rate_set_before_the_port_is_open_is_the_rate_at_which_it_opens(tmp_path: Path) -> None:
    async def main() -> None:
        one = open_serial("pty", symlink=tmp_path / "tty")
        await one.start(lambda _: None)
        one.publish()
        two = open_serial(str(tmp_path / "tty"), 9600)
        two.set_baud(19200)
        await two.drain()
        assert not two.send(b"nobody")
        await two.start(lambda _: None)
        assert two._port.baudrate == 19200  # type: ignore[attr-defined]
        assert two.statistics.dropped == 6
        await two.close()
        await one.close()

    asyncio.run(main())


def test_the_bit_rate_changes_only_once_the_kernel_has_sent_its_buffer(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    async def main() -> None:
        async with serial_pair("pty and tty", tmp_path, baud=19200) as pair:
            waiting, states = [3, 2, 0], []
            monkeypatch.setattr(
                type(pair.two._port),  # type: ignore[attr-defined]
                "out_waiting",
                property(lambda port: (states.append(port.baudrate), waiting.pop(0))[1]),
            )
            pair.two.set_baud(38400)
            await until(lambda: not waiting)
            assert (states, pair.two._port.baudrate) == ([19200] * 3, 38400)  # type: ignore[attr-defined]

    asyncio.run(main())


def test_without_pacing_a_message_is_written_at_once_at_any_bit_rate() -> None:
    async def main() -> None:
        one = open_serial("listen://127.0.0.1:0", 9600, paced=False)
        await one.start(lambda _: None)
        reader, writer = await asyncio.open_connection("127.0.0.1", int(one.description.rpartition(":")[2]))
        await until(lambda: one._stream is not None)  # type: ignore[attr-defined]
        one.set_baud(10)
        one.send(bytes(3000))  # 3000 s at 10 bit/s
        assert await asyncio.wait_for(reader.readexactly(3000), PATIENCE_S) == bytes(3000)
        writer.close()
        await one.close()

    asyncio.run(main())


def test_what_is_much_work_is_read_in_smaller_parts() -> None:
    """A flood of lines of one byte held up the loop by 100 ms in each turn."""

    async def main() -> None:
        master, slave = os.openpty()
        tty.setraw(slave)
        sizes: list[int] = []
        much = [True]

        def work(data: bytes) -> None:
            sizes.append(len(data))
            if much:
                time.sleep(len(data) * LONG_TURN_S / 50)

        transport = open_serial(os.ttyname(slave), 921_600)
        await transport.start(work)
        os.write(master, bytes(2000))
        await until(lambda: sum(sizes) >= 2000)
        assert sizes[0] > 100 >= max(sizes[4:])
        sizes.clear()
        much.clear()
        os.write(master, bytes(2000))
        await until(lambda: sum(sizes) >= 2000)
        assert max(sizes) > 100
        await transport.close()
        os.close(master)
        os.close(slave)

    asyncio.run(main())
