"""The serial link: bytes in from a transport, requests to the device, replies out in the dialect that is set."""

from __future__ import annotations

import asyncio
import logging
import random
from collections.abc import Sequence
from typing import Final

from emulator.device import Device
from emulator.links.wire_faults import WireFaults
from protocol.errors import ProtocolError
from protocol.messages import LinkFault, Reply, ReplyKind, Request
from protocol.serial_framing import DEFAULT_TIMEOUT_S, DeviceReceiver, Dialect, encode_reply
from protocol.transports.base import Transport

log = logging.getLogger("starhil.serial")

JUNK_BYTES: Final = 8


class SerialPieces:
    """How bytes on a line are damaged."""

    def corrupt(self, item: bytes, rng: random.Random) -> bytes:
        """Turn one bit of one byte."""
        damaged = bytearray(item)
        damaged[rng.randrange(len(item))] ^= 1 << rng.randrange(8)
        return bytes(damaged)

    def junk(self, rng: random.Random) -> bytes:
        """Make a few random bytes."""
        return rng.randbytes(rng.randint(1, JUNK_BYTES))

    def split(self, item: bytes, size: int) -> Sequence[bytes]:
        """Cut into pieces of `size` bytes."""
        return [item[start : start + size] for start in range(0, len(item), size)]


class SerialLink:
    """Binds a device to a serial transport.

    Parameters
    ----------
    device
        What answers.
    transport
        Where bytes come from and go to.
    seed
        Seed of wire faults.
    """

    def __init__(self, device: Device, transport: Transport[bytes], seed: int = 0) -> None:
        self._device = device
        self._transport = transport
        self._receiver = DeviceReceiver()
        self._loop = asyncio.get_running_loop()
        self._timer: asyncio.TimerHandle | None = None
        self.wire: WireFaults[bytes] = WireFaults(transport.send, SerialPieces(), self._loop.call_later, seed)
        device.outlets.append(self._unsolicited)
        device.on_reset.append(self._forget)

    async def start(self) -> str:
        """Open the port; return what was taken."""
        await self._transport.start(self._receive, self._complain)
        return self._transport.description

    async def close(self) -> None:
        """Give the port back."""
        if self._timer is not None:
            self._timer.cancel()
        await self._transport.close()

    def _receive(self, data: bytes) -> None:
        for event in self._receiver.feed(data, self._loop.time()):
            self._take(event)
        self._watch()

    def _take(self, event: Request | LinkFault) -> None:
        if isinstance(event, LinkFault):
            self._device.fault(event)
            return
        dialect = self._dialect  # the answer to a change of dialect still goes out in the old one
        for reply in self._device.handle(event):
            self._send(reply, dialect)

    @property
    def _dialect(self) -> Dialect:
        return Dialect(str(self._device.parameters["serial_dialect"]))

    def _send(self, reply: Reply, dialect: Dialect) -> None:
        self.wire.send(encode_reply(reply, dialect))

    def _unsolicited(self, reply: Reply) -> None:
        dialect = self._dialect
        if reply.kind is ReplyKind.UNSOLICITED and dialect.supports_unsolicited:
            self._send(reply, dialect)

    def _watch(self) -> None:
        """Give up a message that was begun if its end does not come in time."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if self._receiver.busy:
            self._timer = self._loop.call_later(DEFAULT_TIMEOUT_S * 1.01, self._flush)

    def _flush(self) -> None:
        for fault in self._receiver.flush(self._loop.time()):
            self._device.fault(fault)
        self._watch()

    def _forget(self) -> None:
        self._receiver = DeviceReceiver()

    def _complain(self, error: ProtocolError) -> None:
        log.warning("%s", error)
