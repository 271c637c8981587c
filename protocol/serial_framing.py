"""Serial framing of the CubeSpace family: `1F 7F <id> <data> 1F FF` with 0x1F doubled, as sans-I/O state machines.

Three forms of reply are in use, all public: dialect a (CubeComputer: the reply carries the id), b (stand-alone
CubeSense node: it does not) and c (generation 2: start bytes tell acknowledge, refusal, event and unsolicited
telemetry apart).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, StrEnum, auto
from typing import Final

from starhil.protocol.errors import ProtocolError
from starhil.protocol.messages import (
    BURST_ID,
    FIRST_TELEMETRY_ID,
    FaultKind,
    LinkFault,
    Reply,
    ReplyKind,
    Request,
    RequestKind,
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

DEFAULT_MAX_SIZE: Final = 512
"""Longest message (id and data) that a receiver takes, as the published host library's buffer."""

DEFAULT_TIMEOUT_S: Final = 0.5
"""Silence within a message after which it is given up."""


class Dialect(StrEnum):
    """Form of serial replies."""

    A = "a"
    B = "b"
    C = "c"

    @property
    def supports_unsolicited(self) -> bool:
        """Whether the dialect can tell unsolicited telemetry and events from replies."""
        return self is Dialect.C


class _State(Enum):
    IDLE = auto()
    """Outside a message."""
    IDLE_ESCAPED = auto()
    """Outside a message, after an escape byte."""
    FIRST = auto()
    """At the first byte after the start: the id, where there is one."""
    FIRST_ESCAPED = auto()
    """After an escape byte in place of the id."""
    BODY = auto()
    BODY_ESCAPED = auto()


@dataclass(frozen=True, slots=True)
class Packet:
    """What stands between start and end, with the stuffing taken out."""

    start: int
    """Start byte: 7F, or 07, 0F, 2F, 4F in dialect c."""
    body: bytes


