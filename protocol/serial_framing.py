"""Serial framing of the CubeSpace family: `1F 7F <id> <data> 1F FF` with 0x1F doubled, as a sans-I/O state machine.

Replies have three public dialects: a (CubeComputer: with ID), b (stand-alone CubeSense node: without ID) and
c (generation 2: the start byte distinguishes ACK, NACK, event and unsolicited telemetry).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from enum import Enum, StrEnum, auto
from typing import Final, Generic, TypeVar

from starhil.protocol.errors import ProtocolError
from starhil.protocol.messages import (
    BURST_ID,
    DEFAULT_MAX_SIZE,
    DEFAULT_TIMEOUT_S,
    FIRST_TELEMETRY_ID,
    FaultKind,
    LinkFault,
    Reply,
    ReplyKind,
    Request,
    RequestKind,
    check_receiver_limits,
    error_code,
)

ESCAPE: Final = 0x1F
END: Final = 0xFF
START: Final = 0x7F
START_ACK: Final = 0x07
START_NACK: Final = 0x0F
START_EVENT: Final = 0x2F
START_UNSOLICITED: Final = 0x4F

BURST_SIZE: Final = 22
"""Bytes of a burst packet: its number (u16) and 20 bytes of the file."""


class Dialect(StrEnum):
    """Formats of serial replies."""

    A = "a"
    B = "b"
    C = "c"

    @property
    def supports_unsolicited(self) -> bool:
        """Whether the dialect has unsolicited telemetry and events."""
        return self is Dialect.C


class _State(Enum):
    IDLE = auto()
    """Outside a message."""
    IDLE_ESCAPED = auto()
    """Outside a message, after an escape byte."""
    FIRST = auto()
    """At the first byte after the start: the ID, if the message has one."""
    FIRST_ESCAPED = auto()
    """After an escape byte at the position of the ID."""
    BODY = auto()
    BODY_ESCAPED = auto()


@dataclass(frozen=True, slots=True)
class Packet:
    """The content of a message between start and end, unstuffed."""

    start: int
    """Start byte: 7F, or 07, 0F, 2F, 4F in dialect c."""
    body: bytes


class Deframer:
    """Finds packets in a stream of bytes; each run of junk yields one fault.

    A run of junk ends at the next start of a message or after a silence of the timeout. An ID of 0x1F is
    ambiguous in practice: some senders double it, others do not. Both forms are read as ID 0x1F, unless the
    bytes are a start or an end.
    """

    def __init__(
        self,
        starts: frozenset[int],
        *,
        first_is_id: bool,
        max_size: int = DEFAULT_MAX_SIZE,
        timeout_s: float = DEFAULT_TIMEOUT_S,
        escape: int = ESCAPE,
        end: int = END,
    ) -> None:
        check_receiver_limits(max_size, timeout_s)
        self._starts = starts
        self._escape = escape
        self._end = end
        self._first_is_id = first_is_id
        self._max_size = max_size
        self._timeout_s = timeout_s
        self._state = _State.IDLE
        self._start = START
        self._body = bytearray()
        self._in_junk = False
        self._last_time = float("-inf")
        self._events: list[Packet | LinkFault] = []

    @property
    def busy(self) -> bool:
        """Whether a message is incomplete."""
        return self._state not in (_State.IDLE, _State.IDLE_ESCAPED)

    def feed(self, data: bytes, now: float) -> list[Packet | LinkFault]:
        """Return the messages and faults that these bytes complete; `now` is the time of arrival, s."""
        self._events = list(self.flush(now))
        if data:
            self._last_time = now
        position = 0
        while position < len(data):
            position = self._advance(data, position)
        return self._events

    def flush(self, now: float) -> list[LinkFault]:
        """Abandon an incomplete message after a silence of the timeout."""
        if now - self._last_time < self._timeout_s:
            return []
        state, in_junk, size = self._state, self._in_junk, len(self._body)
        self._reset(in_junk=False)
        if state is _State.IDLE:
            return []
        if state is _State.IDLE_ESCAPED:
            return (
                []
                if in_junk
                else [LinkFault(FaultKind.UART_PROTOCOL, f"escape byte {self._escape:02X} outside a message")]
            )
        text = f"message of {size} bytes without end after {self._timeout_s:g} s of silence"
        return [LinkFault(FaultKind.UART_INCOMPLETE, text)]

    def _advance(self, data: bytes, position: int) -> int:
        """Process one byte, or all up to the next escape byte; return the position after it."""
        match self._state:
            case _State.IDLE | _State.BODY:
                escape = data.find(self._escape, position)
                end = len(data) if escape < 0 else escape
                if end > position:
                    self._add_plain_bytes(data[position:end])
                    return end
                self._state = _State.BODY_ESCAPED if self.busy else _State.IDLE_ESCAPED
            case _State.FIRST:
                if data[position] == self._escape:
                    self._state = _State.FIRST_ESCAPED if self._first_is_id else _State.BODY_ESCAPED
                else:
                    self._state = _State.BODY
                    self._add_plain_bytes(data[position : position + 1])
            case _State.IDLE_ESCAPED:
                self._after_idle_escape(data[position])
            case _State.FIRST_ESCAPED:
                self._after_first_escape(data[position])
            case _State.BODY_ESCAPED:
                self._after_body_escape(data[position])
        return position + 1

    def _add_plain_bytes(self, run: bytes) -> None:
        """Add bytes that are neither escape bytes nor escaped."""
        if self.busy:
            self._body += run
            if len(self._body) > self._max_size:
                self._abandon(FaultKind.UART_OVERLONG, f"message longer than {self._max_size} bytes")
        else:
            self._report_junk(run[0])

    def _after_idle_escape(self, byte: int) -> None:
        if byte in self._starts:
            self._start_message(byte)
            return
        self._report_junk(self._escape)
        if byte != self._escape:
            self._state = _State.IDLE

    def _after_first_escape(self, byte: int) -> None:
        if byte == self._end or byte in self._starts:
            self._after_body_escape(byte)
            return
        self._state = _State.BODY
        self._add_plain_bytes(bytes((self._escape,) if byte == self._escape else (self._escape, byte)))

    def _after_body_escape(self, byte: int) -> None:
        self._state = _State.BODY
        if byte == self._escape:
            self._add_plain_bytes(bytes((self._escape,)))
        elif byte == self._end:
            body = bytes(self._body)
            self._reset(in_junk=False)
            if body:
                self._events.append(Packet(self._start, body))
            else:
                self._events.append(LinkFault(FaultKind.UART_PROTOCOL, "message without an ID"))
        elif byte in self._starts:
            text = f"message of {len(self._body)} bytes interrupted by the start of another"
            self._events.append(LinkFault(FaultKind.UART_INCOMPLETE, text))
            self._start_message(byte)
        else:
            self._abandon(FaultKind.UART_PROTOCOL, f"byte {byte:02X} after an escape byte within a message")

    def _start_message(self, start: int) -> None:
        self._reset(in_junk=False)
        self._state = _State.FIRST
        self._start = start

    def _reset(self, *, in_junk: bool) -> None:
        self._state = _State.IDLE
        self._in_junk = in_junk
        self._body.clear()

    def _abandon(self, kind: FaultKind, text: str) -> None:
        """Drop the message; its remaining bytes belong to the same run of junk."""
        self._events.append(LinkFault(kind, text))
        self._reset(in_junk=True)

    def _report_junk(self, byte: int) -> None:
        if not self._in_junk:
            self._events.append(LinkFault(FaultKind.UART_PROTOCOL, f"byte {byte:02X} outside a message"))
        self._in_junk = True


def stuff(data: bytes) -> bytes:
    """Double every escape byte."""
    return data.replace(b"\x1f", b"\x1f\x1f")


def encode_packet(start: int, body: bytes) -> bytes:
    """Frame a body with this start byte."""
    return bytes((ESCAPE, start)) + stuff(body) + bytes((ESCAPE, END))


def encode_request(request: Request, *, stuff_id: bool = True) -> bytes:
    """Frame a telecommand or telemetry request as an OBC sends it, the same in all dialects.

    Without `stuff_id`, an ID of 0x1F is not doubled, as in some flight software.
    """
    if stuff_id:
        return encode_packet(START, bytes((request.id,)) + request.data)
    return bytes((ESCAPE, START, request.id)) + stuff(request.data) + bytes((ESCAPE, END))


def encode_reply(reply: Reply, dialect: Dialect) -> bytes:
    """Frame a reply of a device in a dialect.

    In dialects a and b, the NACK of a telemetry request has the error code instead of the telemetry; this is
    our own choice, because no public source shows this case. Burst packets are the same in all dialects.

    Raises
    ------
    ProtocolError
        The dialect cannot carry the reply (unsolicited telemetry and events exist in dialect c only, echoes
        in none).
    """
    if reply.kind is ReplyKind.ECHO:
        raise ProtocolError(f"serial dialect {dialect} has no echo messages")
    if reply.kind is ReplyKind.BURST:
        return encode_packet(START, bytes((BURST_ID,)) + reply.data)
    if dialect is Dialect.C:
        return _encode_generation_2(reply)
    if reply.kind in (ReplyKind.UNSOLICITED, ReplyKind.EVENT):
        raise ProtocolError(f"serial dialect {dialect} has no {reply.kind.value} messages; use dialect c")
    body = reply.data if reply.kind is ReplyKind.TELEMETRY else bytes((int(reply.code),))
    if dialect is Dialect.A:
        body = bytes((_require_id(reply),)) + body
    return encode_packet(START, body)


def _encode_generation_2(reply: Reply) -> bytes:
    start, data = {
        ReplyKind.ACK: (START_ACK, b""),
        ReplyKind.NACK: (START_NACK, bytes((int(reply.code),))),
        ReplyKind.TELEMETRY: (START_ACK, reply.data),
        ReplyKind.UNSOLICITED: (START_UNSOLICITED, reply.data),
        ReplyKind.EVENT: (START_EVENT, reply.data),
    }[reply.kind]
    return encode_packet(start, bytes((_require_id(reply),)) + data)


def _require_id(reply: Reply) -> int:
    if reply.id is None:
        raise ProtocolError(f"a {reply.kind.value} in this serial dialect needs an ID")
    return reply.id


_Message = TypeVar("_Message", Request, Reply)


class _Receiver(ABC, Generic[_Message]):
    """Base of both ends: bytes in, messages and faults out."""

    def __init__(self, deframer: Deframer) -> None:
        self._deframer = deframer

    @property
    def busy(self) -> bool:
        """Whether a message is incomplete, so that `flush` may become due."""
        return self._deframer.busy

    def feed(self, data: bytes, now: float) -> list[_Message | LinkFault]:
        """Return the messages and faults that these bytes complete; `now` is the time of arrival, s."""
        return [
            event if isinstance(event, LinkFault) else self._interpret(event)
            for event in self._deframer.feed(data, now)
        ]

    def flush(self, now: float) -> list[LinkFault]:
        """Abandon an incomplete message after a silence of the timeout."""
        return self._deframer.flush(now)

    @abstractmethod
    def _interpret(self, packet: Packet) -> _Message | LinkFault:
        """Return the message in a packet, or its fault."""


class DeviceReceiver(_Receiver[Request]):
    """The device's end: bytes in, requests and faults out."""

    def __init__(self, *, max_size: int = DEFAULT_MAX_SIZE, timeout_s: float = DEFAULT_TIMEOUT_S) -> None:
        starts = frozenset((START,))
        super().__init__(Deframer(starts, first_is_id=True, max_size=max_size, timeout_s=timeout_s))

    def _interpret(self, packet: Packet) -> Request:
        return Request.of(packet.body[0], packet.body[1:])


