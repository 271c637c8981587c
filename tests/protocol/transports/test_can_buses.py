"""CAN buses: one behaviour suite over every kind, and their failures."""

from __future__ import annotations

import asyncio
import os
import socket
import subprocess
import sys
import threading
import time
from itertools import pairwise

import can
import pytest
from can.interfaces.udp_multicast.utils import pack_message

from starhil.protocol.can.frame import CanFrame
from starhil.protocol.errors import ProtocolError
from starhil.protocol.transports.base import TURN_S, TransportError
from starhil.protocol.transports.can import open_can
from starhil.protocol.transports.python_can import QUEUE_LIMIT, PythonCanTransport
from tests.protocol.transports.pairs import CAN_KINDS, FRAMES, HAS_VCAN, CanPair, can_pair
from tests.waiting import PATIENCE_S, until

pytestmark = [pytest.mark.long, pytest.mark.lowest("python-can")]

MARK = CanFrame(0x7A5, b"end", extended=False)


async def exchange_marks(pair: CanPair) -> None:
    """Send a last frame both ways; an echo of what was sent before would arrive sooner."""
    for transport in (pair.one, pair.two):
        assert transport.send(MARK)
    await until(lambda: MARK in pair.got_one and MARK in pair.got_two)


@pytest.mark.parametrize("kind", CAN_KINDS)
def test_frames_pass_both_ways_intact_in_order_and_without_echo(kind: str) -> None:
    async def main() -> None:
        async with can_pair(kind) as pair:
            for frame in FRAMES:
                assert pair.one.send(frame)
            await pair.one.drain()
            await until(lambda: len(pair.got_two) >= len(FRAMES))
            for frame in FRAMES[::-1]:
                assert pair.two.send(frame)
            await until(lambda: len(pair.got_one) >= len(FRAMES))
            await exchange_marks(pair)
            assert pair.got_two == [*FRAMES, MARK]
            assert pair.got_one == [*FRAMES[::-1], MARK]
            assert not pair.errors
            assert pair.one.statistics.sent == pair.one.statistics.received == len(FRAMES) + 1

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


@pytest.mark.parametrize("kind", ["hub", "slcan", CAN_KINDS[-1]])
def test_a_burst_leaves_the_loop_to_others_after_some_15_frames(kind: str) -> None:
    async def main() -> None:
        async with can_pair(kind) as pair:
            counts = [0]
            for number in range(300):
                pair.one.send(CanFrame(number, bytes(8), extended=False))
            async with asyncio.timeout(PATIENCE_S):
                while counts[-1] < 300:
                    await asyncio.sleep(0)
                    counts.append(len(pair.got_two))
            assert max(after - before for before, after in pairwise(counts)) <= 16

    asyncio.run(main())


@pytest.mark.parametrize("kind", ["hub", "slcan", CAN_KINDS[-1]])
def test_frames_that_are_much_work_leave_the_loop_to_others_one_by_one(kind: str) -> None:
    async def main() -> None:
        async with can_pair(kind) as pair:
            pair.two.listener = lambda _frame: time.sleep(1.5 * TURN_S)
            counts = [0]
            for number in range(60):
                pair.one.send(CanFrame(number, bytes(8), extended=False))
            async with asyncio.timeout(PATIENCE_S):
                while counts[-1] < 60:
                    await asyncio.sleep(0)
                    counts.append(len(pair.got_two))
            assert max(after - before for before, after in pairwise(counts)) == 1
            assert [frame.id for frame in pair.got_two] == list(range(60))

    asyncio.run(main())


def test_identical_frames_of_two_nodes_are_not_echoes() -> None:
    async def main() -> None:
        async with can_pair("udp_multicast") as pair:
            for _ in range(20):
                pair.one.send(FRAMES[0])
                pair.two.send(FRAMES[0])
            await until(lambda: len(pair.got_one) >= 20 and len(pair.got_two) >= 20)
            await exchange_marks(pair)
            assert pair.got_one == pair.got_two == [FRAMES[0]] * 20 + [MARK]

    asyncio.run(main())


def _set_link(state: str) -> None:
    result = subprocess.run(
        ["ip", "link", "set", "vcan0", state], capture_output=True, text=True, check=False
    )
    if result.returncode and os.geteuid() != 0:
        pytest.skip(f"vcan0 cannot be set {state} here: {result.stderr.strip()}")
    assert result.returncode == 0, result.stderr


