"""Formats of messages on a serial line: header, data and check within a framing.

A link has one format for both directions, unless its `format` gives a direction or some classes another framing or
check. Messages of several formats are distinguished by their first byte. Some messages are texts, which have no header:
requests, and the answers that acknowledge or refuse them.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Final, TypeVar

from starhil.protocol.errors import IcdError
from starhil.protocol.icd.link_schema import FixedFraming, FramingModel, SerialLinkModel
from starhil.protocol.messages import FaultKind, LinkFault, Reply, ReplyKind
from starhil.protocol.serial.checks import Check
from starhil.protocol.serial.framings import BodySizeError, Deframer, Framing, Receiving
from starhil.protocol.serial.headers import HeaderCodec, HeaderContent, HeaderError

_Message = TypeVar("_Message")


@dataclass(frozen=True, eq=False)
class MessageFormat:
    """Framing, check and header of messages, and the classes of messages that have this format; none: all others."""

    framing: Framing
    model: FramingModel
    check: Check
    header: HeaderCodec
    classes: Sequence[str] = ()

    @cached_property
    def request_size(self) -> int | None:
        """Bytes of each request, if all have the same size."""
        return self.model.request_size if isinstance(self.model, FixedFraming) else None

    @cached_property
    def _message_class(self) -> str:
        """The class of all messages, if there is only one."""
        return self.classes[0] if len(self.classes) == 1 else ""

    def close(self, header: bytes, data: bytes, *, wrong_check: bool = False) -> bytes:
        """Return header, data and check of a message; each bit of a wrong check is inverted."""
        if not self.check.size:
            return header + data
        check = self.check.compute(self._covered(header, data))
        return header + data + (bytes(byte ^ 0xFF for byte in check) if wrong_check else check)

    def _covered(self, header: bytes, data: bytes) -> bytes:
        covers = self.check.covers
        return (
            (self.framing.start if "start" in covers else b"")
            + (header if "header" in covers else b"")
            + (data if "data" in covers else b"")
        )

    def open(self, body: bytes) -> tuple[HeaderContent, bytes] | LinkFault:
        """Return header and data of a body, or its fault."""
        header = self.header
        end = len(body) - self.check.size
        try:
            envelope = header.unpack(body[: max(end, 0)], self._message_class)
        except HeaderError as error:
            if {"header", "data"} <= self.check.covers and not self._checks(body, 0, end):
                return self._bad_check(body[end:])
            return LinkFault(FaultKind.UART_PROTOCOL, str(error))
        address = header.address_in(body)
        if address is not None and address != header.defaults["address"]:
            text = f"message to address {address:#04x}, not {header.defaults['address']:#04x}"
            return LinkFault(FaultKind.UART_ADDRESS, text)
        if envelope is None:
            return LinkFault(
                FaultKind.UART_SHORT, f"message of {len(body)} bytes is shorter than its header and check"
            )
        if not self._checks(body, envelope.size, end):
            return self._bad_check(body[end:])
        found = end - envelope.size
        if "length" in header.roles and envelope.values["length"] != header.length(envelope.size, found):
            text = f"{found} bytes of data, but length {envelope.values['length']}"
            return LinkFault(FaultKind.UART_PROTOCOL, text)
        return envelope, body[envelope.size : end]

    def text(self, body: bytes) -> bytes | LinkFault:
        """Return the text of a body without header, or the fault of its check."""
        end = len(body) - self.check.size
        return body[:end] if end >= 0 and self._checks(body, 0, end) else self._bad_check(body[max(end, 0) :])

    def _checks(self, body: bytes, header_size: int, end: int) -> bool:
        if not self.check.size:
            return True
        covered = self._covered(body[:header_size], body[header_size:end])
        return self.check.compute(covered) == body[end:]

    @staticmethod
    def _bad_check(check: bytes) -> LinkFault:
        return LinkFault(FaultKind.UART_CHECK, f"check {check.hex().upper()} is wrong")

    def measure(self, body: bytes, data_size: Callable[[HeaderContent], int]) -> int | None:
        """Return the size of the body that begins with these bytes, or None if more are needed.

        `data_size` returns the size of the data if the header carries no length. Raises BodySizeError.
        """
        try:
            envelope = self.header.unpack(body, self._message_class)
            if envelope is None:
                return None
            data = self.header.data_size(envelope) if "length" in self.header.roles else data_size(envelope)
        except HeaderError as error:
            raise BodySizeError(str(error)) from None
        return envelope.size + data + self.check.size


class Formats:
    """The formats of the messages of one direction; the last is that of messages without a class.

    Raises IcdError if the messages of several formats cannot be distinguished by their first byte.
    """

    def __init__(self, formats: Sequence[MessageFormat], direction: str) -> None:
        self.all: Final = tuple(formats)
        self.other: Final = self.all[-1]
        where = f"link.serial.format: {direction}"
        if any(not form.classes for form in self.all[:-1]):
            raise IcdError(f"{where}: a format after one without `classes` fits no message")
        starts: dict[int | None, MessageFormat] = {}
        for form in self.all if len(self.all) > 1 else ():
            if form.model.kind not in ("length", "fixed", "delimited"):
                raise IcdError(
                    f"{where}: framing {form.model.kind} cannot stand beside another; set `direction`"
                )
            start = _first_byte(form)
            if start in starts:
                same = "have no `start`" if start is None else f"start with {start:02X}"
                both = " and ".join(f"{item.model.kind} of {_whose(item)}" for item in (starts[start], form))
                raise IcdError(
                    f"{where}: framings {both} {same}; give them different first bytes, or formats a `direction`"
                )
            starts[start] = form

    def of(self, message_class: str) -> MessageFormat:
        return next((form for form in self.all if message_class in form.classes), self.other)

    def deframer(
        self,
        interpret: Callable[[MessageFormat, bytes], _Message | LinkFault | None],
        measure: Callable[[MessageFormat, bytes], int | None],
        max_size: int,
        timeout_s: float,
    ) -> Deframer[_Message]:
        """Return a deframer for all formats; its functions are called with the format of the message."""
        made = {
            _first_byte(form): form.framing.deframer(
                Receiving(partial(interpret, form), partial(measure, form), max_size, timeout_s)
            )
            for form in self.all
        }
        return made[_first_byte(self.other)] if len(made) == 1 else _FirstByteDeframer(made)


class _FirstByteDeframer(Deframer[_Message]):
    """Gives each message to the deframer of the start byte with which it begins; None: of all other bytes."""

    def __init__(self, deframers: Mapping[int | None, Deframer[_Message]]) -> None:
        self._deframers = deframers
        self._other = deframers.get(None) or next(iter(deframers.values()))
        self._current = self._other

    @property
    def busy(self) -> bool:
        return self._current.busy

    def feed(self, data: bytes, now: float) -> list[_Message | LinkFault]:
        events: list[_Message | LinkFault] = list(self.flush(now))
        for byte in data:
            if not self._current.busy:
                self._current = self._deframers.get(byte, self._other)
            events += self._current.feed(bytes((byte,)), now)
        return events

    def flush(self, now: float) -> list[LinkFault]:
        return self._current.flush(now)


def _whose(form: MessageFormat) -> str:
    return f"class {' and '.join(form.classes)}" if form.classes else "all other messages"


def _first_byte(form: MessageFormat) -> int | None:
    return form.framing.start[0] if form.framing.start else None


CODE: Final = "{code}"
"""Stands for the error's number in the text of a refusal."""