class Deframer:
    """Find packets in a stream of bytes, however it is cut; junk becomes faults, one for each run of it.

    A run of junk ends with the next start of a message or with a silence of the time-out. An id of 0x1F is ambiguous
    in the field: some senders double it, others do not. Both are read as id 0x1F as long as a start or end cannot be
    meant.
    """

    def __init__(
        self,
        starts: frozenset[int],
        *,
        first_is_id: bool,
        max_size: int = DEFAULT_MAX_SIZE,
        timeout_s: float = DEFAULT_TIMEOUT_S,
    ) -> None:
        if max_size < 1 or timeout_s <= 0:
            raise ProtocolError(f"receiver limits {max_size} bytes, {timeout_s} s must be positive")
        self._starts = starts
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
        """Whether a message has begun and not ended."""
        return self._state not in (_State.IDLE, _State.IDLE_ESCAPED)

    def feed(self, data: bytes, now: float) -> list[Packet | LinkFault]:
        """Take bytes that arrived at time `now` (s, any origin) and return what they complete."""
        self._events = list(self.flush(now))
        if data:
            self._last_time = now
        position = 0
        while position < len(data):
            position = self._advance(data, position)
        return self._events

    def flush(self, now: float) -> list[LinkFault]:
        """Give up a message that has been silent for the time-out."""
        if now - self._last_time < self._timeout_s:
            return []
        state, in_junk, size = self._state, self._in_junk, len(self._body)
        self._reset(in_junk=False)
        if state is _State.IDLE:
            return []
        if state is _State.IDLE_ESCAPED:
            return [] if in_junk else [LinkFault(FaultKind.UART_PROTOCOL, "escape byte 1F outside a message")]
        text = f"message of {size} bytes without end after {self._timeout_s:g} s of silence"
        return [LinkFault(FaultKind.UART_INCOMPLETE, text)]

    def _advance(self, data: bytes, position: int) -> int:
        """Take one byte, or all up to the next escape byte; return the position after it."""
        match self._state:
            case _State.IDLE | _State.BODY:
                escape = data.find(ESCAPE, position)
                end = len(data) if escape < 0 else escape
                if end > position:
                    self._take(data[position:end])
                    return end
                self._state = _State.BODY_ESCAPED if self.busy else _State.IDLE_ESCAPED
            case _State.FIRST:
                if data[position] == ESCAPE:
                    self._state = _State.FIRST_ESCAPED if self._first_is_id else _State.BODY_ESCAPED
                else:
                    self._state = _State.BODY
                    self._take(data[position : position + 1])
            case _State.IDLE_ESCAPED:
                self._after_idle_escape(data[position])
            case _State.FIRST_ESCAPED:
                self._after_first_escape(data[position])
            case _State.BODY_ESCAPED:
                self._after_body_escape(data[position])
        return position + 1

    def _take(self, run: bytes) -> None:
        """Take bytes that are neither escape bytes nor escaped."""
        if self.busy:
            self._body += run
            if len(self._body) > self._max_size:
                self._give_up(FaultKind.UART_OVERLONG, f"message longer than {self._max_size} bytes")
        else:
            self._junk(run[0])

    def _after_idle_escape(self, byte: int) -> None:
        if byte in self._starts:
            self._open(byte)
            return
        self._junk(ESCAPE)
        if byte != ESCAPE:
            self._state = _State.IDLE

    def _after_first_escape(self, byte: int) -> None:
        if byte == END or byte in self._starts:
            self._after_body_escape(byte)
            return
        self._state = _State.BODY
        self._take(bytes((ESCAPE,) if byte == ESCAPE else (ESCAPE, byte)))

    def _after_body_escape(self, byte: int) -> None:
        self._state = _State.BODY
        if byte == ESCAPE:
            self._take(bytes((ESCAPE,)))
        elif byte == END:
            body = bytes(self._body)
            self._reset(in_junk=False)
            if body:
                self._events.append(Packet(self._start, body))
            else:
                self._events.append(LinkFault(FaultKind.UART_PROTOCOL, "message without an id"))
        elif byte in self._starts:
            text = f"message of {len(self._body)} bytes cut off by the start of another"
            self._events.append(LinkFault(FaultKind.UART_INCOMPLETE, text))
            self._open(byte)
        else:
            self._give_up(FaultKind.UART_PROTOCOL, f"byte {byte:02X} after an escape byte within a message")

    def _open(self, start: int) -> None:
        self._reset(in_junk=False)
        self._state = _State.FIRST
        self._start = start

    def _reset(self, *, in_junk: bool) -> None:
        self._state = _State.IDLE
        self._in_junk = in_junk
        self._body.clear()

    def _give_up(self, kind: FaultKind, text: str) -> None:
        """Drop the message; what is left of it counts as the same run of junk."""
        self._events.append(LinkFault(kind, text))
        self._reset(in_junk=True)

    def _junk(self, byte: int) -> None:
        if not self._in_junk:
            self._events.append(LinkFault(FaultKind.UART_PROTOCOL, f"byte {byte:02X} outside a message"))
        self._in_junk = True


def stuff(data: bytes) -> bytes:
    """Double every escape byte."""
    return data.replace(b"\x1f", b"\x1f\x1f")


def encode_packet(start: int, body: bytes) -> bytes:
    """Frame a body with the given start byte."""
    return bytes((ESCAPE, start)) + stuff(body) + bytes((ESCAPE, END))


def encode_request(request: Request, *, stuff_id: bool = True) -> bytes:
    """Frame a telecommand or telemetry request as an OBC sends it, the same in all dialects.

    Without `stuff_id` an id of 0x1F goes out single, as some flight software sends it.
    """
    if stuff_id:
        return encode_packet(START, bytes((request.id,)) + request.data)
    return bytes((ESCAPE, START, request.id)) + stuff(request.data) + bytes((ESCAPE, END))


