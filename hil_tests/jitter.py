"""How regularly periodic messages come over CAN, measured from the OBC's side: unsolicited telemetry, heartbeat, TPDOs, SYNC."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from statistics import fmean
from typing import Final

from hil_tests.errors import BenchError
from hil_tests.load_figures import Jitter, Spread
from protocol.can_framing import CanFrame, CanHostReceiver, encode_request_frames
from protocol.icd import load_icd
from protocol.messages import Reply, ReplyKind, Request
from protocol.transports import CanTransport, open_can

HOST: Final = 1
WARM_UP: Final = 3
"""Messages left out at the start."""
ANSWER_S: Final = 2.0

SYNC: Final = 0x080
NMT: Final = 0x000
HEARTBEAT: Final = 0x700
SDO_REQUEST: Final = 0x600
SDO_REPLY: Final = 0x580
PRODUCER_HEARTBEAT: Final = 0x1017


class _Arrivals:
    """Times at which frames of interest came."""

    def __init__(self, wanted: Callable[[CanFrame], bool]) -> None:
        self._wanted = wanted
        self.times: list[float] = []

    def take(self, frame: CanFrame) -> None:
        if self._wanted(frame):
            self.times.append(time.perf_counter())

    def jitter(self, what: str) -> Jitter:
        """Sum up the intervals. Raises BenchError if there are too few."""
        times = self.times[WARM_UP:]
        if len(times) < 3:
            raise BenchError(f"jitter of {what}: only {len(self.times)} messages came; is it switched on?")
        intervals = [later - earlier for earlier, later in zip(times, times[1:], strict=False)]
        mean = fmean(intervals)
        deviations = [abs(interval - mean) for interval in intervals]
        return Jitter(what, round(1e3 * mean, 3), len(times), Spread.of(deviations))


async def unsolicited_jitter(spec: str, seconds: float, rate_hz: float, *, device: int) -> Jitter:
    """Have a device send its clock unasked at a rate, and measure the intervals."""
    icd = load_icd()
    row = icd.telemetry["unix_time"]
    receiver = CanHostReceiver(HOST, device)
    answers: asyncio.Queue[Reply] = asyncio.Queue()
    arrivals = _Arrivals(lambda _frame: True)

    def take(frame: CanFrame) -> None:
        for event in receiver.feed(frame, time.monotonic()):
            if isinstance(event, Reply) and event.kind is ReplyKind.UNSOLICITED and event.id == row.id:
                arrivals.take(frame)
            elif isinstance(event, Reply):
                answers.put_nowait(event)

    transport = open_can(spec)
    await transport.start(take)
    command = icd.telecommands["set_unsolicited"]
    try:
        await _command(
            transport,
            answers,
            Request.of(command.id, command.encode({"telemetry": row.id, "rate": rate_hz})),
            device,
        )
        await asyncio.sleep(seconds)
        await _command(
            transport,
            answers,
            Request.of(command.id, command.encode({"telemetry": row.id, "rate": 0.0})),
            device,
        )
    finally:
        await transport.close()
    return arrivals.jitter(f"unsolicited telemetry at {rate_hz:g} Hz")


async def _command(
    transport: CanTransport, answers: asyncio.Queue[Reply], request: Request, device: int
) -> None:
    for frame in encode_request_frames(request, HOST, device):
        transport.send(frame)
    try:
        answer = await asyncio.wait_for(answers.get(), ANSWER_S)
    except TimeoutError:
        raise BenchError(
            f"jitter: the device at address {device} does not answer; is it on this bus?"
        ) from None
    if answer.kind is not ReplyKind.ACK:
        raise BenchError(f"jitter: the device refuses set_unsolicited with code {int(answer.code)}")


async def heartbeat_jitter(spec: str, seconds: float, period_ms: int, *, node: int) -> Jitter:
    """Set a node's heartbeat period over SDO and measure the intervals."""
    arrivals = _Arrivals(lambda frame: frame.id == HEARTBEAT + node and not frame.extended)
    answered = asyncio.Event()

    def take(frame: CanFrame) -> None:
        arrivals.take(frame)
        if frame.id == SDO_REPLY + node and not frame.extended:
            answered.set()

    transport = open_can(spec)
    await transport.start(take)
    try:
        await _write_u16(transport, answered, node, PRODUCER_HEARTBEAT, period_ms)
        arrivals.times.clear()
        await asyncio.sleep(seconds)
    finally:
        await transport.close()
    return arrivals.jitter(f"heartbeat every {period_ms} ms")


async def _write_u16(
    transport: CanTransport, answered: asyncio.Event, node: int, index: int, value: int
) -> None:
    data = bytes((0x2B, index & 0xFF, index >> 8, 0)) + value.to_bytes(2, "little") + bytes(2)
    transport.send(CanFrame(SDO_REQUEST + node, data, extended=False))
    try:
        await asyncio.wait_for(answered.wait(), ANSWER_S)
    except TimeoutError:
        raise BenchError(f"jitter: CANopen node {node} does not answer; is it on this bus?") from None


async def sync_to_pdo(spec: str, seconds: float, period_s: float, *, node: int) -> tuple[Jitter, int]:
    """Put a node into OPERATIONAL, send SYNC, and measure how long its first PDO takes.

    Returns the figures, whose `deviation` is the time itself and not its distance from the mean, and the number of SYNCs
    that no PDO followed. PDOs must have a synchronous transmission type, which is the caller's business.
    """
    delays: list[float] = []
    sent_at = 0.0
    waiting = False
    transmit = {0x180 + node, 0x280 + node, 0x380 + node, 0x480 + node}

    def take(frame: CanFrame) -> None:
        nonlocal waiting
        if waiting and frame.id in transmit and not frame.extended:
            delays.append(time.perf_counter() - sent_at)
            waiting = False

    transport = open_can(spec)
    await transport.start(take)
    missed = 0
    try:
        transport.send(CanFrame(NMT, bytes((1, node)), extended=False))
        await asyncio.sleep(0.1)
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            waiting, sent_at = True, time.perf_counter()
            transport.send(CanFrame(SYNC, extended=False))
            await asyncio.sleep(period_s)
            missed += waiting
    finally:
        await transport.close()
    return Jitter(
        "SYNC to TPDO", round(1e3 * fmean(delays), 3) if delays else 0.0, len(delays), Spread.of(delays)
    ), missed
