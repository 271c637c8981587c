"""CAN framing of the CubeSpace family: 29-bit CAN IDs and segments that count down, as sans-I/O receivers.

::

    CAN ID     type [28:24]  row ID [23:16]  source [15:8]  destination [7:0]      `CAN_ID`
    one frame  up to 8 bytes of data
    segment    7 bytes of data, fewer in the last one, then the number of remaining segments

A message of up to 8 bytes is one frame, a longer one is segmented. Its type gives the kind of message and whether it
is a segment (`REQUEST_TYPES`, `REPLY_TYPES`). The CAN ID is packed by shifts because this is done for every frame:
shifts take 3 µs to build and 7 µs to parse an ID, a `construct.BitStruct` 78 µs and 15 µs.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Final, TypeVar

from starhil.protocol.can.frame import MAX_FRAME_DATA, CanFrame
from starhil.protocol.errors import ProtocolError
from starhil.protocol.messages import (
    BURST_ID,
    DEFAULT_MAX_SIZE,
    DEFAULT_TIMEOUT_S,
    FaultKind,
    Flaw,
    LinkFault,
    Receiver,
    Reply,
    ReplyKind,
    Request,
    RequestKind,
    error_code,
)

Message = TypeVar("Message")

SEGMENT_DATA: Final = 7
MAX_MESSAGE: Final = 256 * SEGMENT_DATA
"""Longest message that the segment counter allows."""

MAX_OPEN_MESSAGES: Final = 32
"""Maximum number of incomplete messages in a receiver; one more replaces the oldest."""


class MessageType(IntEnum):
    """Message types: bits 28 to 24 of the CAN ID."""

    NONE = 0
    TELECOMMAND = 1
    TELECOMMAND_ACK = 2
    TELECOMMAND_NACK = 3
    TELEMETRY_REQUEST = 4
    TELEMETRY = 5
    TELEMETRY_NACK = 6
    TELECOMMAND_EXTENDED = 7
    TELEMETRY_EXTENDED = 8
    EVENT = 9
    UNSOLICITED_FIRST = 10
    UNSOLICITED_BODY = 11
    UNSOLICITED_LAST = 12


CAN_ID: Final = (("type", 24, 0x1F), ("id", 16, 0xFF), ("source", 8, 0xFF), ("destination", 0, 0xFF))
"""The parts of a CAN ID: name, lowest bit, highest value."""

REQUEST_TYPES: Final = {
    RequestKind.TELECOMMAND: (MessageType.TELECOMMAND, MessageType.TELECOMMAND_EXTENDED),
    RequestKind.TELEMETRY: (MessageType.TELEMETRY_REQUEST, MessageType.TELEMETRY_REQUEST),
}
"""Kind of request → its type in one frame and in segments."""

REQUEST_KINDS: Final[Mapping[int, RequestKind]] = {
    number: kind for kind, numbers in REQUEST_TYPES.items() for number in numbers
}
"""Type → kind of request."""

REPLY_TYPES: Final = {
    ReplyKind.ACK: (MessageType.TELECOMMAND_ACK,),
    ReplyKind.EVENT: (MessageType.EVENT,),
    ReplyKind.TELEMETRY: (MessageType.TELEMETRY, *(MessageType.TELEMETRY_EXTENDED,) * 3),
    ReplyKind.BURST: (MessageType.TELEMETRY, *(MessageType.TELEMETRY_EXTENDED,) * 3),
    ReplyKind.UNSOLICITED: (
        MessageType.UNSOLICITED_LAST,
        MessageType.UNSOLICITED_FIRST, MessageType.UNSOLICITED_BODY, MessageType.UNSOLICITED_LAST,
    ),
}  # fmt: skip
"""Kind of reply → its type in one frame and, if it may be longer, in the first, middle and last segment.

