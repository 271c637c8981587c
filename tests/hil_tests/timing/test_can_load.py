"""The load measurement detects a device that loses, corrupts or delays replies."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable

import pytest

from starhil.hil_tests.errors import BenchError
from starhil.hil_tests.timing.can_load import DEVICE, HOST, load_can
from starhil.hil_tests.timing.figures import CanLoad, SerialLoad, Spread
from starhil.hil_tests.timing.jitter import unsolicited_jitter
from starhil.hil_tests.timing.serial_load import load_serial
from starhil.protocol.can.cubespace import CanDeviceReceiver, encode_reply_frames
from starhil.protocol.can.frame import CanFrame
from starhil.protocol.messages import ErrorCode, Reply, ReplyKind, Request, RequestKind
from starhil.protocol.serial.cubespace import Dialect
from starhil.protocol.transports.can import CanTransport, open_can
from starhil.protocol.transports.hub import CanHub
from starhil.protocol.transports.paced import SerialTransport
from starhil.protocol.transports.serial import open_serial
from starhil.protocol.unit import load_unit
from tests.protocol.serial.composed_links import CUBESPACE

pytestmark = pytest.mark.long

ICD = load_unit()
RATE = 300.0
SECONDS = 0.6
BAUD = 460_800

Answer = Callable[[Request, int], list[Reply]]


def good(request: Request, _: int) -> list[Reply]:
    """Answer as a device does."""
    if request.kind is RequestKind.TELECOMMAND:
        return [Reply(ReplyKind.ACK, request.id, destination=HOST)]
    row = ICD.row(request.id)
    return [Reply(ReplyKind.TELEMETRY, request.id, row.encode(), destination=HOST)]


def every_tenth(fault: Answer) -> Answer:
    """Answer rightly but for every tenth request."""
    return lambda request, number: fault(request, number) if number % 10 == 9 else good(request, number)


def silent(_request: Request, _number: int) -> list[Reply]:
    return []


def refusing(request: Request, _number: int) -> list[Reply]:
    return [Reply(ReplyKind.NACK, request.id, code=ErrorCode.BUSY, destination=HOST)]


def outside_limits(request: Request, _number: int) -> list[Reply]:
    size = ICD.row(request.id).size if request.kind is RequestKind.TELEMETRY else 0
    return [Reply(ReplyKind.TELEMETRY, request.id, b"\xfe" * size, destination=HOST)]


def too_short(request: Request, _number: int) -> list[Reply]:
    return [Reply(ReplyKind.TELEMETRY, request.id, b"\x01\x02\x03", destination=HOST)]


@contextlib.asynccontextmanager
async def can_device(answer: Answer) -> AsyncIterator[str]:
    """A device on a hub, both in this process."""
    hub = CanHub(port=0)
    await hub.start()
    spec = f"socketcand:127.0.0.1:{hub.port}/vcan0"
    transport: CanTransport = open_can(spec)
    receiver = CanDeviceReceiver(DEVICE)
    number = 0

    def take(frame: CanFrame) -> None:
        nonlocal number
        for event in receiver.feed(frame, 0.0):
            if isinstance(event, Request):
                for reply in answer(event, number):
                    for one in encode_reply_frames(reply, DEVICE):
                        transport.send(one)
                number += 1

    await transport.start(take)
    try:
        yield spec
    finally:
        await transport.close()
        await hub.close()


def measure_can(answer: Answer) -> CanLoad:
    async def main() -> CanLoad:
        async with can_device(answer) as spec:
            return await load_can(ICD, spec, SECONDS, RATE)

    return asyncio.run(main())


@pytest.mark.process
def test_a_good_device_on_can_is_found_good() -> None:
    load = measure_can(good)
    assert load.good
    assert load.sent > 0
    assert load.requests > 0
    assert 0 < load.latency.p50_ms <= load.latency.p99_ms <= load.latency.max_ms
    assert load.machine.p50_ms > 0


@pytest.mark.process
@pytest.mark.parametrize("fault", [refusing, outside_limits, too_short])
def test_wrong_replies_on_can_are_found(fault: Answer) -> None:
    load = measure_can(every_tenth(fault))
    assert not load.good
    assert load.wrong > 0
    assert (load.lost, load.unanswered) == (0, 0)


@pytest.mark.process
def test_a_silent_device_on_can_is_found() -> None:
    load = measure_can(silent)
    assert not load.good
    assert load.unanswered == load.requests > 0


def measure_serial(answer: Answer, dialect: Dialect) -> SerialLoad:
    async def main() -> SerialLoad:
        transport: SerialTransport = open_serial("pty", BAUD)
        receiver = CUBESPACE.device()
        number = 0

        def take(data: bytes) -> None:
            nonlocal number
            for event in receiver.feed(data, 0.0):
                if isinstance(event, Request):
                    for reply in answer(event, number):
                        transport.send(CUBESPACE.encode_reply(reply, dialect))
                    number += 1

        await transport.start(take)
        load = await load_serial(ICD, transport.description, SECONDS, BAUD, dialect)
        await transport.close()
        return load

    return asyncio.run(main())


@pytest.mark.parametrize("dialect", Dialect)
def test_a_good_device_on_serial_is_found_good(dialect: Dialect) -> None:
    load = measure_serial(good, dialect)
    assert load.good
    assert load.exchanges > 20
    assert 0 < load.sent_share <= 1.0
    assert 0 < load.received_share <= 1.0


@pytest.mark.parametrize("fault", [refusing, silent])
def test_a_bad_device_on_serial_is_found(fault: Answer) -> None:
    load = measure_serial(every_tenth(fault), Dialect.B)
    assert not load.good


def test_a_device_without_unsolicited_telemetry_is_reported() -> None:
    async def main() -> None:
        async with can_device(good) as spec:
            with pytest.raises(BenchError, match="only 0 messages were received"):
                await unsolicited_jitter(ICD, spec, 0.1, 20.0, device=DEVICE)
        async with can_device(silent) as spec:
            with pytest.raises(BenchError, match="does not answer"):
                await unsolicited_jitter(ICD, spec, 0.1, 20.0, device=DEVICE)
        async with can_device(refusing) as spec:
            with pytest.raises(BenchError, match="refuses set_unsolicited with code 6"):
                await unsolicited_jitter(ICD, spec, 0.1, 20.0, device=DEVICE)

    asyncio.run(main())


def test_spreads_are_nearest_ranks_of_the_values() -> None:
    spread = Spread.of([value / 1000 for value in range(100, 0, -1)])
    assert (spread.p50_ms, spread.p99_ms, spread.max_ms) == (50.0, 99.0, 100.0)
    assert Spread.of([]).max_ms != Spread.of([]).max_ms
