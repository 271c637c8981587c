"""Framings of serial links: how the beginning and end of a message are marked in a stream of bytes.

A framing turns a body (header, data and check) into bytes, and makes deframers, which do the reverse. A
deframer is sans-I/O: it is fed bytes with their time of arrival and returns faults and the messages to which
`interpret` decodes the bodies.
"""

from __future__ import annotations

import binascii
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Generic, TypeVar, assert_never

from starhil.protocol.errors import IcdError, ProtocolError
from starhil.protocol.icd.link_schema import (
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
from starhil.protocol.messages import FaultKind, LinkFault, Receiver
from starhil.protocol.plugin import guarded

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


class Deframer(Receiver[bytes, _Message]):
    """Finds bodies in a stream of bytes; each run of junk yields one fault."""


class _Collector(Deframer[_Message]):
    """Base of the deframers: collects bytes in a buffer, and removes junk and messages from its front.

    A run of junk is reported once, with its first byte. It lasts up to a message or a silence of the timeout.
    """

    def __init__(self, receiving: Receiving[_Message]) -> None:
        self._receiving = receiving
        self._last_time = float("-inf")
        self._events: list[_Message | LinkFault] = []
        self._buffer = bytearray()
        self._reported = 0
        """Number of bytes at the front of the buffer that a fault has already reported."""
        self._in_junk = False

    @property
    def busy(self) -> bool:
        return bool(self._buffer)

    def feed(self, data: bytes, now: float) -> list[_Message | LinkFault]:
        self._events = list(self.flush(now))
        if data:
            self._last_time = now
            self._buffer += data
            while self._buffer and self._take():
                pass
        return self._events

    def flush(self, now: float) -> list[LinkFault]:
        if now - self._last_time < self._receiving.timeout_s:
            return []
        fault = self._incomplete() if self._buffer else None
        self._buffer.clear()
        self._reported = 0
        self._in_junk = False
        return [] if fault is None else [fault]

    @abstractmethod
    def _take(self) -> bool:
        """Remove junk or a message from the front of the buffer; return whether to continue."""

    @abstractmethod
    def _incomplete(self) -> LinkFault | None:
        """Return the fault of the bytes in the buffer after a silence, unless it has been reported."""

    def _without_end(self, size: int) -> LinkFault:
        text = f"message of {size} bytes without end after {self._receiving.timeout_s:g} s of silence"
        return LinkFault(FaultKind.UART_INCOMPLETE, text)

    def _find_start(self, start: re.Pattern[bytes]) -> bool:
        """Drop junk before the next start; return whether that is complete: see `_start_pattern`."""
        match = start.search(self._buffer)
        size = len(self._buffer) if match is None else match.start()
        if size:
            if size > self._reported and not self._in_junk:
                self._fault(FaultKind.UART_PROTOCOL, f"byte {self._buffer[0]:02X} outside a message")
            self._in_junk = True
            self._drop(size)
        return match is not None and match.lastindex == 1

    def _drop(self, size: int) -> None:
        del self._buffer[:size]
        self._reported -= size

    def _add(self, result: _Message | LinkFault | None) -> None:
        if result is not None:
            self._events.append(result)

    def _fault(self, kind: FaultKind, text: str) -> None:
        self._events.append(LinkFault(kind, text))

    def _overlong(self) -> LinkFault:
        return LinkFault(FaultKind.UART_OVERLONG, f"message longer than {self._receiving.max_size} bytes")


def _start_pattern(mark: bytes, last: bytes) -> re.Pattern[bytes]:
    """Return the pattern of a start, or of its beginning at the end of the data.

    A start is `mark` and what the pattern `last` matches. Only a complete start has group 1.
    """
    pattern = b"(%b)" % last
    for byte in reversed(mark):
        pattern = b"%b(?:%b|\\Z)" % (re.escape(bytes((byte,))), pattern)
    return re.compile(pattern)


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
        body, *rest = text.split(self.escape)
        for piece in rest:
            original = self._originals.get(piece[0]) if piece else None
            if original is None:
                found = f"byte {piece[0]:02X}" if piece else "the end of the message"
                yield LinkFault(FaultKind.UART_PROTOCOL, f"{found} after an escape byte within a message")
                return
            body += original + piece[1:]
        if text:
            yield body

    def deframer(self, receiving: Receiving[_Message]) -> Deframer[_Message]:
        """Return a deframer for the messages between end bytes."""
        return _DelimitedDeframer(receiving, self, 2 * receiving.max_size)


class _DelimitedDeframer(_Collector[_Message]):
    """Divides the stream at each end; text longer than `limit` is junk up to the next end."""

    def __init__(self, receiving: Receiving[_Message], framing: Slip | Delimited, limit: int) -> None:
        super().__init__(receiving)
        self._framing = framing
        self._limit = limit

    @property
    def busy(self) -> bool:
        return bool(self._buffer) or self._in_junk

    def _take(self) -> bool:
        end = self._framing.end
        position = self._buffer.find(end)
        size = len(self._buffer) if position < 0 else position
        if size > self._limit and not self._in_junk:
            self._add(self._overlong())
            self._in_junk = True
        if position < 0:
            self._drop(size - len(end) + 1 if size > self._limit else 0)
            return False
        text = bytes(self._buffer[:size])
        self._drop(size + len(end))
        for body in () if self._in_junk else self._framing.bodies(text):
            if isinstance(body, LinkFault):
                self._add(body)
            else:
                self._add(
                    self._overlong()
                    if len(body) > self._receiving.max_size
                    else self._receiving.interpret(body)
                )
        self._in_junk = False
        return True

    def _incomplete(self) -> LinkFault | None:
        return None if self._in_junk else self._without_end(len(self._buffer))


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
        self.doubled = self.escape * 2
        self.starts = bytes(starts) or self.start[1:]
        self.first_is_id = first_is_id

    def encode(self, body: bytes) -> bytes:
        """Return start, the body with its escape bytes doubled, and end."""
        return self.start + body.replace(self.escape, self.doubled) + self.end

    def deframer(self, receiving: Receiving[_Message]) -> Deframer[_Message]:
        """Return a deframer that ignores bytes between messages."""
        return _EscapedDeframer(receiving, self)


class _EscapedDeframer(_Collector[_Message]):
    """Finds bodies between starts and ends.

    An escape byte alone is kept until the next byte, and no message: `busy` is False.
    """

    def __init__(self, receiving: Receiving[_Message], framing: Escaped) -> None:
        super().__init__(receiving)
        self._framing = framing
        escape, doubled = re.escape(framing.escape), re.escape(framing.doubled)
        self._start = _start_pattern(framing.escape, b"[%b]" % re.escape(framing.starts))
        single = b"(?:%b[^%b])?" % (escape, re.escape(framing.starts + framing.end))
        text = b"[^%b]*(?:%b[^%b]*)*" % (escape, doubled, escape)
        self._text = re.compile(single + text if framing.first_is_id else text)
        """Bytes of a message up to an escape byte that is not doubled."""

    @property
    def busy(self) -> bool:
        return len(self._buffer) > 1

    def _read_text(self) -> tuple[bytes, int]:
        """Return the body as far as it has arrived, and its size on the line."""
        found = self._text.match(self._buffer, 2)
        text = b"" if found is None else found[0]
        return text.replace(self._framing.doubled, self._framing.escape), len(text)

    def _take(self) -> bool:
        if not self._find_start(self._start):
            return False
        self._in_junk = False
        framing = self._framing
        body, size = self._read_text()
        start, after = self._buffer[1:2], self._buffer[size + 3 : size + 4]
        if len(body) > self._receiving.max_size:
            beginning = body[: self._receiving.max_size + 1].replace(framing.escape, framing.doubled)
            self._drop(2 + min(size, len(beginning)))
            self._add(self._overlong())
            self._in_junk = True
        elif not after:
            return False
        elif after in framing.starts:
            self._drop(size + 2)
            text = f"message of {len(body)} bytes interrupted by the start of another"
            self._fault(FaultKind.UART_INCOMPLETE, text)
        elif after != framing.end[1:]:
            self._drop(size + 4)
            text = f"byte {after.hex().upper()} after an escape byte within a message"
            self._fault(FaultKind.UART_PROTOCOL, text)
            self._in_junk = True
        elif not body:
            self._drop(size + 4)
            self._fault(FaultKind.UART_PROTOCOL, "message without an ID")
        else:
            self._drop(size + 4)
            self._add(self._receiving.interpret(bytes(start) + body if len(framing.start) == 1 else body))
        return True

    def _incomplete(self) -> LinkFault | None:
        if self.busy:
            return self._without_end(len(self._read_text()[0]))
        text = f"escape byte {self._framing.escape.hex().upper()} outside a message"
        return None if self._in_junk else LinkFault(FaultKind.UART_PROTOCOL, text)


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
        self._framing = framing
        self._start = _start_pattern(framing.start[:-1], re.escape(framing.start[-1:]))

    @property
    def busy(self) -> bool:
        return bool(self._buffer) or (self._in_junk and not self._framing.start)

    def _take(self) -> bool:
        head, end = len(self._framing.start), self._framing.end
        if self._in_junk and not head:
            self._buffer.clear()
        if not self._buffer or not self._find_start(self._start):
            return False
        body, ends = self._framing.stuffing.decode(bytes(self._buffer[head:]))
        try:
            size = self._receiving.measure(body)
        except BodySizeError as error:
            return self._reject(LinkFault(FaultKind.UART_PROTOCOL, str(error)), head)
        if (len(body) if size is None else size) > self._receiving.max_size:
            return self._reject(self._overlong(), head)
        if size is None or len(body) < size:
            return False
        last = head + (ends[size - 1] if size else 0)
        whole = last + len(end)
        if len(self._buffer) < whole:
            return False
        end_bytes = bytes(self._buffer[last:whole])
        if end_bytes != end:
            text = f"{end_bytes.hex(' ').upper()} instead of the end of a message"
            return self._reject(LinkFault(FaultKind.UART_PROTOCOL, text), whole)
        result = self._receiving.interpret(body[:size])
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
        self._drop(1 if self._framing.start else len(self._buffer))
        return True

    def _incomplete(self) -> LinkFault | None:
        return None if self._reported > 0 else self._without_end(len(self._buffer))


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


class _PluginFraming(Framing):
    """A framing of a plugin, whose failures are raised as an IcdError of one line."""

    def __init__(self, name: str, framing: object) -> None:
        if not isinstance(framing, Framing):
            raise IcdError(
                f"framing {name} must be a class derived from starhil.protocol.serial.framings.Framing"
            )
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
