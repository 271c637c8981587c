"""The TCP hub: its text protocol as raw bytes, python-can as an independent client, and what it does to bad clients."""

from __future__ import annotations

import asyncio
import random
from collections.abc import Awaitable, Callable
from pathlib import Path

import can
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from starhil.protocol.can.frame import CanFrame
from starhil.protocol.can.socketcand import (
    CommandError,
    CommandSplitter,
    format_frame,
    format_send,
    parse_frame,
    parse_send,
)
from starhil.protocol.errors import ProtocolError
from starhil.protocol.transports.hub import BACKLOG_LIMIT, CanHub
from tests.candump import read_candump
from tests.waiting import PATIENCE_S

pytestmark = pytest.mark.long


class Peer:
    """A client that speaks the text protocol by hand."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader, self.writer = reader, writer

    @classmethod
    async def join(cls, hub: CanHub, bus: str | None = "vcan0") -> Peer:
        peer = cls(*await asyncio.open_connection("127.0.0.1", hub.port))
        assert await peer.read() == "< hi >"
        if bus is not None:
            for command in (f"< open {bus} >", "< remote >", "< rawmode >"):
                peer.write(command)
                assert await peer.read() == "< ok >"
        return peer

    def write(self, text: str | bytes) -> None:
        self.writer.write(text.encode() if isinstance(text, str) else text)

    async def read(self) -> str:
        async with asyncio.timeout(PATIENCE_S):
            return (await self.reader.readuntil(b">")).decode()

    async def frame(self) -> CanFrame:
        return parse_frame((await self.read()).strip("<> ").encode())

    async def silent(self) -> bool:
        """Whether nothing has come when all sent before has been worked off."""
        self.write("< echo >")
        return await self.read() == "< echo >"


def run(scenario: Callable[[CanHub], Awaitable[None]], **options: object) -> None:
    async def main() -> None:
        hub = CanHub(port=0, **options)  # type: ignore[arg-type]
        await hub.start()
        try:
            await scenario(hub)
        finally:
            await hub.close()

    asyncio.run(main())


# -- the text protocol -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("command", "expected"),
    [
        ("< send 123 3 1 2 1f >", "< frame 123 1700000000.250000 01021F >"),
        ("< send 123 0 >", "< frame 123 1700000000.250000  >"),
        ("< send 123 0  >", "< frame 123 1700000000.250000  >"),
        (
            "<send 08AA0401 8 00 01 02 03 04 05 06 07>",
            "< frame 08AA0401 1700000000.250000 0001020304050607 >",
        ),
        ("< send 00000123 1 FF >", "< frame 00000123 1700000000.250000 FF >"),
        ("< send 7 1 A >", "< frame 007 1700000000.250000 0A >"),
        ("< send C0000701 0 >", "< frame C0000701 1700000000.250000  >"),
        ("< send 40000701 0 >", "< frame 40000701 1700000000.250000  >"),
    ],
)
def test_a_frame_goes_to_every_other_client_as_socketcand_writes_it(command: str, expected: str) -> None:
    async def scenario(hub: CanHub) -> None:
        one, two, three = [await Peer.join(hub) for _ in range(3)]
        one.write(command)
        assert await two.read() == expected
        assert await three.read() == expected
        assert await one.silent()

    run(scenario, now=lambda: 1_700_000_000.25)


def test_buses_are_independent() -> None:
    async def scenario(hub: CanHub) -> None:
        one, two, other = await Peer.join(hub), await Peer.join(hub), await Peer.join(hub, "vcan1")
        one.write("< send 123 1 1 >")
        assert (await two.frame()).id == 0x123
        assert await other.silent()

    run(scenario)


def test_remote_frames_go_only_to_clients_that_asked() -> None:
    async def scenario(hub: CanHub) -> None:
        one, two = await Peer.join(hub), await Peer.join(hub)
        plain = await Peer.join(hub, None)
        plain.write("< open vcan0 >< rawmode >")
        assert [await plain.read(), await plain.read()] == ["< ok >", "< ok >"]
        one.write(format_send(CanFrame(0x701, extended=False, remote=True)))
        received = await two.frame()
        assert (received.id, received.extended, received.remote) == (0x701, False, True)
        one.write("< send 123 1 1 >")
        assert (await plain.frame()).id == 0x123

    run(scenario)


MALFORMED = [
    "< nonsense >", "< >", "<>", "text >", "< send >", "< send 123 >", "< send 123 2 1 >", "< send 123 9 1 1 1 1 1 1 1 1 1 >",
    "< send 12345 1 1 >", "< send FFF 1 1 >", "< send 123 1 123 >", "< send xyz 1 1 >", "< send 123 1 0x >", "< send +12 1 1 >",
    "< send C0000701 1 1 >", "< open vcan9 >", "< controlmode >", "< send 123 1 \xff >", "< " + "a" * 500 + " >", "< send 1_2 1 1 >",
]  # fmt: skip


@pytest.mark.parametrize("text", MALFORMED)
def test_malformed_commands_are_answered_by_an_error_and_change_nothing(text: str) -> None:
    async def scenario(hub: CanHub) -> None:
        one, two = await Peer.join(hub), await Peer.join(hub)
        one.write(text)
        assert (await one.read()).startswith("< error ")
        one.write("< send 123 1 1 >")
        assert (await two.frame()).id == 0x123
        assert hub.statistics.errors >= 1

    run(scenario)


@pytest.mark.parametrize("text", [">", "<>", "<a>", "< send >", "<x", "x"])
def test_answers_to_a_flood_of_malformed_commands_are_no_multiple_of_it(text: str) -> None:
    async def scenario(hub: CanHub) -> None:
        one, two = await Peer.join(hub), await Peer.join(hub)
        flood = text * (64_000 // len(text))
        one.write(flood)
        one.write("> < echo >")
        answer = ""
        while "< echo >" not in answer:
            answer += await one.read()
        assert answer.startswith("< error ")
        assert len(answer) < len(flood) / 20
        one.write("< send 123 1 1 >")
        assert (await two.frame()).id == 0x123

    run(scenario)


def test_nothing_can_be_sent_before_a_bus_is_open() -> None:
    async def scenario(hub: CanHub) -> None:
        peer = await Peer.join(hub, None)
        for command in ("< send 123 1 1 >", "< rawmode >", "< remote >"):
            peer.write(command)
            assert "no bus is open" in await peer.read()

    run(scenario)


def test_random_bytes_from_one_client_do_not_affect_the_others() -> None:
    async def scenario(hub: CanHub) -> None:
        noisy, one, two = await Peer.join(hub, None), await Peer.join(hub), await Peer.join(hub)
        source = random.Random(5)
        for number in range(200):
            noisy.write(source.randbytes(300))
            noisy.write(bytes(source.choice(b"<> send123 ") for _ in range(50)))
            one.write(f"< send {number:03X} 0 >")
            assert (await two.frame()).id == number
        noisy.writer.transport.abort()

    run(scenario)


def test_a_flood_arrives_whole_and_in_order() -> None:
    async def scenario(hub: CanHub) -> None:
        one, two = await Peer.join(hub), await Peer.join(hub)
        count = 20_000
        one.write(b"".join(format_send(CanFrame(number)) for number in range(count)))
        for number in range(count):
            assert (await two.frame()).id == number
        assert (hub.statistics.frames, hub.statistics.delivered, hub.statistics.dropped) == (count, count, 0)

    run(scenario)


def test_a_client_that_does_not_read_loses_frames_alone_and_memory_is_bounded() -> None:
    async def scenario(hub: CanHub) -> None:
        one, two, unresponsive = await Peer.join(hub), await Peer.join(hub), await Peer.join(hub)
        unresponsive.reader._transport.pause_reading()  # type: ignore[attr-defined]
        batch = format_send(CanFrame(0x1234567, bytes(8))) * 1000
        sent = 0
        while not hub.statistics.dropped and sent < 100 * BACKLOG_LIMIT:
            one.write(batch)
            sent += len(batch)
            for _ in range(1000):
                await two.reader.readuntil(b">")
        assert hub.statistics.dropped >= 1
        assert max(client.backlog for client in hub.clients) < BACKLOG_LIMIT + 2 * len(batch)

    run(scenario)


def test_the_log_is_a_candump_log(tmp_path: Path) -> None:
    log = tmp_path / "bus.log"

    async def scenario(hub: CanHub) -> None:
        one, two = await Peer.join(hub), await Peer.join(hub, "vcan1")
        one.write(format_send(CanFrame(0x08AA0401, b"\x01\x02")))
        assert await one.silent()
        two.write(format_send(CanFrame(0x123, extended=False)))
        assert await two.silent()

    run(scenario, log=log, now=lambda: 12.5)
    assert [(bus, frame, frame.timestamp) for bus, frame in read_candump(log)] == [
        ("vcan0", CanFrame(0x08AA0401, b"\x01\x02"), 12.5),
        ("vcan1", CanFrame(0x123, extended=False), 12.5),
    ]


def test_a_taken_port_and_an_impossible_log_are_reported(tmp_path: Path) -> None:
    async def scenario(hub: CanHub) -> None:
        with pytest.raises(ProtocolError, match=f"cannot listen at 127.0.0.1:{hub.port}"):
            await CanHub(port=hub.port).start()
        with pytest.raises(ProtocolError, match="cannot write"):
            await CanHub(port=0, log=tmp_path / "none" / "x.log").start()

    run(scenario)


# -- python-can as an independent client -------------------------------------------------------------------------------


def _python_can_exchange(port: int) -> None:
    buses = [
        can.Bus(interface="socketcand", host="127.0.0.1", port=port, channel="vcan0", tcp_tune=True)
        for _ in range(2)
    ]
    try:
        one, two = buses
        sent = [
            can.Message(arbitration_id=0x123, is_extended_id=False, data=[1, 2, 31]),
            can.Message(arbitration_id=0x1FFFFFFF, is_extended_id=True, data=bytes(8)),
            can.Message(arbitration_id=0, is_extended_id=False, data=b""),
        ]
        for message in sent:
            one.send(message)
        for message in sent:
            received = two.recv(PATIENCE_S)
            assert received is not None
            assert received.equals(message, timestamp_delta=None, check_channel=False, check_direction=False)
        two.send(sent[0])
        assert one.recv(PATIENCE_S) is not None
    finally:
        for bus in buses:
            bus.shutdown()


def test_python_can_talks_over_the_hub() -> None:
    async def scenario(hub: CanHub) -> None:
        await asyncio.to_thread(_python_can_exchange, hub.port)

    run(scenario)


def _join_busy_bus(port: int) -> None:
    bus = can.Bus(interface="socketcand", host="127.0.0.1", port=port, channel="vcan0")
    assert bus.recv(PATIENCE_S) is not None
    bus.shutdown()


def test_python_can_can_join_a_busy_bus() -> None:
    async def scenario(hub: CanHub) -> None:
        one = await Peer.join(hub)

        async def babble() -> None:
            while True:
                one.write("< send 123 1 1 >")
                await asyncio.sleep(0.0005)

        task = asyncio.create_task(babble())
        await asyncio.gather(*(asyncio.to_thread(_join_busy_bus, hub.port) for _ in range(5)))
        task.cancel()

    run(scenario)


# -- the codec -----------------------------------------------------------------------------------------------

frames = st.one_of(
    st.builds(CanFrame, st.integers(0, 0x7FF), st.binary(max_size=8), st.just(False)),  # noqa: FBT003
    st.builds(CanFrame, st.integers(0, 0x1FFFFFFF), st.binary(max_size=8)),
    st.builds(CanFrame, st.integers(0, 0x7FF), extended=st.booleans(), remote=st.just(True)),  # noqa: FBT003
)


@settings(max_examples=100, deadline=None, derandomize=True)
@given(frames)
def test_frames_survive_both_directions(frame: CanFrame) -> None:
    assert parse_send(format_send(frame).strip(b"<> ")) == frame
    parsed = parse_frame(format_frame(frame, b"1.250000").strip(b"<> "))
    assert (parsed.id, parsed.data, parsed.extended, parsed.remote, parsed.timestamp) == (
        frame.id, frame.data, frame.extended, frame.remote, 1.25,
    )  # fmt: skip


@settings(max_examples=100, deadline=None, derandomize=True)
@given(st.binary(max_size=200), st.integers(1, 40))
def test_commands_do_not_depend_on_how_the_stream_is_cut(noise: bytes, size: int) -> None:
    splitter = CommandSplitter()
    pieces = [
        command
        for start in range(0, len(noise), size)
        for command in splitter.feed(noise[start : start + size])
    ]
    assert pieces == CommandSplitter().feed(noise)


@settings(max_examples=150, deadline=None, derandomize=True)
@given(
    st.one_of(st.binary(max_size=80), st.text("send frame0123456789ABCDEF<>x.", max_size=60).map(str.encode))
)
def test_any_text_is_a_frame_or_a_command_error(text: bytes) -> None:
    for parse in (lambda: parse_send(b"send " + text), lambda: parse_frame(b"frame " + text)):
        try:
            parse()
        except CommandError as error:
            assert str(error)  # noqa: PT017
        except ProtocolError as error:
            assert "CAN" in str(error)  # noqa: PT017


# -- a log that cannot be written, an invalid host ------------------------------------------------------------------------


def test_a_full_disk_ends_the_log_and_nothing_else(caplog: pytest.LogCaptureFixture) -> None:
    async def scenario(hub: CanHub) -> None:
        one, two = await Peer.join(hub), await Peer.join(hub)
        for number in range(3):
            one.write(format_send(CanFrame(number, bytes(8))))
            assert (await two.frame()).id == number
        assert len(hub.clients) == 2

    run(scenario, log=Path("/dev/full"))
    assert [record.getMessage() for record in caplog.records] == [
        "CAN hub: log /dev/full ends here: No space left on device; the bus continues"
    ]


@pytest.mark.parametrize("host", ["a..b", "x" * 64])
def test_an_invalid_host_name_is_reported(host: str) -> None:
    with pytest.raises(ProtocolError, match=rf"cannot listen at {host}:0: .*; choose another --host"):
        asyncio.run(CanHub(host, 0).start())
