"""Framings of serial links: how the beginning and end of a message are marked in a stream of bytes.

A framing turns a body (header, data and check) into bytes, and makes deframers, which do the reverse. A
deframer is sans-I/O: it is fed bytes with their time of arrival and returns faults and the messages to which
`interpret` decodes the bodies.
"""

from __future__ import annotations

import binascii
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Generic, TypeVar, assert_never

from starhil.protocol.errors import ProtocolError
from starhil.protocol.link_schema import (
    ByteStuffing,
    CubeSpaceFraming,
    CustomFraming,
    DelimitedFraming,
    EscapedFraming,
    FixedFraming,
    FramingModel,
    LengthFraming,
    SlipFraming,
)
from starhil.protocol.messages import FaultKind, LinkFault
from starhil.protocol.plugin import guarded
from starhil.protocol.values import IcdError

_Message = TypeVar("_Message")

CUBESPACE: Final = EscapedFraming(kind="escaped", escape=0x1F, start=0x7F, end=0xFF)
"""Marks of CubeSpace's requests, and of its replies of generation 1."""


class BodySizeError(ProtocolError):
    """The beginning of a body that matches no message."""


@dataclass(frozen=True)
class Receiving(Generic[_Message]):
    """How a deframer handles bodies: interpretation, size and limits."""

    interpret: Callable[[bytes], _Message | LinkFault | None]
    """Returns the message in a body, its fault, or None if the body is consumed."""
    measure: Callable[[bytes], int | None]
    """Returns the size of the body that begins with these bytes, or None if more are needed.

    Raises BodySizeError.
    """
    max_size: int
    """Longest body, bytes."""
    timeout_s: float
    """Silence within a message after which it is abandoned."""


class Deframer(ABC, Generic[_Message]):
    """Finds bodies in a stream of bytes; each run of junk yields one fault."""

    @property
    @abstractmethod
    def busy(self) -> bool:
        """Whether a message is incomplete."""

    @abstractmethod
    def feed(self, data: bytes, now: float) -> list[_Message | LinkFault]:
        """Return the messages and faults that these bytes complete; `now` is the time of arrival, s."""

    @abstractmethod
    def flush(self, now: float) -> list[LinkFault]:
        """Abandon an incomplete message after a silence of the timeout."""


class _Collector(Deframer[_Message]):
    """Base of the deframers that collect bytes until a message is complete."""

    def __init__(self, receiving: Receiving[_Message]) -> None:
        self._interpret = receiving.interpret
        self._measure = receiving.measure
        self._max_size = receiving.max_size
        self._timeout_s = receiving.timeout_s
        self._last_time = float("-inf")
        self._events: list[_Message | LinkFault] = []

    def feed(self, data: bytes, now: float) -> list[_Message | LinkFault]:
        self._events = list(self.flush(now))
        if data:
            self._last_time = now
            self._consume(data)
        return self._events

    def flush(self, now: float) -> list[LinkFault]:
        if now - self._last_time < self._timeout_s:
            return []
        fault = self._abandon()
        return [] if fault is None else [fault]

    def _incomplete(self, size: int) -> LinkFault:
        """Return the fault of an incomplete message with this number of bytes."""
        text = f"message of {size} bytes without end after {self._timeout_s:g} s of silence"
        return LinkFault(FaultKind.UART_INCOMPLETE, text)

    @abstractmethod
    def _consume(self, data: bytes) -> None:
        """Process bytes and add the messages and faults that they complete."""

    @abstractmethod
    def _abandon(self) -> LinkFault | None:
        """Drop the buffer; return the fault of an incomplete message that has not been reported."""

    def _add(self, result: _Message | LinkFault | None) -> None:
        if result is not None:
            self._events.append(result)

    def _fault(self, kind: FaultKind, text: str) -> None:
        self._events.append(LinkFault(kind, text))

    def _overlong(self) -> LinkFault:
        return LinkFault(FaultKind.UART_OVERLONG, f"message longer than {self._max_size} bytes")


class Framing(ABC):
    """A way to mark messages in a stream of bytes."""

    start: bytes = b""
    """Bytes before a body, which a check may cover."""
    end: bytes = b""

    @abstractmethod
    def encode(self, body: bytes) -> bytes:
        """Return a body as bytes on the line.

        Raises ProtocolError if the framing cannot carry it.
        """

    @abstractmethod
    def deframer(self, receiving: Receiving[_Message]) -> Deframer[_Message]:
        """Return a deframer for one direction."""


