"""The serial link: passes requests from a serial line to the device and sends replies in its dialect."""

from __future__ import annotations

import random
from collections.abc import Sequence
from typing import ClassVar, Final

from starhil.emulator.device.requests import Requests
from starhil.emulator.links.base import DeviceLink
from starhil.protocol.messages import Reply
from starhil.protocol.serial_framing import DeviceReceiver, Dialect, encode_reply
from starhil.protocol.transports.paced import SerialTransport

JUNK_BYTES: Final = 8


class SerialDamage:
    """Damages bytes on a serial line."""

    def corrupt(self, item: bytes, rng: random.Random) -> bytes:
        """Flip one bit of one byte."""
        damaged = bytearray(item)
        damaged[rng.randrange(len(item))] ^= 1 << rng.randrange(8)
        return bytes(damaged)

    def junk(self, rng: random.Random) -> bytes:
        """Return 1 to `JUNK_BYTES` random bytes."""
        return rng.randbytes(rng.randint(1, JUNK_BYTES))

    def split(self, item: bytes, size: int) -> Sequence[bytes]:
        """Split into pieces of `size` bytes."""
        return [item[start : start + size] for start in range(0, len(item), size)]


class SerialLink(DeviceLink[bytes, Dialect]):
    """Connects a device to a serial transport, at the bit rate in its parameter `serial_baud`.

    Unsolicited telemetry is sent in dialect c only.
    """

    bus: ClassVar[str] = "serial"

    def __init__(self, requests: Requests, transport: SerialTransport, seed: int = 0) -> None:
        super().__init__(requests, transport, SerialDamage(), seed)
        self._port = transport
        self._baud = self._wanted_baud()
        self._device.parameters.observe(self._parameters_changed)

    def _wanted_baud(self) -> int:
        return int(self._device.parameters["serial_baud"])

    def _parameters_changed(self, names: frozenset[str]) -> None:
        if "serial_baud" in names:  # the acknowledge is still sent at the old rate
            self._loop.call_soon(self._change_rate)

    def _change_rate(self) -> None:
        if self._baud != self._wanted_baud():
            self._baud = self._wanted_baud()
            self._port.set_baud(self._baud)

    def _new_receiver(self) -> DeviceReceiver:
        return DeviceReceiver()

    def _reply_style(self) -> Dialect:
        return Dialect(str(self._device.parameters["serial_dialect"]))

    def _send(self, reply: Reply, style: Dialect) -> None:
        self.wire.send(encode_reply(reply, style))

    def _send_unsolicited(self, reply: Reply) -> None:
        if self._reply_style().supports_unsolicited:
            super()._send_unsolicited(reply)
