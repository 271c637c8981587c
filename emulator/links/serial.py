"""The serial link: passes requests from a serial line to the device and sends replies, in the unit's framing."""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar, Final, NamedTuple

from starhil.emulator.device.requests import Requests
from starhil.emulator.links.base import RequestLink
from starhil.protocol.messages import Receiver, Reply, ReplyKind, Request
from starhil.protocol.serial.cubespace import Dialect
from starhil.protocol.serial.stack import SerialStack
from starhil.protocol.transports.paced import SerialTransport

JUNK_BYTES: Final = 8


class SerialDamage:
    """Corrupts bytes on a serial line."""

    def corrupt(self, item: bytes, rng: random.Random) -> bytes:
        damaged = bytearray(item)
        damaged[rng.randrange(len(item))] ^= 1 << rng.randrange(8)
        return bytes(damaged)

    def junk(self, rng: random.Random) -> bytes:
        """Return 1 to `JUNK_BYTES` random bytes."""
        return rng.randbytes(rng.randint(1, JUNK_BYTES))

    def split(self, item: bytes, size: int) -> Sequence[bytes]:
        """Split into chunks of `size` bytes."""
        return [item[start : start + size] for start in range(0, len(item), size)]


class SerialStyle(NamedTuple):
    """How a serial line is used."""

    dialect: Dialect | None
    """Dialect of replies; None for a unit without dialects."""
    baud: int


class SerialLink(RequestLink[bytes, SerialStyle]):
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
        self._timeout_s = self._stack.link.timeout
        self._port = transport
        super().__init__(requests, transport, SerialDamage(), seed)
        self._numbered = 0
        """Messages that the device has numbered since its start."""
        self._device.signals.started.connect(self._restart_numbers, first=True)

    def _restart_numbers(self, _cause: str) -> None:
        self._numbered = 0

    def _is_console(self, request: Request) -> bool:  # noqa: ARG002 -- a serial line has only one peer
        return self._console

    def _new_receiver(self) -> Receiver[bytes, Request]:
        return self._stack.device()

    @property
    def dialect(self) -> Dialect | None:
        """The dialect of replies; None for a unit without dialects."""
        return self._style.dialect

    def _wanted_style(self) -> SerialStyle:
        parameters, dialects = self._device.parameters, self._stack.dialects
        dialect = next(iter(dialects), None)
        if len(dialects) > 1:
            dialect = Dialect(str(parameters["serial_dialect"]))
        return SerialStyle(dialect, int(parameters["serial_baud"]))

    @property
    def shown_in_replies(self) -> frozenset[str]:
        """What its messages carry besides data, in some dialect."""
        return self._stack.shown_in_replies

    @property
    def ready_fields(self) -> dict[str, str]:
        """Fields of the ready line, with the dialect at the start."""
        dialect = {} if self.dialect is None else {"dialect": self.dialect.value}
        return super().ready_fields | dialect

    def _style_changed(self, before: SerialStyle) -> None:
        if self._style.baud != before.baud:
            self._port.set_baud(self._style.baud)

    def _send(self, reply: Reply, style: SerialStyle) -> None:
        if reply.kind is ReplyKind.UNSOLICITED and not self._stack.supports_unsolicited(style.dialect):
            return
        numbered = self._stack.counts(reply.kind)
        if numbered:
            reply = replace(reply, sequence=self._numbered)
        data = self._stack.encode_reply(reply, style.dialect)
        if data:  # the unit may have no such reply
            self._numbered += numbered
            self.wire.send(data)
