"""Measurement of a CAN bus under full load at the OBC: lost frames, wrong replies, latency.

It talks to a device over its links only, so it can measure a real unit as well as the emulator. The other
traffic comes from a separate process, which also counts the frames that arrive.
"""

from __future__ import annotations

import asyncio
import multiprocessing as mp
import time
from itertools import pairwise
from math import inf
from multiprocessing.connection import Connection
from typing import Final

from starhil.hil_tests.client import AsyncObcClient
from starhil.hil_tests.client.links import DEFAULT_DEVICE_ADDRESS, DEFAULT_HOST_ADDRESS, CanHostLink
from starhil.hil_tests.errors import BenchError
from starhil.hil_tests.timing.figures import CanLoad, Spread
from starhil.hil_tests.timing.latency import REQUESTED_ROWS, ask_in_turn, exchange
from starhil.hil_tests.timing.realtime import set_realtime_priority
from starhil.protocol.can.cubespace import CanId, MessageType
from starhil.protocol.can.frame import CanFrame
from starhil.protocol.errors import ProtocolError
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.icd.codec import Row
from starhil.protocol.messages import Reply, Request
from starhil.protocol.transports.can import open_can
from starid.storage.child_processes import importing_only_what_is_installed

HOST: Final = DEFAULT_HOST_ADDRESS
DEVICE: Final = DEFAULT_DEVICE_ADDRESS
TALKER: Final = 0x20
"""CAN address of the sender of the other traffic; it sends to the unused address LISTENER."""
LISTENER: Final = 0x21
ECHO: Final = 0x22
"""CAN address at which the traffic process echoes requests, for the latency of the machine."""

ECHO_ROW: Final = 133
"""Row ID of the other traffic."""

REPLY_WITHIN_S: Final = 2.0
TICK_S: Final = 0.001
"""Time between two bursts of the other traffic."""
SETTLE_S: Final = 5.0
"""Time that the last frames may take to arrive."""


# --- the other traffic ---


def _send_traffic(spec: str, rate: float, pipe: Connection, *, realtime: bool) -> None:
    """Send numbered frames at a rate until stopped; report how many arrived at a second port."""
    if realtime:
        set_realtime_priority()
    asyncio.run(_send_traffic_until_stopped(spec, rate, pipe))


async def _send_traffic_until_stopped(spec: str, rate: float, pipe: Connection) -> None:
    can_id = CanId(MessageType.TELEMETRY, ECHO_ROW, TALKER, LISTENER).pack()
    ping = CanId(MessageType.TELEMETRY_REQUEST, ECHO_ROW, HOST, ECHO).pack()
    pong = CanId(MessageType.TELEMETRY, ECHO_ROW, ECHO, HOST).pack()
    numbers: list[int] = []

    def count(frame: CanFrame) -> None:
        if frame.id == can_id:
            numbers.append(int.from_bytes(frame.data, "little"))
        elif frame.id == ping:
            listener.send(CanFrame(pong, frame.data))

    talker, listener = open_can(spec), open_can(spec)
    await listener.start(count)
    await talker.start(lambda _frame: None)
    pipe.send("ready")
    stop = asyncio.create_task(asyncio.to_thread(pipe.recv))
    begin = time.monotonic()
    sent = refused = 0
    while not stop.done():
        due = int((time.monotonic() - begin) * rate)
        for number in range(sent, due):
            refused += not talker.send(CanFrame(can_id, number.to_bytes(8, "little")))
        sent = max(sent, due)
        await asyncio.sleep(TICK_S)
    seconds = time.monotonic() - begin
    await talker.drain()
    end = time.monotonic() + SETTLE_S
    while len(numbers) < sent - refused and time.monotonic() < end:
        await asyncio.sleep(TICK_S)
    disordered = sum(later <= earlier for earlier, later in pairwise(numbers))
    pipe.send((seconds, sent, sent - len(set(numbers)), disordered, refused))
    await talker.close()
    await listener.close()


class OtherTraffic:
    """The process that keeps the bus busy."""

    def __init__(self, spec: str, rate: float, *, realtime: bool = False) -> None:
        self._pipe, far = mp.Pipe()
        self._process = mp.get_context("spawn").Process(
            target=_send_traffic, args=(spec, rate, far), kwargs={"realtime": realtime}, daemon=True
        )
        with importing_only_what_is_installed():
            self._process.start()
        far.close()
        self._receive_report()

    def stop(self) -> tuple[float, int, int, int, int]:
        """End the traffic; return seconds, and frames sent, lost, out of order, and rejected by the port."""
        self._pipe.send("stop")
        figures: tuple[float, int, int, int, int] = self._receive_report()
        self._process.join()
        return figures

    def _receive_report(self) -> tuple[float, int, int, int, int]:
        try:
            return self._pipe.recv()  # type: ignore[no-any-return]
        except EOFError:
            raise BenchError(
                "bus load: the process that sends the other traffic has ended; see its error above"
            ) from None


# --- CAN ---


def _is_right(row: Row, reply: Reply) -> bool:
    """Return whether every value of a reply is within its limits."""
    try:
        row.decode(reply.data, check=True)
    except ProtocolError:
        return False
    return True


async def load_can(
    icd: InterfaceDefinition,
    spec: str,
    seconds: float,
    rate: float,
    *,
    device: int = DEVICE,
    realtime: bool = False,
) -> CanLoad:
    """Request telemetry from a device while other nodes load the bus.

    `spec` is a bus as for `open_can`, `rate` the frames per second of the other traffic, whose process gets real-time
    priority with `realtime`; `device` is the CAN address of the device.
    """
    asker, echo = (
        AsyncObcClient(
            CanHostLink(spec, host_address=HOST, device_address=node), icd, timeout_s=REPLY_WITHIN_S
        )
        for node in (device, ECHO)
    )
    wrong = 0

    async def ask(row: Row) -> float:
        nonlocal wrong
        latency, reply = await exchange(asker, icd.request(row), row.name)
        wrong += latency < inf and (reply is None or not _is_right(row, reply))
        return latency

    async def ask_echo(_row: Row) -> float:
        return (await exchange(echo, Request.of(ECHO_ROW), "echo"))[0]

    await asker.start()
    await echo.start()
    traffic = await asyncio.to_thread(OtherTraffic, spec, rate, realtime=realtime)
    rows = [icd.telemetry[name] for name in REQUESTED_ROWS]
    latencies = await ask_in_turn({"device": ask, "echo": ask_echo}, rows, seconds)
    duration, sent, lost, disordered, refused = await asyncio.to_thread(traffic.stop)
    await asker.close()
    await echo.close()
    return CanLoad(
        seconds=round(duration, 1),
        offered_per_s=round(sent / duration, 1),
        sent=sent,
        lost=lost + refused,
        disordered=disordered,
        requests=len(latencies["device"]),
        unanswered=latencies["device"].count(inf),
        wrong=wrong + len(asker.faults) + len(asker.stray_replies),
        latency=Spread.of(latencies["device"]),
        machine=Spread.of(latencies["echo"]),
    )
