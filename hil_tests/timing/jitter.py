"""Jitter of periodic CAN messages at the OBC: unsolicited telemetry, heartbeat, TPDO, SYNC."""

from __future__ import annotations

import asyncio
import time
from collections import defaultdict
from itertools import pairwise
from statistics import fmean
from typing import Final, Self

from starhil.hil_tests.client import AsyncObcClient
from starhil.hil_tests.client.links import CanHostLink
from starhil.hil_tests.errors import BenchError, NackError, NoReplyError
from starhil.hil_tests.timing.figures import Jitter, Spread
from starhil.protocol.can.frame import MAX_STANDARD_ID, CanFrame
from starhil.protocol.canopen import cob
from starhil.protocol.canopen.abort import SdoAbortError
from starhil.protocol.canopen.sdo_client import SdoTransfer, download, upload
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.transports.can import open_can

WARM_UP: Final = 3
"""Number of messages that are ignored at the start."""
ANSWER_S: Final = 2.0

PRODUCER_HEARTBEAT: Final = 0x1017
TPDO_COMMUNICATION: Final = 0x1800
EVERY_SYNC: Final = 1
EVENT_DRIVEN: Final = 255
RESET_COMMUNICATION: Final = 130
OPERATIONAL: Final = 1
PRE_OPERATIONAL: Final = 128
SETTLE_S: Final = 0.2


def _jitter(what: str, times: list[float]) -> Jitter:
    """Summarise the intervals between messages.

    Raises BenchError if there are too few.
    """
    counted = times[WARM_UP:]
    if len(counted) < 3:
        raise BenchError(f"jitter of {what}: only {len(times)} messages were received; is it switched on?")
    intervals = [later - earlier for earlier, later in pairwise(counted)]
    mean = fmean(intervals)
    deviations = [abs(interval - mean) for interval in intervals]
    return Jitter(what, round(1e3 * mean, 3), len(counted), Spread.of(deviations))


async def unsolicited_jitter(
    icd: InterfaceDefinition, spec: str, seconds: float, rate_hz: float, *, device: int
) -> Jitter:
    """Have a device send its clock unsolicited at a rate, and measure the intervals."""
    row = icd.telemetry["unix_time"]
    client = AsyncObcClient(CanHostLink(spec, device_address=device), icd, timeout_s=ANSWER_S)
    await client.start()
    try:
        for rate, pause_s in ((rate_hz, seconds), (0.0, 0.0)):
            await client.command("set_unsolicited", telemetry=row.id, rate=rate)
            await asyncio.sleep(pause_s)
    except NoReplyError:
        raise BenchError(
            f"jitter: the device at address {device} does not answer; is it on this bus?"
        ) from None
    except NackError as error:
        raise BenchError(f"jitter: the device refuses set_unsolicited with code {error.code}") from None
    finally:
        await client.close()
    arrived = client.unsolicited[row.name]
    times = [arrived.get_nowait().received_s for _ in range(arrived.qsize())]
    return _jitter(f"unsolicited telemetry at {rate_hz:g} Hz", times)