def encode_reply(reply: Reply, dialect: Dialect) -> bytes:
    """Frame a device's reply in the given dialect.

    A refused telemetry request is answered by the bare error code where telemetry would stand; no public source
    shows generation 1's form, so that one is ours. Burst packets have one form in all dialects.

    Raises
    ------
    ProtocolError
        The dialect cannot carry the reply (unsolicited telemetry and events exist in dialect c only).
    """
    if reply.kind is ReplyKind.BURST:
        return encode_packet(START, bytes((BURST_ID,)) + reply.data)
    if dialect is Dialect.C:
        return _encode_generation_2(reply)
    if reply.kind in (ReplyKind.UNSOLICITED, ReplyKind.EVENT):
        raise ProtocolError(f"serial dialect {dialect} has no {reply.kind.value} messages; use dialect c")
    body = reply.data if reply.kind is ReplyKind.TELEMETRY else bytes((int(reply.code),))
    if dialect is Dialect.A:
        body = bytes((_need_id(reply),)) + body
    return encode_packet(START, body)


def _encode_generation_2(reply: Reply) -> bytes:
    start, data = {
        ReplyKind.ACK: (START_ACK, b""),
        ReplyKind.NACK: (START_NACK, bytes((int(reply.code),))),
        ReplyKind.TELEMETRY: (START_ACK, reply.data),
        ReplyKind.UNSOLICITED: (START_UNSOLICITED, reply.data),
        ReplyKind.EVENT: (START_EVENT, reply.data),
    }[reply.kind]
    return encode_packet(start, bytes((_need_id(reply),)) + data)


def _need_id(reply: Reply) -> int:
    if reply.id is None:
        raise ProtocolError(f"a {reply.kind.value} in this serial dialect needs an id")
    return reply.id


class DeviceReceiver:
    """The device's end: bytes in, requests and faults out."""

    def __init__(self, *, max_size: int = DEFAULT_MAX_SIZE, timeout_s: float = DEFAULT_TIMEOUT_S) -> None:
        self._deframer = Deframer(
            frozenset((START,)), first_is_id=True, max_size=max_size, timeout_s=timeout_s
        )

    @property
    def busy(self) -> bool:
        """Whether a message has begun and not ended, so that `flush` may be due."""
        return self._deframer.busy

    def feed(self, data: bytes, now: float) -> list[Request | LinkFault]:
        """Take bytes that arrived at time `now` (s, any origin) and return what they complete."""
        return [
            event if isinstance(event, LinkFault) else Request.of(event.body[0], event.body[1:])
            for event in self._deframer.feed(data, now)
        ]

    def flush(self, now: float) -> list[LinkFault]:
        """Give up a message that has been silent for the time-out."""
        return self._deframer.flush(now)