class Slip(Framing):
    """Frames between end bytes, with substituted bytes within (RFC 1055).

    ::

        [end]  body, end -> escape substitute 1, escape -> escape substitute 2  end
          C0   01 DB DC 02 DB DD  (the body 01 C0 02 DB)                         C0
    """

    def __init__(self, model: SlipFraming) -> None:
        substitutes = model.escaped
        self.end = bytes((model.end,))
        self.escape = bytes((model.escape,))
        self._before = self.end if model.leading_end else b""
        self._escaped_end = self.escape + bytes((substitutes[0],))
        self._escaped_escape = self.escape + bytes((substitutes[1],))
        self._originals = {substitutes[0]: self.end, substitutes[1]: self.escape}
        if len({model.end, model.escape, *substitutes}) < 4:
            raise IcdError("link.serial.framing: end, escape and substitutes must differ")

    def encode(self, body: bytes) -> bytes:
        """Return `end`, the body with its end and escape bytes substituted, and `end`."""
        escaped = body.replace(self.escape, self._escaped_escape).replace(self.end, self._escaped_end)
        return self._before + escaped + self.end

    def bodies(self, text: bytes) -> Iterator[bytes | LinkFault]:
        """Yield the body of the bytes between two end bytes, if there are any, or its fault."""
        if text:
            yield self._unescaped(text)

    def _unescaped(self, text: bytes) -> bytes | LinkFault:
        first, *rest = text.split(self.escape)
        body = [first]
        for piece in rest:
            original = self._originals.get(piece[0]) if piece else None
            if original is None:
                found = f"byte {piece[0]:02X}" if piece else "the end of the message"
                return LinkFault(FaultKind.UART_PROTOCOL, f"{found} after an escape byte within a message")
            body += (original, piece[1:])
        return b"".join(body)

    def deframer(self, receiving: Receiving[_Message]) -> Deframer[_Message]:
        """Return a deframer for the messages between end bytes."""
        return _DelimitedDeframer(receiving, self, 2 * receiving.max_size)


class _DelimitedDeframer(_Collector[_Message]):
    """Divides the stream at each end; text longer than `limit` is reported once and skipped up to the next end."""

    def __init__(self, receiving: Receiving[_Message], framing: Slip | Delimited, limit: int) -> None:
        super().__init__(receiving)
        self._framing = framing
        self._limit = limit
        self._text = b""
        self._skipping = False

    @property
    def busy(self) -> bool:
        return bool(self._text) or self._skipping

    def _consume(self, data: bytes) -> None:
        end = self._framing.end
        *whole, self._text = (self._text + data).split(end)
        for text in whole:
            if len(text) > self._limit and not self._skipping:
                self._add(self._overlong())
            elif not self._skipping:
                self._deliver(text)
            self._skipping = False
        if len(self._text) > self._limit:
            if not self._skipping:
                self._add(self._overlong())
            self._skipping = True
            self._text = self._text[len(self._text) - len(end) + 1 :]

    def _deliver(self, text: bytes) -> None:
        for body in self._framing.bodies(text):
            if isinstance(body, LinkFault):
                self._add(body)
            else:
                self._add(self._overlong() if len(body) > self._max_size else self._interpret(body))

    def _abandon(self) -> LinkFault | None:
        size = 0 if self._skipping else len(self._text)
        self._text = b""
        self._skipping = False
        return self._incomplete(size) if size else None


class Escaped(Framing):
    """`escape start … escape end`, with escape bytes in between doubled (DLE framing).

    ::

        escape start   body, escape doubled   escape end
          10     02    48 10 10 99              10    03

    Parameters
    ----------
    starts
        Bytes that start a message, if there are several; the body then begins with one of them.
    first_is_id
        Whether a body begins with an ID. An ID that is the escape byte is ambiguous in practice: some senders double
        it, others do not. Both forms are read as that ID, unless the bytes are a start or an end.
    """

    def __init__(
        self, model: EscapedFraming, starts: frozenset[int] = frozenset(), *, first_is_id: bool = False
    ) -> None:
        if len({model.escape, model.start, model.end}) < 3:
            raise IcdError("link.serial.framing: escape, start and end must differ")
        self.escape = bytes((model.escape,))
        self.start = self.escape if starts else bytes((model.escape, model.start))
        self.end = bytes((model.escape, model.end))
        self.starts = starts
        self.first_is_id = first_is_id

    def encode(self, body: bytes) -> bytes:
        """Return start, the body with its escape bytes doubled, and end."""
        return self.start + body.replace(self.escape, self.escape * 2) + self.end

    def deframer(self, receiving: Receiving[_Message]) -> Deframer[_Message]:
        """Return a deframer that ignores bytes between messages."""
        return EscapedDeframer(receiving, self)