def words(text: str) -> str:
    """Return a text with single spaces between its words, by which requests are compared."""
    return " ".join(text.split())


class TextReplies:
    """The texts by which a link acknowledges a telecommand, and refuses a request."""

    def __init__(self, link: SerialLinkModel) -> None:
        self.acknowledge: Final = link.acknowledge
        self.refusal: Final = link.refusal
        before, code, after = (link.refusal or "").partition(CODE)
        self._refused = re.compile(re.escape(before) + (r"(\d{1,5})" if code else "()") + re.escape(after))

    def encode(self, reply: Reply) -> bytes | None:
        """Return the text of a reply; None if the reply has header and data."""
        if reply.kind is ReplyKind.ACK and self.acknowledge is not None and not reply.data:
            return self.acknowledge.encode("ascii")
        if reply.kind is ReplyKind.NACK and self.refusal is not None:
            return self.refusal.replace(CODE, str(int(reply.code))).encode("ascii")
        return None

    def decode(self, body: bytes) -> tuple[ReplyKind, int] | None:
        """Return kind and error number of a text; None if it is neither an acknowledge nor a refusal."""
        text = body.decode("latin-1")
        if text == self.acknowledge:
            return ReplyKind.ACK, 0
        found = self._refused.fullmatch(text) if self.refusal is not None else None
        return None if found is None else (ReplyKind.NACK, int(found[1] or 0))