class HostReceiver:
    """The OBC's end: bytes in, replies and faults out, in one dialect.

    Dialects a and b do not say what a message is: `expect` tells it before a request is sent.
    """

    def __init__(
        self, dialect: Dialect, *, max_size: int = DEFAULT_MAX_SIZE, timeout_s: float = DEFAULT_TIMEOUT_S
    ) -> None:
        starts = {START}
        if dialect is Dialect.C:
            starts |= {START_ACK, START_NACK, START_EVENT, START_UNSOLICITED}
        self._dialect = dialect
        self._deframer = Deframer(
            frozenset(starts),
            first_is_id=dialect is not Dialect.B,
            max_size=max_size,
            timeout_s=timeout_s,
        )
        self._expected: tuple[Request, int] | None = None

    def expect(self, request: Request, reply_size: int) -> None:
        """Tell what is asked next, and how many bytes of data its telemetry has (0 for a telecommand)."""
        self._expected = (request, reply_size)

    def feed(self, data: bytes, now: float) -> list[Reply | LinkFault]:
        """Take bytes that arrived at time `now` (s, any origin) and return what they complete."""
        return [
            event if isinstance(event, LinkFault) else self._reply(event)
            for event in self._deframer.feed(data, now)
        ]

    def flush(self, now: float) -> list[LinkFault]:
        """Give up a message that has been silent for the time-out."""
        return self._deframer.flush(now)

    def _reply(self, packet: Packet) -> Reply | LinkFault:
        if self._dialect is Dialect.C:
            return self._generation_2(packet)
        body = packet.body
        if self._is_burst(body):
            return Reply(ReplyKind.BURST, BURST_ID, body[1:])
        if self._dialect is Dialect.A:
            expected = self._expected
            size = expected[1] if expected is not None and expected[0].id == body[0] else None
            return self._named(body[0], body[1:], size)
        if self._expected is None:
            return LinkFault(FaultKind.UART_PROTOCOL, f"reply of {len(body)} bytes to no request")
        request, size = self._expected
        return self._named(request.id, body, size)

    def _is_burst(self, body: bytes) -> bool:
        if len(body) != BURST_SIZE + 1 or body[0] != BURST_ID:
            return False
        if self._dialect is Dialect.A or self._expected is None:
            return True
        request, size = self._expected
        return request.kind is RequestKind.TELECOMMAND or size != len(body)

    def _named(self, identifier: int, data: bytes, size: int | None) -> Reply | LinkFault:
        """Read a generation 1 reply by its id; `size` is that of the telemetry row where it is known."""
        if identifier >= FIRST_TELEMETRY_ID:
            self._expected = None
            if len(data) == 1 and size not in (None, 1):
                return Reply(ReplyKind.NACK, identifier, code=error_code(data[0]))
            return Reply(ReplyKind.TELEMETRY, identifier, data)
        if len(data) != 1:
            return LinkFault(
                FaultKind.UART_PROTOCOL,
                f"acknowledge of telecommand {identifier} has {len(data)} bytes, must be 1",
            )
        self._expected = None
        code = error_code(data[0])
        return Reply(ReplyKind.NACK if code else ReplyKind.ACK, identifier, code=code)

    def _generation_2(self, packet: Packet) -> Reply | LinkFault:
        identifier, data = packet.body[0], packet.body[1:]
        match packet.start:
            case 0x07:
                if identifier >= FIRST_TELEMETRY_ID:
                    return Reply(ReplyKind.TELEMETRY, identifier, data)
                return Reply(ReplyKind.ACK, identifier, data)
            case 0x0F:
                if len(data) != 1:
                    return LinkFault(
                        FaultKind.UART_PROTOCOL, f"refusal of {identifier} has {len(data)} bytes, must be 1"
                    )
                return Reply(ReplyKind.NACK, identifier, code=error_code(data[0]))
            case 0x2F:
                return Reply(ReplyKind.EVENT, identifier, data)
            case 0x4F:
                return Reply(ReplyKind.UNSOLICITED, identifier, data)
            case _:
                if identifier == BURST_ID and len(data) == BURST_SIZE:
                    return Reply(ReplyKind.BURST, identifier, data)
                return LinkFault(
                    FaultKind.UART_PROTOCOL, f"message {identifier} with the start byte of a request"
                )


class PacingSchedule:
    """When bytes leave a serial line: one after another at its bit rate."""

    def __init__(self, baud: int, bits_per_byte: int = 10) -> None:
        if baud <= 0 or bits_per_byte <= 0:
            raise ProtocolError(f"baud rate {baud} and {bits_per_byte} bits a byte must be positive")
        self.seconds_per_byte: Final = bits_per_byte / baud
        """Time that one byte takes on the line."""
        self._free_at = float("-inf")

    def reserve(self, now: float, size: int) -> tuple[float, float]:
        """Put `size` bytes on the line at the earliest; return when the first begins and the last has left."""
        begin = max(now, self._free_at)
        self._free_at = begin + size * self.seconds_per_byte
        return begin, self._free_at

    def release(self) -> None:
        """Free the line at once: what was reserved will not be sent."""
        self._free_at = float("-inf")

    def free_at(self, now: float) -> float:
        """Return when the line is free, not before `now`."""
        return max(now, self._free_at)