@pytest.mark.socketcan
@pytest.mark.skipif(not HAS_VCAN, reason="no vcan0 here")
def test_an_interface_that_goes_down_is_reported_and_reopened() -> None:
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


def test_bus_off_is_reported_and_is_not_a_frame() -> None:
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


class _ScriptedBus(can.BusABC):
    """A bus that delivers prepared messages and fails as it is set to."""

    def __init__(self, *messages: can.Message) -> None:
        super().__init__(channel="scripted")
        self.messages = list(messages)
        self.sent: list[can.Message] = []
        self.full = 0
        """Number of sends for which the transmit buffer is full."""
        self.fails = ""
        self.closed = False

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if self.fails:
            raise can.CanOperationError(self.fails)
        if self.messages:
            return self.messages.pop(0), True
        time.sleep(min(timeout or 0.0, 0.01))
        return None, True

    def send(self, msg: can.Message, timeout: float | None = None) -> None:  # noqa: ARG002
        if self.full:
            self.full -= 1
            raise can.CanTimeoutError
        self.sent.append(msg)

    def shutdown(self) -> None:
        self.closed = True
        super().shutdown()


async def _open(bus: _ScriptedBus) -> tuple[PythonCanTransport, list[CanFrame], list[ProtocolError]]:
    """Open a transport on a bus; return it with the frames and errors that it reports."""
    transport = PythonCanTransport("scripted:0", lambda: bus)
    got: list[CanFrame] = []
    errors: list[ProtocolError] = []
    await transport.start(got.append, errors.append)
    return transport, got, errors


def test_only_classic_frames_are_received() -> None:
    async def main() -> None:
        bus = _ScriptedBus(
            can.Message(arbitration_id=1, is_fd=True, data=bytes(12)),
            can.Message(arbitration_id=0x20, is_error_frame=True, data=bytes(8)),  # no acknowledgement
            can.Message(arbitration_id=2, is_extended_id=False, data=b"\x07"),
        )
        transport, got, errors = await _open(bus)
        await until(lambda: bool(got))
        await transport.close()
        assert [(frame.id, frame.data) for frame in got] == [(2, b"\x07")]
        assert (errors, transport.statistics.received) == ([], 1)

    asyncio.run(main())


def test_a_controller_that_is_bus_off_again_and_again_is_reported_once() -> None:
    """The kernel restarts it every few milliseconds, and each time was a line of the log."""

    async def main() -> None:
        bus_off = can.Message(arbitration_id=0x40, is_error_frame=True, data=bytes(8))
        restarted = can.Message(arbitration_id=0x100, is_error_frame=True, data=bytes(8))
        frame = can.Message(arbitration_id=2, is_extended_id=False)
        bus = _ScriptedBus(*[bus_off, restarted, frame] * 200)
        transport, got, errors = await _open(bus)
        await until(lambda: len(got) == 200)
        await transport.close()
        assert ["bus-off" in str(error) for error in errors] == [True]

    asyncio.run(main())


def test_frames_wait_while_the_transmit_buffer_is_full_and_none_beyond_the_limit() -> None:
    async def main() -> None:
        bus = _ScriptedBus()
        transport, _, errors = await _open(bus)
        bus.full = 2
        taken = [transport.send(FRAMES[0]) for _ in range(QUEUE_LIMIT + 3)]
        assert (sum(taken), transport.statistics.dropped) == (QUEUE_LIMIT, 3)
        await transport.drain()
        assert (len(bus.sent), bus.full, errors) == (QUEUE_LIMIT, 0, [])
        await transport.close()
        assert not transport.send(FRAMES[0])

    asyncio.run(main())


def test_frames_that_a_stalled_bus_has_not_taken_are_not_sent_when_it_comes_back() -> None:
    """A node that was switched on after minutes received up to 10 000 old attitudes and heartbeats at once."""

    async def main() -> None:
        bus = _ScriptedBus()
        transport, _, errors = await _open(bus)
        bus.full = sys.maxsize  # nobody acknowledges
        for _ in range(50):
            transport.send(FRAMES[0])
        await transport.drain()
        transport.send(FRAMES[0])
        await transport.drain()
        assert (len(bus.sent), transport.statistics.dropped, errors) == (0, 51, [])
        bus.full = 0
        transport.send(FRAMES[1])
        bus.full = 3  # and is waited for again
        await transport.drain()
        assert [message.arbitration_id for message in bus.sent] == [FRAMES[1].id]
        await transport.close()

    asyncio.run(main())