class EscapedDeframer(_Collector[_Message]):
    """Finds bodies between starts and ends; each run of junk yields one fault.

    A run of junk ends at the next start of a message or after a silence of the timeout.
    """

    def __init__(self, receiving: Receiving[_Message], framing: Escaped) -> None:
        super().__init__(receiving)
        self._several = bool(framing.starts)
        self._starts = framing.starts or frozenset(framing.start[1:])
        self._escape = framing.escape
        self._end = framing.end[1]
        self._first_is_id = framing.first_is_id
        self._in_message = False
        self._escaped = False
        """Whether the last byte was an escape byte."""
        self._start = 0
        self._body = bytearray()
        self._in_junk = False

    @property
    def busy(self) -> bool:
        """Whether a message is incomplete."""
        return self._in_message

    def _consume(self, data: bytes) -> None:
        position, size = 0, len(data)
        while position < size:
            if self._escaped:
                self._escaped = False
                self._after_escape(data[position])
                position += 1
                continue
            found = data.find(self._escape, position)
            end = size if found < 0 else found
            if end > position:
                self._add_plain_bytes(data[position:end])
            self._escaped = found >= 0
            position = end + 1

    def _abandon(self) -> LinkFault | None:
        in_message, size = self._in_message, len(self._body)
        lone_escape = self._escaped and not in_message and not self._in_junk
        self._reset(in_junk=False)
        if lone_escape:
            return LinkFault(
                FaultKind.UART_PROTOCOL, f"escape byte {self._escape.hex().upper()} outside a message"
            )
        return self._incomplete(size) if in_message else None

    def _add_plain_bytes(self, run: bytes) -> None:
        """Add bytes that are neither escape bytes nor escaped."""
        if self._in_message:
            self._body += run
            if len(self._body) > self._max_size:
                self._drop_message(self._overlong())
        else:
            self._report_junk(run[0])

    def _after_escape(self, byte: int) -> None:
        if byte in self._starts:
            if self._in_message:
                text = f"message of {len(self._body)} bytes interrupted by the start of another"
                self._fault(FaultKind.UART_INCOMPLETE, text)
            self._reset(in_junk=False)
            self._in_message = True
            self._start = byte
        elif not self._in_message:
            self._report_junk(self._escape[0])
            self._escaped = byte == self._escape[0]
        elif byte == self._end:
            body = bytes(self._body)
            self._reset(in_junk=False)
            self._deliver(body)
        elif byte == self._escape[0]:
            self._add_plain_bytes(self._escape)
        elif self._first_is_id and not self._body:
            self._add_plain_bytes(self._escape + bytes((byte,)))
        else:
            text = f"byte {byte:02X} after an escape byte within a message"
            self._drop_message(LinkFault(FaultKind.UART_PROTOCOL, text))

    def _deliver(self, body: bytes) -> None:
        if not body:
            self._fault(FaultKind.UART_PROTOCOL, "message without an ID")
        else:
            self._add(self._interpret(bytes((self._start,)) + body if self._several else body))

    def _reset(self, *, in_junk: bool) -> None:
        self._in_message = self._escaped = False
        self._in_junk = in_junk
        self._body.clear()

    def _drop_message(self, fault: LinkFault) -> None:
        """Drop the message; its remaining bytes belong to the same run of junk."""
        self._add(fault)
        self._reset(in_junk=True)

    def _report_junk(self, byte: int) -> None:
        if not self._in_junk:
            self._fault(FaultKind.UART_PROTOCOL, f"byte {byte:02X} outside a message")
        self._in_junk = True


class Stuffing:
    """The bytes of a range as two: the first of the range, and the bits in which they differ.

    ::

        41 F0 7F F3   ->   41 F0 00 7F F0 03   (escape F0, mask 0F)
    """

    def __init__(self, model: ByteStuffing | None) -> None:
        if model is not None and (not model.mask or model.escape & model.mask):
            raise IcdError(
                f"link.serial.framing.stuffing: mask {model.mask:#04x} must have bits, and only bits that escape "
                f"{model.escape:#04x} does not have"
            )
        self._escape = None if model is None else model.escape
        self._mask = 0 if model is None else model.mask

    def encode(self, body: bytes) -> bytes:
        """Return a body with the bytes of the range stuffed."""
        if self._escape is None:
            return body
        stuffed = bytearray()
        for byte in body:
            in_range = byte & ~self._mask == self._escape
            stuffed += bytes((self._escape, byte & self._mask)) if in_range else bytes((byte,))
        return bytes(stuffed)

    def decode(self, line: bytes) -> tuple[bytes, Sequence[int]]:
        """Return the body in stuffed bytes, and where each of its bytes ends on the line.

        An escape byte at the end is left out, because its second byte is missing.
        """
        if self._escape is None:
            return line, range(1, len(line) + 1)
        body, ends, position = bytearray(), [], 0
        while position < len(line):
            escaped = line[position] == self._escape
            position += 1 + escaped
            if position > len(line):
                break
            body.append(line[position - 1] | (self._escape if escaped else 0))
            ends.append(position)
        return bytes(body), ends