class HostReceiver(_Receiver[Reply]):
    """The OBC's end: bytes in, replies and faults out, in one dialect.

    In dialects a and b, replies cannot be interpreted alone: call `expect` before each request.
    """

    def __init__(
        self, dialect: Dialect, *, max_size: int = DEFAULT_MAX_SIZE, timeout_s: float = DEFAULT_TIMEOUT_S
    ) -> None:
        starts = {START}
        if dialect is Dialect.C:
            starts |= {START_ACK, START_NACK, START_EVENT, START_UNSOLICITED}
        self._dialect = dialect
        first_is_id = dialect is not Dialect.B
        super().__init__(
            Deframer(frozenset(starts), first_is_id=first_is_id, max_size=max_size, timeout_s=timeout_s)
        )
        self._expected: tuple[Request, int] | None = None

    def expect(self, request: Request, reply_size: int) -> None:
        """Set the next request, and the data size of its telemetry in bytes (0 for a telecommand)."""
        self._expected = (request, reply_size)

    def _interpret(self, packet: Packet) -> Reply | LinkFault:
        if self._dialect is Dialect.C:
            return self._interpret_generation_2(packet)
        body = packet.body
        if self._is_burst(body):
            return Reply(ReplyKind.BURST, BURST_ID, body[1:])
        if self._dialect is Dialect.A:
            expected = self._expected
            size = expected[1] if expected is not None and expected[0].id == body[0] else None
            return self._interpret_generation_1(body[0], body[1:], size)
        if self._expected is None:
            return LinkFault(FaultKind.UART_PROTOCOL, f"reply of {len(body)} bytes without a request")
        request, size = self._expected
        return self._interpret_generation_1(request.id, body, size)

    def _is_burst(self, body: bytes) -> bool:
        if len(body) != BURST_SIZE + 1 or body[0] != BURST_ID:
            return False
        if self._dialect is Dialect.A or self._expected is None:
            return True
        request, size = self._expected
        return request.kind is RequestKind.TELECOMMAND or size != len(body)

    def _interpret_generation_1(self, row_id: int, data: bytes, size: int | None) -> Reply | LinkFault:
        """Interpret a reply of generation 1; `size` is the size of the telemetry row, if known."""
        if row_id >= FIRST_TELEMETRY_ID:
            self._expected = None
            if len(data) == 1 and size not in (None, 1):
                return Reply(ReplyKind.NACK, row_id, code=error_code(data[0]))
            return Reply(ReplyKind.TELEMETRY, row_id, data)
        if len(data) != 1:
            return LinkFault(
                FaultKind.UART_PROTOCOL, f"ACK of telecommand {row_id} has {len(data)} bytes, must be 1"
            )
        self._expected = None
        code = error_code(data[0])
        return Reply(ReplyKind.NACK if code else ReplyKind.ACK, row_id, code=code)

    def _interpret_generation_2(self, packet: Packet) -> Reply | LinkFault:
        row_id, data = packet.body[0], packet.body[1:]
        match packet.start:
            case 0x07:
                kind = ReplyKind.TELEMETRY if row_id >= FIRST_TELEMETRY_ID else ReplyKind.ACK
                return Reply(kind, row_id, data)
            case 0x0F:
                if len(data) != 1:
                    return LinkFault(
                        FaultKind.UART_PROTOCOL, f"NACK of {row_id} has {len(data)} bytes, must be 1"
                    )
                return Reply(ReplyKind.NACK, row_id, code=error_code(data[0]))
            case 0x2F:
                return Reply(ReplyKind.EVENT, row_id, data)
            case 0x4F:
                return Reply(ReplyKind.UNSOLICITED, row_id, data)
            case _:
                if row_id == BURST_ID and len(data) == BURST_SIZE:
                    return Reply(ReplyKind.BURST, row_id, data)
                return LinkFault(
                    FaultKind.UART_PROTOCOL, f"message {row_id} with the start byte of a request"
                )


class PacingSchedule:
    """Schedule of bytes on a serial line at its bit rate."""

    def __init__(self, baud: int, bits_per_byte: int = 10) -> None:
        if baud <= 0 or bits_per_byte <= 0:
            raise ProtocolError(f"baud rate {baud} and {bits_per_byte} bits per byte must be positive")
        self.seconds_per_byte: Final = bits_per_byte / baud
        """Time that one byte takes on the line."""
        self._free_at = float("-inf")

    def reserve(self, now: float, size: int) -> tuple[float, float]:
        """Reserve the line for `size` bytes.

        Returns the times at which the first byte begins and the last one ends.
        """
        begin = max(now, self._free_at)
        self._free_at = begin + size * self.seconds_per_byte
        return begin, self._free_at

    def release(self) -> None:
        """Free the line: the reserved bytes are not sent."""
        self._free_at = float("-inf")