Public sources confirm the types, but not the layout of unsolicited messages and of bursts, which is our own choice.
"""


_REPLY_KINDS: Final[Mapping[int, ReplyKind]] = {
    **{number: kind for kind in REPLY_TYPES if kind is not ReplyKind.BURST for number in REPLY_TYPES[kind]},
    MessageType.TELECOMMAND_NACK: ReplyKind.NACK,
    MessageType.TELEMETRY_NACK: ReplyKind.NACK,
}
"""Type → kind of reply; a burst has the type of telemetry."""


def nack_type(row_id: int) -> MessageType:
    telemetry = RequestKind.of(row_id) is RequestKind.TELEMETRY
    return MessageType.TELEMETRY_NACK if telemetry else MessageType.TELECOMMAND_NACK


@dataclass(frozen=True, slots=True)
class CanId:
    """The four parts of a CAN ID."""

    type: int
    """A `MessageType`, or another number up to 31."""
    id: int
    source: int
    destination: int

    def pack(self) -> int:
        """Return the 29-bit CAN ID."""
        raw = 0
        for name, shift, highest in CAN_ID:
            value: int = getattr(self, name)
            if not 0 <= value <= highest:
                raise ProtocolError(f"CAN ID: {name} {value} is outside 0 to {highest}")
            raw |= value << shift
        return raw

    @classmethod
    def unpack(cls, raw: int) -> CanId:
        """Return the parts of a 29-bit CAN ID."""
        return cls(*[raw >> shift & highest for _, shift, highest in CAN_ID])


def segment(data: bytes) -> list[bytes]:
    """Split a message into frame payloads: the message itself, or segments with a counter."""
    if len(data) <= MAX_FRAME_DATA:
        return [data]
    if len(data) > MAX_MESSAGE:
        raise ProtocolError(f"message of {len(data)} bytes does not fit CAN segments (at most {MAX_MESSAGE})")
    chunks = [data[start : start + SEGMENT_DATA] for start in range(0, len(data), SEGMENT_DATA)]
    return [chunk + bytes((len(chunks) - 1 - number,)) for number, chunk in enumerate(chunks)]


def encode_request_frames(request: Request, source: int, destination: int) -> list[CanFrame]:
    """Return the frames of a request from an OBC at `source` to the device at `destination`."""
    kind = REQUEST_TYPES[request.kind][len(request.data) > MAX_FRAME_DATA]
    can_id = CanId(kind, request.id, source, destination).pack()
    return [CanFrame(can_id, payload) for payload in segment(request.data)]


def encode_reply_frames(reply: Reply, source: int) -> list[CanFrame]:
    """Return the frames of a reply from the device at `source` to `reply.destination`."""
    if reply.kind is ReplyKind.ECHO:
        raise ProtocolError("CAN has no echo messages")
    if reply.id is None:
        raise ProtocolError(f"a {reply.kind.value} on CAN needs an ID")
    if reply.kind is ReplyKind.NACK:
        types: Sequence[MessageType] = (nack_type(reply.id),)
        payloads = [bytes((int(reply.code),))]
    else:
        types = REPLY_TYPES[reply.kind]
        payloads = segment(b"" if reply.kind is ReplyKind.ACK else reply.data)
    single, *segments = types
    kinds = [single]
    if len(payloads) > 1:
        if not segments:
            raise ProtocolError(
                f"{reply.kind.value} {reply.id} of {len(reply.data)} bytes does not fit one CAN frame"
            )
        first, middle, last = segments
        kinds = [first, *[middle] * (len(payloads) - 2), last]
        if Flaw.SEQUENCE in reply.flaw:
            payloads[-1] = payloads[-1][:-1] + bytes((payloads[-1][-1] + 1,))
    return [
        CanFrame(CanId(kind, reply.id, source, reply.destination).pack(), payload)
        for kind, payload in zip(kinds, payloads, strict=True)
    ]


@dataclass(slots=True)
class _Assembly:
    """A segmented message that is incomplete."""

    first: int
    left: int
    time: float
    """Time at which the last segment arrived, s."""
    data: bytearray
    broken: bool = False
    """Whether a segment was lost: the remaining ones are skipped, without another fault."""


class _CanReceiver(Receiver[CanFrame, Message]):
    """Base of both ends: joins segments by CAN ID, within limits of size, number and time.

    Only frames to `address` are interpreted and, if `sender` is set, only those from it.
    """

    def __init__(
        self,
        address: int,
        sender: int | None = None,
        *,
        max_size: int = DEFAULT_MAX_SIZE,
        timeout_s: float = DEFAULT_TIMEOUT_S,
    ) -> None:
        self._address = address
        self._sender = sender
        self._max_size = max_size
        self._timeout_s = timeout_s
        self._open: dict[int, _Assembly] = {}

    @property
    def busy(self) -> bool:
        return bool(self._open)

    def flush(self, now: float) -> list[LinkFault]:
        late = [key for key, message in self._open.items() if now - message.time >= self._timeout_s]
        return [self._incomplete(key, self._open.pop(key)) for key in late]

    def _incomplete(self, key: int, message: _Assembly) -> LinkFault:
        text = f"{message.left} segments missing after {self._timeout_s:g} s of silence"
        return LinkFault(FaultKind.CAN_INCOMPLETE, f"{key:08X}: {text}")

    def feed(self, frame: CanFrame, now: float) -> list[Message | LinkFault]:
        events: list[Message | LinkFault] = list(self.flush(now))
        if frame.extended and not frame.remote:
            can_id = CanId.unpack(frame.id)
            if can_id.destination == self._address and self._sender in (None, can_id.source):
                events.extend(self._interpret(can_id, frame, now))
        return events

    @abstractmethod
    def _interpret(self, can_id: CanId, frame: CanFrame, now: float) -> Iterator[Message | LinkFault]:
        """Yield the messages and faults of a frame that is addressed to this end."""

    def _join(self, key: int, payload: bytes, now: float) -> Iterator[bytes | LinkFault]:
        """Add a segment; yield the fault if there is one, and the message if it is complete.

        A segment out of order breaks its message. Further segments are skipped up to one whose counter is 0,
        which ends the message, or at least the first segment's counter, which starts a new one.
        """
        if not payload:
            self._open.pop(key, None)
            yield LinkFault(FaultKind.CAN_LENGTH, f"{key:08X}: segment without its counter")
            return
        chunk, left = payload[:-1], payload[-1]
        whole = len(chunk) == SEGMENT_DATA
        message = self._open.get(key)
        if message is None:
            if not left or not whole:
                yield _wrong_segment(key, chunk, left, " is not the first of a message")
                return
            if len(self._open) >= MAX_OPEN_MESSAGES:
                oldest = min(self._open, key=lambda other: self._open[other].time)
                del self._open[oldest]
                yield LinkFault(FaultKind.CAN_OVERLONG, f"{oldest:08X}: too many incomplete messages")
            self._open[key] = _Assembly(left, left, now, bytearray(chunk))
            return
        message.time = now
        if not message.broken and (left != message.left - 1 or (left and not whole)):
            message.broken = True
            yield _wrong_segment(key, chunk, left, f", expected {message.left - 1}")
        if message.broken:
            if whole and left >= message.first:
                self._open[key] = _Assembly(left, left, now, bytearray(chunk))
            elif not left:
                del self._open[key]
            return
        message.data += chunk
        message.left = left
        if len(message.data) + left > self._max_size:
            message.broken = True
            yield LinkFault(FaultKind.CAN_OVERLONG, f"{key:08X}: message longer than {self._max_size} bytes")
        if not left:
            del self._open[key]
            if not message.broken:
                yield bytes(message.data)


def _wrong_segment(key: int, chunk: bytes, left: int, text: str) -> LinkFault:
    return LinkFault(
        FaultKind.CAN_SEQUENCE, f"{key:08X}: segment counter {left} with {len(chunk)} bytes{text}"
    )


def _with_type(number: MessageType, frame: CanFrame) -> int:
    """Return the CAN ID of a frame with another type of message."""
    return number << 24 | frame.id & 0xFFFFFF


class CanDeviceReceiver(_CanReceiver[Request]):
    """The device's end: CAN frames in, requests and faults out."""

    def _interpret(self, can_id: CanId, frame: CanFrame, now: float) -> Iterator[Request | LinkFault]:
        kind = RequestKind.of(can_id.id)
        messages: Iterable[bytes | LinkFault] = [frame.data]
        if REQUEST_KINDS.get(can_id.type) is not kind:
            text = f"{frame.id:08X}: type {can_id.type} with ID {can_id.id} is not a request"
            messages = [LinkFault(FaultKind.CAN_TYPE, text)]
        elif can_id.type == MessageType.TELECOMMAND_EXTENDED:
            messages = self._join(frame.id, frame.data, now)
        elif self._open and (key := _with_type(MessageType.TELECOMMAND_EXTENDED, frame)) in self._open:
            del self._open[key]
            text = f"{frame.id:08X}: interrupts a segmented telecommand"
            yield LinkFault(FaultKind.CAN_SEQUENCE, text)
        for item in messages:
            yield item if isinstance(item, LinkFault) else Request(kind, can_id.id, item, can_id.source)