class Counted(Framing):
    """`start`, a body whose size is given by its header or its row, `end`.

    ::

        start   body: header (with its length), data, check   end
        DE AD   00 00 00 02                                   BE EF
    """

    def __init__(self, start: list[int], end: list[int], stuffing: ByteStuffing | None = None) -> None:
        self.start = bytes(start)
        self.end = bytes(end)
        self.stuffing = Stuffing(stuffing)

    def encode(self, body: bytes) -> bytes:
        """Return start, body and end."""
        return self.start + self.stuffing.encode(body) + self.end

    def deframer(self, receiving: Receiving[_Message]) -> Deframer[_Message]:
        """Return a deframer that after a bad message continues at the byte after its start."""
        return _CountedDeframer(receiving, self)


class _CountedDeframer(_Collector[_Message]):
    def __init__(self, receiving: Receiving[_Message], framing: Counted) -> None:
        super().__init__(receiving)
        self._start, self._end, self._stuffing = framing.start, framing.end, framing.stuffing
        self._buffer = bytearray()
        self._reported = 0
        """Number of bytes at the beginning of the buffer that a fault has already reported."""
        self._in_junk = False

    @property
    def busy(self) -> bool:
        return bool(self._buffer) or (self._in_junk and not self._start)

    def _consume(self, data: bytes) -> None:
        if self._in_junk and not self._start:
            return
        self._buffer += data
        while self._buffer and self._at_start() and self._read_message():
            pass

    def _at_start(self) -> bool:
        """Drop junk before the next start; return whether a complete start was found."""
        head = len(self._start)
        if not head:
            return True
        found = self._buffer.find(self._start)
        self._drop_junk(self._partial_start() if found < 0 else found)
        return found >= 0

    def _partial_start(self) -> int:
        """Return the position of a start that may be incomplete."""
        for size in range(min(len(self._start) - 1, len(self._buffer)), 0, -1):
            if self._buffer.endswith(self._start[:size]):
                return len(self._buffer) - size
        return len(self._buffer)

    def _read_message(self) -> bool:
        """Take the message at the start of the buffer; return whether to continue."""
        head = len(self._start)
        body, ends = self._stuffing.decode(bytes(self._buffer[head:]))
        try:
            size = self._measure(body)
        except BodySizeError as error:
            return self._reject(LinkFault(FaultKind.UART_PROTOCOL, str(error)), head)
        if size is None:
            return len(body) > self._max_size and self._reject(self._overlong(), head)
        if size > self._max_size:
            return self._reject(self._overlong(), head)
        if len(body) < size:
            return False
        end = head + (ends[size - 1] if size else 0)
        whole = end + len(self._end)
        if len(self._buffer) < whole:
            return False
        if self._buffer[end:whole] != self._end:
            found = bytes(self._buffer[end:whole]).hex(" ").upper()
            text = f"{found} instead of the end of a message"
            return self._reject(LinkFault(FaultKind.UART_PROTOCOL, text), whole)
        result = self._interpret(body[:size])
        if isinstance(result, LinkFault):
            return self._reject(result, whole)
        self._drop(whole)
        self._in_junk = False
        self._add(result)
        return True

    def _reject(self, fault: LinkFault, extent: int) -> bool:
        """Report the message at the start of the buffer unless already covered by a report; search within it."""
        if self._reported <= 0:
            self._add(fault)
            self._reported = extent
        self._in_junk = True
        self._drop(1 if self._start else len(self._buffer))
        return True

    def _drop_junk(self, size: int) -> None:
        if size > max(self._reported, 0) and not self._in_junk:
            self._fault(FaultKind.UART_PROTOCOL, f"byte {self._buffer[0]:02X} outside a message")
        self._in_junk = self._in_junk or size > 0
        self._drop(size)

    def _drop(self, size: int) -> None:
        del self._buffer[:size]
        self._reported -= size

    def _abandon(self) -> LinkFault | None:
        size, reported = len(self._buffer), self._reported
        self._buffer.clear()
        self._reported = 0
        self._in_junk = False
        return self._incomplete(size) if size and reported <= 0 else None


