"""The CAN link: frames in from a transport, requests to the device, replies out in segments."""

from __future__ import annotations

import asyncio
import logging
import random
from collections import deque
from collections.abc import Sequence

from emulator.device import Device
from emulator.links.wire_faults import WireFaults
from protocol.can_framing import (
    DEFAULT_TIMEOUT_S,
    MAX_EXTENDED_ID,
    MAX_FRAME_DATA,
    CanDeviceReceiver,
    CanFrame,
    encode_reply_frames,
)
from protocol.errors import ProtocolError
from protocol.messages import LinkFault, Reply, Request
from protocol.transports.base import Transport

log = logging.getLogger("starhil.can")


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


class CanLink:
    """Binds a device to a CAN transport.

    Parameters
    ----------
    device
        What answers.
    transport
        Where frames come from and go to.
    frame_gap_s
        Least time between two frames that the device sends, seconds.
    seed
        Seed of wire faults.
    """

    def __init__(
        self, device: Device, transport: Transport[CanFrame], frame_gap_s: float = 0.0, seed: int = 0
    ) -> None:
        self._device = device
        self._transport = transport
        self._gap_s = frame_gap_s
        self._loop = asyncio.get_running_loop()
        self._receiver = CanDeviceReceiver(self._address)
        self._timer: asyncio.TimerHandle | None = None
        self._waiting: deque[CanFrame] = deque()
        self._next: asyncio.TimerHandle | None = None
        self.wire: WireFaults[CanFrame] = WireFaults(transport.send, CanPieces(), self._loop.call_later, seed)
        device.outlets.append(self._unsolicited)
        device.on_reset.append(self._forget)
        device.parameters.observe(self._parameters_changed)

    async def start(self) -> str:
        """Join the bus; return what was taken."""
        await self._transport.start(self._receive, self._complain)
        return self._transport.description

    async def close(self) -> None:
        """Leave the bus."""
        for timer in (self._timer, self._next):
            if timer is not None:
                timer.cancel()
        await self._transport.close()

    @property
    def _address(self) -> int:
        return int(self._device.parameters["can_address"])

    def _receive(self, frame: CanFrame) -> None:
        for event in self._receiver.feed(frame, self._loop.time()):
            self._take(event)
        self._watch()

    def _take(self, event: Request | LinkFault) -> None:
        if isinstance(event, LinkFault):
            self._device.fault(event)
            return
        address = self._address  # the answer to a change of address still comes from the old one
        for reply in self._device.handle(event):
            self._send(reply, address)

    def _send(self, reply: Reply, address: int) -> None:
        frames = encode_reply_frames(reply, address)
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

    def _unsolicited(self, reply: Reply) -> None:
        self._send(reply, self._address)

    def _parameters_changed(self, names: frozenset[str]) -> None:
        if "can_address" in names:
            self._receiver.address = self._address

    def _watch(self) -> None:
        """Give up a segmented message that was begun if its end does not come in time."""
        if self._timer is None and self._receiver.busy:
            self._timer = self._loop.call_later(DEFAULT_TIMEOUT_S * 1.01, self._flush)

    def _flush(self) -> None:
        self._timer = None
        for fault in self._receiver.flush(self._loop.time()):
            self._device.fault(fault)
        self._watch()

    def _forget(self) -> None:
        self._receiver = CanDeviceReceiver(self._address)
        self._waiting.clear()

    def _complain(self, error: ProtocolError) -> None:
        log.warning("%s", error)