def test_a_bus_that_fails_while_it_is_read_is_reported_once_and_opened_again() -> None:
    async def main() -> None:
        bus = _ScriptedBus()
        transport, got, errors = await _open(bus)
        bus.fails = "interface gone"
        await until(lambda: bus.closed)
        bus.fails = ""
        await until(lambda: transport.statistics.reconnects == 1)
        bus.messages.append(can.Message(arbitration_id=5))
        await until(lambda: [frame.id for frame in got] == [5])
        assert [str(error) for error in errors] == [
            "CAN scripted:0: lost: interface gone; waiting for it to come back"
        ]
        await transport.close()

    asyncio.run(main())


def test_datagrams_that_are_no_frames_do_not_interrupt_a_bus_of_udp() -> None:
    group = "239.74.163.77"

    async def main() -> None:
        one, two = open_can(f"udp_multicast:{group}"), open_can(f"udp_multicast:{group}")
        got: list[CanFrame] = []
        errors: list[ProtocolError] = []
        await one.start(got.append, errors.append)
        await two.start(lambda _frame: None, errors.append)
        datagram = pack_message(can.Message(arbitration_id=5))
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
            stranger.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
            for number in range(200):
                junk = (b"", b"\xff" * 9, b"\x91" * 5000, datagram[:-3], datagram + b"\0")[number % 5]
                stranger.sendto(junk, (group, 43113))
                assert two.send(CanFrame(number))
                await asyncio.sleep(0.001)
        await until(lambda: len(got) == 200)
        assert [frame.id for frame in got] == list(range(200))
        assert (errors, one.statistics.reconnects, one.statistics.dropped) == ([], 0, 200)
        await one.close()
        await two.close()

    asyncio.run(main())


def test_a_frame_that_no_node_can_send_is_dropped() -> None:
    async def main() -> None:
        bus = _ScriptedBus(
            can.Message(arbitration_id=0x12345, is_extended_id=False), can.Message(arbitration_id=5)
        )
        transport, got, errors = await _open(bus)
        await until(lambda: bool(got))
        await transport.close()
        assert ([frame.id for frame in got], errors, transport.statistics.dropped) == ([5], [], 1)

    asyncio.run(main())


def test_frames_that_wait_when_a_bus_is_closed_are_counted_as_dropped() -> None:
    async def main() -> None:
        bus = _ScriptedBus()
        transport, _, _ = await _open(bus)
        bus.full = 1_000_000
        transport.send(FRAMES[0])
        await until(lambda: bus.full < 1_000_000)
        await transport.close()
        assert (transport.statistics.sent, transport.statistics.dropped) == (0, 1)
        await transport.drain()

    asyncio.run(main())


def test_a_bus_whose_opening_is_cancelled_is_closed() -> None:
    async def main() -> None:
        bus, begun, may_open = _ScriptedBus(), threading.Event(), threading.Event()

        def open_late() -> can.BusABC:
            begun.set()
            may_open.wait()
            return bus

        opening = asyncio.ensure_future(PythonCanTransport("late:0", open_late).start(lambda _: None))
        await until(begun.is_set)
        opening.cancel()
        may_open.set()
        with pytest.raises(asyncio.CancelledError):
            await opening
        await until(lambda: bus.closed)

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
def test_unavailable_buses_are_reported_in_one_line(spec: str, message: str) -> None:
    async def main() -> None:
        with pytest.raises(TransportError, match=message) as caught:
            await open_can(spec).start(lambda _: None)
        assert "\n" not in str(caught.value)

    asyncio.run(main())


def test_closing_twice_or_unopened_is_harmless() -> None:
    async def main() -> None:
        for bus in (open_can("virtual:x"), open_can("auto"), open_can("socketcand:127.0.0.1:1/vcan0")):
            await bus.close()
            await bus.close()

    asyncio.run(main())
