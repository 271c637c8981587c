"""Full load in both directions of a serial line, with a check of every reply.

It talks to a device over the line only, so it can measure a real unit as well as the emulator.
"""

from __future__ import annotations

import asyncio
import re
import time
from collections import deque
from typing import Final

from starhil.hil_tests.timing.figures import SerialLoad
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.image_transfer import MAP_PART_SIZE
from starhil.protocol.messages import LinkFault, Reply, ReplyKind, Request
from starhil.protocol.serial.cubespace import Dialect
from starhil.protocol.serial.stack import SerialStack
from starhil.protocol.transports.paced import SerialTransport
from starhil.protocol.transports.serial import open_serial

REPLY_WITHIN_S: Final = 2.0
MAPS_BETWEEN_STARS: Final = (6, 6, 6, 7)
"""Number of long telecommands per long telemetry row, which balances both directions of the line."""
PIPELINE: Final = 60
"""Number of concurrent exchanges, so that both directions of the line stay busy."""


class _SerialPipeline:
    """Keeps several exchanges active: long telecommands out, long telemetry back."""

    def __init__(self, icd: InterfaceDefinition, dialect: Dialect) -> None:
        stars = icd.telemetry["identified_stars"]
        hole_map = icd.telecommands["set_hole_map_1"]
        self._stack = SerialStack(icd)
        self._receiver = self._stack.host(dialect)
        maps = [(Request.of(hole_map.id, bytes((value,)) * MAP_PART_SIZE), 0) for value in range(1, 8)]
        self._cycle = []
        for count in MAPS_BETWEEN_STARS:
            self._cycle += [(Request.of(stars.id), stars.size), *maps[:count]]
        self._next = 0
        self._under_way: deque[tuple[Request, int]] = deque()
        self._reply_arrived = asyncio.Event()
        self.exchanges = 0
        self.wrong = 0
        self.last = b""

    @property
    def under_way(self) -> int:
        """Number of requests without a reply yet."""
        return len(self._under_way)

    def next_request(self) -> bytes:
        request, size = self._cycle[self._next % len(self._cycle)]
        self._next += 1
        return self.request(request, size)

    def request(self, request: Request, size: int) -> bytes:
        self._under_way.append((request, size))
        if len(self._under_way) == 1:
            return self._receiver.request(request)
        return self._stack.encode_request(request)

    def take(self, data: bytes) -> None:
        """Decode message by message, because in dialect b each reply needs its request."""
        for piece in re.findall(rb"[^\xff]*\xff|[^\xff]+", data):
            for event in self._receiver.feed(piece, time.monotonic()):
                self._check_reply(event)
        self._reply_arrived.set()

    async def drain(self, left: int) -> bool:
        """Wait until at most `left` requests are active; return False after `REPLY_WITHIN_S` of silence."""
        while self.under_way > left:
            self._reply_arrived.clear()
            try:
                await asyncio.wait_for(self._reply_arrived.wait(), REPLY_WITHIN_S)
            except TimeoutError:
                return False
        return True

    def _check_reply(self, event: Reply | LinkFault) -> None:
        if isinstance(event, LinkFault) or not self._under_way:
            self.wrong += 1
            return
        request, size = self._under_way.popleft()
        wanted = ReplyKind.TELEMETRY if size else ReplyKind.ACK
        self.wrong += (event.kind, event.id, len(event.data)) != (wanted, request.id, size)
        self.exchanges += 1
        self.last = event.data
        if self._under_way:
            self._receiver.overhear(self._under_way[0][0])


async def load_serial(
    icd: InterfaceDefinition, spec: str, seconds: float, baud: int, dialect: Dialect
) -> SerialLoad:
    """Keep a serial line busy in both directions and check every reply.

    `spec` is a port as for `open_serial`; `baud` and `dialect` are those of the device.
    """
    pipeline = _SerialPipeline(icd, dialect)
    transport = open_serial(spec, baud)
    await transport.start(pipeline.take)
    begin = time.monotonic()
    answers = True
    while answers and time.monotonic() - begin < seconds:
        while pipeline.under_way < PIPELINE:
            transport.send(pipeline.next_request())
        answers = await pipeline.drain(PIPELINE - 1)
    answers = answers and await pipeline.drain(0)
    duration = time.monotonic() - begin
    sent, received = transport.statistics.sent, transport.statistics.received
    flags = await _error_flags(icd, transport, pipeline) if answers else 0
    await transport.close()
    capacity = duration * baud / 10.0
    return SerialLoad(
        seconds=round(duration, 1),
        baud=baud,
        sent_bytes=sent,
        received_bytes=received,
        sent_share=round(sent / capacity, 3),
        received_share=round(received / capacity, 3),
        exchanges=pipeline.exchanges,
        wrong=pipeline.wrong + pipeline.under_way + flags,
    )


async def _error_flags(
    icd: InterfaceDefinition, transport: SerialTransport, pipeline: _SerialPipeline
) -> int:
    """Return the number of error flags that the device reports for its serial link."""
    row = icd.telemetry["communication_status"]
    transport.send(pipeline.request(Request.of(row.id), row.size))
    if not await pipeline.drain(0) or len(pipeline.last) != row.size:
        return 0  # the pipeline counts it
    values = row.decode(pipeline.last)
    return sum(
        bool(values[name]) for name in ("uart_protocol_error", "uart_incomplete", "telecommand_overrun")
    )