class CanHostReceiver(_CanReceiver[Reply]):
    """The OBC's end: CAN frames in, replies and faults out; requests from other masters are ignored."""

    def _interpret(self, can_id: CanId, frame: CanFrame, now: float) -> Iterator[Reply | LinkFault]:
        number, kind = can_id.type, _REPLY_KINDS.get(can_id.type)
        messages: Iterable[bytes | LinkFault] = [frame.data]
        if kind is None:
            text = f"{frame.id:08X}: type {number} is not a reply"
            messages = [] if number in REQUEST_KINDS else [LinkFault(FaultKind.CAN_TYPE, text)]
        elif kind is ReplyKind.NACK and not frame.data:
            messages = [LinkFault(FaultKind.CAN_LENGTH, f"{frame.id:08X}: NACK without a code")]
        elif number == MessageType.TELEMETRY_EXTENDED:
            messages = self._join(frame.id, frame.data, now)
            kind = ReplyKind.BURST if can_id.id == BURST_ID else kind
        elif kind is ReplyKind.UNSOLICITED:
            key = _with_type(MessageType.UNSOLICITED_FIRST, frame)
            if number == MessageType.UNSOLICITED_FIRST and key in self._open:
                del self._open[key]
                yield LinkFault(FaultKind.CAN_INCOMPLETE, f"{key:08X}: interrupted by the start of another")
            if number != MessageType.UNSOLICITED_LAST or key in self._open:
                messages = self._join(key, frame.data, now)
        for item in messages:
            if isinstance(item, LinkFault):
                yield item
            elif kind is ReplyKind.NACK:
                yield Reply(kind, can_id.id, code=error_code(item[0]), source=can_id.source)
            elif kind is not None:
                yield Reply(kind, can_id.id, item, source=can_id.source)
