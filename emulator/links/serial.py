"""The serial link: passes requests from a serial line to the device and sends replies, in the unit's framing."""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar, Final

from starhil.emulator.device.requests import Requests
from starhil.emulator.links.base import RequestLink
from starhil.protocol.messages import Receiver, Reply, Request
from starhil.protocol.serial.cubespace import Dialect
from starhil.protocol.serial.stack import SerialStack
from starhil.protocol.transports.paced import SerialTransport

JUNK_BYTES: Final = 8


class SerialDamage:
    """Corrupts bytes on a serial line."""

    def corrupt(self, item: bytes, rng: random.Random) -> bytes:
        """Flip one bit of one byte."""
        damaged = bytearray(item)
        damaged[rng.randrange(len(item))] ^= 1 << rng.randrange(8)
        return bytes(damaged)

    def junk(self, rng: random.Random) -> bytes:
        """Return 1 to `JUNK_BYTES` random bytes."""
        return rng.randbytes(rng.randint(1, JUNK_BYTES))

    def split(self, item: bytes, size: int) -> Sequence[bytes]:
        """Split into chunks of `size` bytes."""
        return [item[start : start + size] for start in range(0, len(item), size)]


class SerialLink(RequestLink[bytes, Dialect | None]):
    """Connects a device to a serial transport, at the bit rate in its parameter `serial_baud`.

    The CubeSpace family has three dialects of replies, of which only c has unsolicited telemetry.

    Parameters
    ----------
    console
        Whether the line is that of console and recording.
    """

    bus: ClassVar[str] = "serial"

    def __init__(
        self, requests: Requests, transport: SerialTransport, seed: int = 0, *, console: bool = False
    ) -> None:
        self._console = console
        self._stack = SerialStack(requests.device.icd)
        super().__init__(requests, transport, SerialDamage(), seed)
        self._port = transport
        self._baud = self._wanted_baud()
        self._numbered = 0
        """Messages that the device has numbered since its start."""
        self._device.signals.started.connect(self._restart_numbers)
        self._device.signals.parameters_changed.connect(self._parameters_changed)

    def _restart_numbers(self, _cause: str) -> None:
        self._numbered = 0

    def _wanted_baud(self) -> int:
        return int(self._device.parameters["serial_baud"])

    def _parameters_changed(self, names: frozenset[str]) -> None:
        if "serial_baud" in names:  # the change is acknowledged at the old rate
            self._loop.call_soon(self._change_rate)

    def _change_rate(self) -> None:
        if self._baud != self._wanted_baud():
            self._baud = self._wanted_baud()
            self._port.set_baud(self._baud)

    def _is_console(self, request: Request) -> bool:  # noqa: ARG002 (nobody else is on its line)
        return self._console

    def _new_receiver(self) -> Receiver[bytes, Request]:
        return self._stack.device()

    @property
    def dialect(self) -> Dialect | None:
        """The current dialect of replies; None for a unit without dialects."""
        if len(self._stack.dialects) < 2:
            return next(iter(self._stack.dialects), None)
        return Dialect(str(self._device.parameters["serial_dialect"]))

    @property
    def ready_fields(self) -> dict[str, str]:
        """Fields of the ready line, with the dialect at the start."""
        dialect = {} if self.dialect is None else {"dialect": self.dialect.value}
        return super().ready_fields | dialect

    def _reply_style(self) -> Dialect | None:
        return self.dialect

    def _send(self, reply: Reply, style: Dialect | None) -> None:
        numbered = self._stack.counts(reply.kind)
        if numbered:
            reply = replace(reply, sequence=self._numbered)
        data = self._stack.encode_reply(reply, style)
        if data:  # the unit may have no such reply
            self._numbered += numbered
            self.wire.send(data)

    def _send_unsolicited(self, reply: Reply) -> None:
        if self._stack.supports_unsolicited(self.dialect):
            super()._send_unsolicited(reply)
