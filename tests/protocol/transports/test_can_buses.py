"""CAN buses: one behaviour suite over every kind, and their failures."""

from __future__ import annotations

import asyncio
import os
import subprocess
import time

import can
import pytest

from starhil.protocol.can_framing import CanFrame
from starhil.protocol.errors import ProtocolError
from starhil.protocol.transports import TransportError, open_can
from starhil.protocol.transports.python_can import PythonCanTransport
from tests.protocol.transports.pairs import CAN_KINDS, FRAMES, HAS_VCAN, can_pair, until


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


def test_identical_frames_of_two_nodes_are_not_echoes() -> None:
    async def main() -> None:
        async with can_pair("udp_multicast") as pair:
            for _ in range(20):
                pair.one.send(FRAMES[0])
                pair.two.send(FRAMES[0])
            await until(lambda: len(pair.got_one) >= 20 and len(pair.got_two) >= 20)
            await asyncio.sleep(0.05)
            assert pair.got_one == pair.got_two == [FRAMES[0]] * 20

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
