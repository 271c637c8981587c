"""The serial link: bytes in from a transport, requests to the device, replies out in the dialect that is set."""

from __future__ import annotations

import random
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

from starhil.emulator.device.device import Device
from starhil.emulator.links.base import DeviceLink
from starhil.protocol.messages import Reply
from starhil.protocol.serial_framing import DeviceReceiver, Dialect, encode_reply

if TYPE_CHECKING:
    from starhil.protocol.transports import SerialTransport

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


class SerialLink(DeviceLink[bytes, Dialect]):
    """Binds a device to a serial transport, at the bit rate of its parameter `serial_baud`.

    Unsolicited telemetry goes out in dialect c only.
    """

    def __init__(self, device: Device, transport: SerialTransport, seed: int = 0) -> None:
        super().__init__(device, transport, SerialPieces(), seed)
        self._port = transport
        self._baud = self._wanted_baud()
        device.parameters.observe(self._parameters_changed)

    def _wanted_baud(self) -> int:
        return int(self._device.parameters["serial_baud"])

    def _parameters_changed(self, names: frozenset[str]) -> None:
        if "serial_baud" in names:  # the acknowledge is still to be sent, at the old rate
            self._loop.call_soon(self._change_rate)

    def _change_rate(self) -> None:
        if self._baud != self._wanted_baud():
            self._baud = self._wanted_baud()
            self._port.set_baud(self._baud)

    def _new_receiver(self) -> DeviceReceiver:
        return DeviceReceiver()

    def _style(self) -> Dialect:
        return Dialect(str(self._device.parameters["serial_dialect"]))

    def _send(self, reply: Reply, style: Dialect) -> None:
        self.wire.send(encode_reply(reply, style))

    def _unsolicited(self, reply: Reply) -> None:
        if self._style().supports_unsolicited:
            super()._unsolicited(reply)