class _Master:
    """A minimal CANopen master of a node, which it resets to its stored settings at the end; a context manager."""

    def __init__(self, spec: str, node: int) -> None:
        self._transport = open_can(spec)
        self._node = node
        self._answer: asyncio.Future[bytes] | None = None
        self._times: defaultdict[int, list[float]] = defaultdict(list)
        """Arrival times of the frames with each 11-bit CAN ID."""

    async def __aenter__(self) -> Self:
        await self._transport.start(self._on_frame)
        return self

    async def __aexit__(self, *_error: object) -> None:
        self.send(cob.NMT, bytes((RESET_COMMUNICATION, self._node)))
        await self._transport.drain()
        await asyncio.sleep(SETTLE_S)
        await self._transport.close()

    def _on_frame(self, frame: CanFrame) -> None:
        if frame.extended:
            return
        self._times[frame.id].append(time.perf_counter())
        awaited = frame.id == cob.SDO_TRANSMIT + self._node
        if awaited and self._answer is not None and not self._answer.done():
            self._answer.set_result(frame.data)

    async def arrivals(self, can_id: int, seconds: float) -> list[float]:
        """Return the arrival times of the frames with a CAN ID within a time."""
        self._times.clear()
        await asyncio.sleep(seconds)
        return self._times.pop(can_id, [])

    async def write(self, index: int, subindex: int, value: int, size: int) -> None:
        """Write an entry of up to four bytes; raise BenchError if the node refuses or does not answer."""
        await self._transfer(index, subindex, download(index, subindex, value.to_bytes(size, "little")))

    async def _transfer(self, index: int, subindex: int, transfer: SdoTransfer) -> bytes:
        request = next(transfer)
        while True:
            self._answer = asyncio.get_running_loop().create_future()
            self.send(cob.SDO_RECEIVE + self._node, request)
            try:
                request = transfer.send(await asyncio.wait_for(self._answer, ANSWER_S))
            except StopIteration as done:
                return bytes(done.value)
            except TimeoutError:
                raise BenchError(
                    f"jitter: CANopen node {self._node} does not answer; is it on this bus?"
                ) from None
            except SdoAbortError as abort:
                raise BenchError(
                    f"jitter: node {self._node} refuses {index:04X}h:{subindex} with abort code {abort.code:08X}h"
                ) from None

    async def prepare_tpdo(self, transmission: int, event_ms: int) -> int:
        """Configure the first TPDO, start the node, and return the CAN ID of the TPDO."""
        self.send(cob.NMT, bytes((PRE_OPERATIONAL, self._node)))
        stored = await self._transfer(TPDO_COMMUNICATION, 1, upload(TPDO_COMMUNICATION, 1))
        can_id = int.from_bytes(stored, "little")
        await self.write(TPDO_COMMUNICATION, 1, can_id | cob.INVALID, 4)
        await self.write(TPDO_COMMUNICATION, 2, transmission, 1)
        await self.write(TPDO_COMMUNICATION, 5, event_ms, 2)
        await self.write(TPDO_COMMUNICATION, 1, can_id & ~cob.INVALID, 4)
        self.send(cob.NMT, bytes((OPERATIONAL, self._node)))
        await asyncio.sleep(SETTLE_S)
        return can_id & MAX_STANDARD_ID

    def send(self, can_id: int, data: bytes = b"") -> None:
        """Send a frame with an 11-bit CAN ID."""
        self._transport.send(CanFrame(can_id, data, extended=False))


async def heartbeat_jitter(spec: str, seconds: float, period_ms: int, *, node: int) -> Jitter:
    """Set the heartbeat period of a node and measure the intervals."""
    async with _Master(spec, node) as master:
        await master.write(PRODUCER_HEARTBEAT, 0, period_ms, 2)
        times = await master.arrivals(cob.ERROR_CONTROL + node, seconds)
    return _jitter(f"heartbeat every {period_ms} ms", times)


async def event_timer_jitter(spec: str, seconds: float, period_ms: int, *, node: int) -> Jitter:
    """Have a node send its first TPDO by the event timer, and measure the intervals."""
    async with _Master(spec, node) as master:
        await master.write(PRODUCER_HEARTBEAT, 0, 0, 2)
        pdo = await master.prepare_tpdo(EVENT_DRIVEN, period_ms)
        times = await master.arrivals(pdo, seconds)
    return _jitter(f"TPDO by event timer every {period_ms} ms", times)


async def sync_to_pdo(spec: str, seconds: float, period_s: float, *, node: int) -> Jitter:
    """Make the first TPDO of a node synchronous, send SYNC, and measure the delay of the TPDO.

    In the result, `deviation` holds the delays and `period_ms` their mean. Raises BenchError if a SYNC is not
    followed by the TPDO.
    """
    delays: list[float] = []
    syncs = 0
    async with _Master(spec, node) as master:
        pdo = await master.prepare_tpdo(EVERY_SYNC, 0)
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            sent_at = time.perf_counter()
            master.send(cob.SYNC)
            syncs += 1
            delays += [moment - sent_at for moment in (await master.arrivals(pdo, period_s))[:1]]
    if len(delays) < syncs:
        raise BenchError(
            f"jitter: {syncs - len(delays)} of {syncs} SYNCs were not followed by a PDO of node {node}"
        )
    return Jitter("SYNC to TPDO", round(1e3 * fmean(delays), 3), len(delays), Spread.of(delays))