class Delimited(Framing):
    """`start`, a body as bytes or hexadecimal digits, `end`.

    ::

        start   body, as it is or two digits a byte   end
          24    30 32 46 46  (the body 02 FF)        0D 0A
    """

    def __init__(self, model: DelimitedFraming) -> None:
        self.start = bytes(model.start)
        self.end = bytes(model.end)
        self._hex = model.encoding == "hex"

    def encode(self, body: bytes) -> bytes:
        """Return start, the body and end."""
        text = body.hex().upper().encode() if self._hex else body
        for mark, within in ((self.end, text + self.end[:-1]), (self.start, text)):
            if mark and mark in within:
                raise ProtocolError(
                    f"a message that contains {mark.hex(' ').upper()} does not fit this framing; "
                    'set link.serial.framing.encoding = "hex"'
                )
        return self.start + text + self.end

    def bodies(self, text: bytes) -> Iterator[bytes | LinkFault]:
        """Yield the body of the text before an end, and the faults of what does not belong to it."""
        before, start, text = text.rpartition(self.start) if self.start else (b"", b"", text)
        if not start and self.start:
            yield LinkFault(FaultKind.UART_PROTOCOL, "message without its start")
            return
        if before:
            yield LinkFault(FaultKind.UART_PROTOCOL, f"byte {before[0]:02X} outside a message")
        try:
            yield binascii.unhexlify(text) if self._hex else text
        except binascii.Error:
            yield LinkFault(FaultKind.UART_PROTOCOL, f"{text[:8]!r} is not hexadecimal")

    def deframer(self, receiving: Receiving[_Message]) -> Deframer[_Message]:
        """Return a deframer for the text before each end."""
        longest = 2 * receiving.max_size if self._hex else receiving.max_size
        return _DelimitedDeframer(receiving, self, longest + len(self.start))


class FirstByteDeframer(Deframer[_Message]):
    """Gives each message to the deframer of the start byte with which it begins; None: of all other bytes."""

    def __init__(self, deframers: Mapping[int | None, Deframer[_Message]]) -> None:
        self._deframers = deframers
        self._other = deframers.get(None) or next(iter(deframers.values()))
        self._current = self._other

    @property
    def busy(self) -> bool:
        """Whether a message is incomplete."""
        return self._current.busy

    def feed(self, data: bytes, now: float) -> list[_Message | LinkFault]:
        """Return the messages and faults that these bytes complete."""
        events: list[_Message | LinkFault] = list(self.flush(now))
        for byte in data:
            if not self._current.busy:
                self._current = self._deframers.get(byte, self._other)
            events += self._current.feed(bytes((byte,)), now)
        return events

    def flush(self, now: float) -> list[LinkFault]:
        """Abandon an incomplete message after a silence of the timeout."""
        return self._current.flush(now)


class _PluginFraming(Framing):
    """A framing of a plugin, whose failures are raised as an IcdError of one line."""

    def __init__(self, name: str, framing: object) -> None:
        if not isinstance(framing, Framing):
            raise IcdError(f"framing {name} must be a class derived from starhil.protocol.framings.Framing")
        self._name = name
        self._framing = framing
        self.start, self.end = framing.start, framing.end

    def encode(self, body: bytes) -> bytes:
        line: object = guarded(f"framing {self._name}", self._framing.encode)(body)
        if not isinstance(line, bytes):
            raise IcdError(f"framing {self._name} must encode to bytes, not {type(line).__name__}")
        return line

    def deframer(self, receiving: Receiving[_Message]) -> Deframer[_Message]:
        made: object = guarded(f"framing {self._name}", self._framing.deframer)(receiving)
        if not isinstance(made, Deframer):
            raise IcdError(f"framing {self._name} must make a Deframer, not {type(made).__name__}")
        return made


def build_framing(model: FramingModel, custom: Mapping[str, Callable[[], object]] | None = None) -> Framing:
    """Return the framing that a definition selects; `custom` holds the plugin's framings by name.

    Raises IcdError.
    """
    match model:
        case EscapedFraming():
            return Escaped(model)
        case SlipFraming():
            return Slip(model)
        case LengthFraming() | FixedFraming():
            return Counted(model.start, model.end, model.stuffing)
        case DelimitedFraming():
            return Delimited(model)
        case CustomFraming():
            if custom is None or model.name not in custom:
                raise IcdError(f"link.serial.framing: the plugin has no framing named {model.name!r}")
            return _PluginFraming(model.name, custom[model.name]())
        case CubeSpaceFraming():
            return Escaped(CUBESPACE, first_is_id=True)
        case _:
            assert_never(model)
