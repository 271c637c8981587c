"""The CAN link: frames in from a transport, requests to the device, replies out in segments."""

from __future__ import annotations

import asyncio
import random
from collections import deque
from collections.abc import Sequence

from starhil.emulator.device.device import Device
from starhil.emulator.links.base import DeviceLink
from starhil.emulator.links.bus_address import BusAddress
from starhil.protocol.can_framing import (
    MAX_EXTENDED_ID,
    MAX_FRAME_DATA,
    CanDeviceReceiver,
    CanFrame,
    CanId,
    encode_reply_frames,
)
from starhil.protocol.messages import Reply
from starhil.protocol.transports.base import Transport


class CanPieces:
    """How frames on a bus are damaged (what a bus with a checksum lets through: another frame)."""

    def corrupt(self, item: CanFrame, rng: random.Random) -> CanFrame:
        """Turn one bit of the data, or of the identifier where there is no data."""
        if not item.data:
            return CanFrame(item.id ^ 1 << rng.randrange(29), b"")
        damaged = bytearray(item.data)
        damaged[rng.randrange(len(damaged))] ^= 1 << rng.randrange(8)
        return CanFrame(item.id, bytes(damaged))

    def junk(self, rng: random.Random) -> CanFrame:
        """Make a frame with a random identifier."""
        return CanFrame(rng.randint(0, MAX_EXTENDED_ID), rng.randbytes(rng.randint(0, MAX_FRAME_DATA)))

    def split(self, item: CanFrame, size: int) -> Sequence[CanFrame]:
        """Leave a frame whole: a frame is never split."""
        _ = size
        return [item]


class CanLink(DeviceLink[CanFrame, int]):
    """Binds a device to a CAN transport, under the address of its parameter `can_address`.

    Parameters
    ----------
    frame_gap_s
        Least time between two frames that the device sends, seconds.
    """

    def __init__(
        self, device: Device, transport: Transport[CanFrame], frame_gap_s: float = 0.0, seed: int = 0
    ) -> None:
        super().__init__(device, transport, CanPieces(), seed)
        self._gap_s = frame_gap_s
        self._waiting: deque[CanFrame] = deque()
        self._next: asyncio.TimerHandle | None = None
        self._address = BusAddress("address", "links.can.address")
        device.parameters.observe(self._parameters_changed)

    async def start(self) -> str:
        """Join the bus; return what was taken."""
        taken = await super().start()
        self._address.take(taken, self._style())
        return taken

    async def close(self) -> None:
        """Leave the bus."""
        self._address.release()
        if self._next is not None:
            self._next.cancel()
        await super().close()

    def _receive(self, item: CanFrame) -> None:
        if item.extended and CanId.unpack(item.id).source == self._address.number:
            self._address.report_elsewhere()
        super()._receive(item)

    def _new_receiver(self) -> CanDeviceReceiver:
        return CanDeviceReceiver(self._style())

    def _style(self) -> int:
        return int(self._device.parameters["can_address"])

    def _send(self, reply: Reply, style: int) -> None:
        frames = encode_reply_frames(reply, style)
        if self._gap_s <= 0.0:
            for frame in frames:
                self.wire.send(frame)
            return
        self._waiting.extend(frames)
        if self._next is None:
            self._send_next()

    def _send_next(self) -> None:
        self._next = None
        if self._waiting:
            self.wire.send(self._waiting.popleft())
            self._next = self._loop.call_later(self._gap_s, self._send_next)

    def _parameters_changed(self, names: frozenset[str]) -> None:
        if "can_address" in names:
            self._receiver = self._new_receiver()
            self._address.take(self.transport.description, self._style())
