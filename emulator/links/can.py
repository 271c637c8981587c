"""The CAN link: passes requests from CAN frames to the device and sends replies in segments."""

from __future__ import annotations

import asyncio
import random
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar

from starhil.emulator.device.requests import Requests
from starhil.emulator.links.base import RequestLink
from starhil.emulator.links.bus_address import BusAddress
from starhil.emulator.links.traffic import CONSOLE_ADDRESS
from starhil.protocol.can.cubespace import CanDeviceReceiver, CanId, encode_reply_frames
from starhil.protocol.can.frame import MAX_EXTENDED_ID, MAX_FRAME_DATA, MAX_STANDARD_ID, CanFrame
from starhil.protocol.messages import Reply, Request
from starhil.protocol.transports.base import Transport
from starhil.protocol.transports.python_can import QUEUE_LIMIT


class CanDamage:
    """Corrupts CAN frames; the result is a valid frame, because the CRC of the bus rejects any other.

    Frames have 29-bit CAN IDs (`extended`, CAN 2.0B) or 11-bit ones.
    """

    def __init__(self, *, extended: bool) -> None:
        self._extended = extended
        self._max_id = MAX_EXTENDED_ID if extended else MAX_STANDARD_ID

    def corrupt(self, item: CanFrame, rng: random.Random) -> CanFrame:
        """Flip one bit of the data, or of the CAN ID if there is no data."""
        if not item.data:
            return replace(item, id=item.id ^ 1 << rng.randrange(self._max_id.bit_length()))
        damaged = bytearray(item.data)
        damaged[rng.randrange(len(damaged))] ^= 1 << rng.randrange(8)
        return replace(item, data=bytes(damaged))

    def junk(self, rng: random.Random) -> CanFrame:
        """Return a frame with a random CAN ID and random data."""
        can_id = rng.randint(0, self._max_id)
        return CanFrame(can_id, rng.randbytes(rng.randint(0, MAX_FRAME_DATA)), extended=self._extended)

    def split(self, item: CanFrame, _size: int) -> Sequence[CanFrame]:
        """Return the frame unchanged, because CAN frames cannot be split."""
        return [item]


class CanLink(RequestLink[CanFrame, int]):
    """Connects a device to a CAN transport, with the address in its parameter `can_address`.

    Two sent frames are at least `frame_gap_s` seconds apart.
    """

    bus: ClassVar[str] = "can"

    def __init__(
        self, requests: Requests, transport: Transport[CanFrame], frame_gap_s: float = 0.0, seed: int = 0
    ) -> None:
        super().__init__(requests, transport, CanDamage(extended=True), seed)
        self._gap_s = frame_gap_s
        self._waiting: deque[CanFrame] = deque()
        self._next: asyncio.TimerHandle | None = None
        self._address = BusAddress("address", "links.can.address")

    async def start(self) -> str:
        """Join the bus; return its description."""
        bus = await super().start()
        self._address.acquire(bus, self._style)
        return bus

    async def close(self) -> None:
        self._address.release()
        if self._next is not None:
            self._next.cancel()
        await super().close()

    def _receive(self, item: CanFrame) -> None:
        if item.extended and CanId.unpack(item.id).source == self._address.number:
            self._address.report_duplicate()
        super()._receive(item)

    def _is_console(self, request: Request) -> bool:
        return request.source == CONSOLE_ADDRESS

    def _new_receiver(self) -> CanDeviceReceiver:
        return CanDeviceReceiver(self._style)

    def _wanted_style(self) -> int:
        return int(self._device.parameters["can_address"])

    def _style_changed(self, before: int) -> None:  # noqa: ARG002 (the interface's signature)
        self._receiver = self._new_receiver()
        self._address.change(self.transport.description, self._style)

    def _send(self, reply: Reply, style: int) -> None:
        for frame in encode_reply_frames(reply, style):
            self.wire.send(frame)

    def _transmit(self, item: CanFrame) -> None:
        if self._gap_s <= 0.0:
            super()._transmit(item)
            return
        if len(self._waiting) >= QUEUE_LIMIT:
            self.transport.statistics.dropped += 1
            return
        self._waiting.append(item)
        if self._next is None:
            self._transmit_next()

    def _transmit_next(self) -> None:
        self._next = None
        if self._waiting:
            super()._transmit(self._waiting.popleft())
            self._next = asyncio.get_running_loop().call_later(self._gap_s, self._transmit_next)
