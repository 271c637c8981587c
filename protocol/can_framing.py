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

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
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

MAX_STANDARD_ID: Final = 0x7FF
MAX_EXTENDED_ID: Final = 0x1FFFFFFF
MAX_FRAME_DATA: Final = 8
SEGMENT_DATA: Final = 7
MAX_MESSAGE: Final = 256 * SEGMENT_DATA
"""Longest message that the segment counter allows."""

MAX_OPEN_MESSAGES: Final = 32
"""Maximum number of incomplete messages in a receiver; one more replaces the oldest."""


@dataclass(frozen=True, slots=True)
class CanFrame:
    """One classic CAN data or remote frame; frames with the same content are equal, whenever they came."""

    id: int
    """CAN ID, 11 or 29 bits."""
    data: bytes = b""
    extended: bool = True
    remote: bool = False
    timestamp: float | None = field(default=None, compare=False)
    """Time of reception, seconds since 1970, or None."""

    def __post_init__(self) -> None:
        """Reject a frame that cannot exist on a CAN bus."""
        if not 0 <= self.id <= (MAX_EXTENDED_ID if self.extended else MAX_STANDARD_ID):
            kind = "a 29-bit" if self.extended else "an 11-bit"
            raise ProtocolError(f"{self.id:#x} is not {kind} CAN ID")
        if len(self.data) > MAX_FRAME_DATA:
            raise ProtocolError(f"CAN frame with {len(self.data)} bytes, at most {MAX_FRAME_DATA}")
        if self.remote and self.data:
            raise ProtocolError("CAN remote frame with data")


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
    """A segment of a telecommand."""
    TELEMETRY_EXTENDED = 8
    """A segment of a telemetry reply."""
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


def nack_type(row_id: int) -> MessageType:
    """Return the type of the refusal of a row."""
    telemetry = row_id >= FIRST_TELEMETRY_ID
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
    return [
        CanFrame(CanId(kind, reply.id, source, reply.destination).pack(), payload)
        for kind, payload in zip(kinds, payloads, strict=True)
    ]


@dataclass(slots=True)
class _Assembly:
    """A segmented message that is incomplete."""

    first: int
    """Counter of the first segment."""
    left: int
    """Remaining segments."""
    time: float
    """Time at which the last segment arrived, s."""
    data: bytearray
    broken: bool = False
    """Whether a segment was lost: the remaining ones are skipped, without another fault."""


class _Assembler:
    """Joins segments by CAN ID, within limits of size, number and time."""

    def __init__(self, max_size: int, timeout_s: float) -> None:
        check_receiver_limits(max_size, timeout_s)
        self._max_size = max_size
        self._timeout_s = timeout_s
        self._open: dict[int, _Assembly] = {}

    @property
    def busy(self) -> bool:
        return bool(self._open)

    def flush(self, now: float) -> list[LinkFault]:
        late = [key for key, message in self._open.items() if now - message.time >= self._timeout_s]
        faults = []
        for key in late:
            message = self._open.pop(key)
            faults.append(
                LinkFault(
                    FaultKind.CAN_INCOMPLETE,
                    f"{key:08X}: {message.left} segments missing after {self._timeout_s:g} s of silence",
                )
            )
        return faults

    def has(self, key: int) -> bool:
        """Return whether a message with this key is incomplete."""
        return key in self._open

    def drop(self, key: int) -> bool:
        """Drop the message with this key; return whether there was one."""
        return self._open.pop(key, None) is not None

    def add(self, key: int, payload: bytes, now: float) -> Iterator[bytes | LinkFault]:
        """Add a segment; yield the fault if there is one, and the message if it is complete.

        A segment out of order breaks its message. Further segments are skipped up to one whose counter is 0,
        which ends the message, or at least the first segment's counter, which starts a new one.
        """
        if not payload:
            self.drop(key)
            yield LinkFault(FaultKind.CAN_LENGTH, f"{key:08X}: segment without its counter")
            return
        chunk, left = payload[:-1], payload[-1]
        message = self._open.get(key)
        if message is None:
            yield from self._open_message(key, chunk, left, now)
            return
        if message.broken or left != message.left - 1 or (left and len(chunk) != SEGMENT_DATA):
            yield from self._out_of_order(key, message, chunk, left, now)
            return
        message.data += chunk
        message.left, message.time = left, now
        overlong = len(message.data) + left > self._max_size
        message.broken = overlong
        if overlong:
            yield LinkFault(FaultKind.CAN_OVERLONG, f"{key:08X}: message longer than {self._max_size} bytes")
        if not left:
            del self._open[key]
            if not overlong:
                yield bytes(message.data)

    def _open_message(self, key: int, chunk: bytes, left: int, now: float) -> Iterator[LinkFault]:
        if left == 0 or len(chunk) != SEGMENT_DATA:
            yield LinkFault(
                FaultKind.CAN_SEQUENCE,
                f"{key:08X}: segment counter {left} with {len(chunk)} bytes is not the first of a message",
            )
            return
        if len(self._open) >= MAX_OPEN_MESSAGES:
            oldest = min(self._open, key=lambda other: self._open[other].time)
            del self._open[oldest]
            yield LinkFault(FaultKind.CAN_OVERLONG, f"{oldest:08X}: too many incomplete messages")
        self._open[key] = _Assembly(left, left, now, bytearray(chunk))

    def _out_of_order(
        self, key: int, message: _Assembly, chunk: bytes, left: int, now: float
    ) -> Iterator[LinkFault]:
        if not message.broken:
            text = f"{key:08X}: segment counter {left} with {len(chunk)} bytes, expected {message.left - 1}"
            yield LinkFault(FaultKind.CAN_SEQUENCE, text)
        message.broken = True
        message.time = now
        if left >= message.first and len(chunk) == SEGMENT_DATA:
            self._open[key] = _Assembly(left, left, now, bytearray(chunk))
        elif left == 0:
            del self._open[key]


_Event = TypeVar("_Event")


class _Receiver(ABC, Generic[_Event]):
    """Base of both ends: CAN frames in, messages and faults out."""

    def __init__(
        self, address: int, *, max_size: int = DEFAULT_MAX_SIZE, timeout_s: float = DEFAULT_TIMEOUT_S
    ) -> None:
        self.address = address
        """Address of this end; may change at any time."""
        self._assembler = _Assembler(max_size, timeout_s)

    @property
    def busy(self) -> bool:
        """Whether a segmented message is incomplete, so that `flush` may become due."""
        return self._assembler.busy

    def flush(self, now: float) -> list[LinkFault]:
        """Abandon segmented messages without a new segment for the timeout."""
        return self._assembler.flush(now)

    def feed(self, frame: CanFrame, now: float) -> list[_Event | LinkFault]:
        """Return the messages and faults that a frame completes.

        `now` is its time of arrival (s, any origin).
        """
        events: list[_Event | LinkFault] = list(self.flush(now))
        if frame.extended and not frame.remote:
            can_id = CanId.unpack(frame.id)
            if self._concerns(can_id):
                events.extend(self._interpret(can_id, frame, now))
        return events

    def _concerns(self, can_id: CanId) -> bool:
        return can_id.destination == self.address

    @abstractmethod
    def _interpret(self, can_id: CanId, frame: CanFrame, now: float) -> Iterator[_Event | LinkFault]:
        """Yield the messages and faults of a frame that is addressed to this end."""


class CanDeviceReceiver(_Receiver[Request]):
    """The device's end: CAN frames in, requests and faults out.

    Frames to other addresses are ignored.
    """

    def _interpret(self, can_id: CanId, frame: CanFrame, now: float) -> Iterator[Request | LinkFault]:
        is_telemetry = can_id.id >= FIRST_TELEMETRY_ID
        match can_id.type:
            case MessageType.TELECOMMAND if not is_telemetry:
                segmented = CanId(
                    MessageType.TELECOMMAND_EXTENDED, can_id.id, can_id.source, can_id.destination
                )
                if self._assembler.drop(segmented.pack()):
                    yield LinkFault(
                        FaultKind.CAN_SEQUENCE, f"{frame.id:08X}: interrupts a segmented telecommand"
                    )
                yield Request(RequestKind.TELECOMMAND, can_id.id, frame.data, can_id.source)
            case MessageType.TELEMETRY_REQUEST if is_telemetry:
                yield Request(RequestKind.TELEMETRY, can_id.id, frame.data, can_id.source)
            case MessageType.TELECOMMAND_EXTENDED if not is_telemetry:
                for item in self._assembler.add(frame.id, frame.data, now):
                    yield (
                        item
                        if isinstance(item, LinkFault)
                        else Request(RequestKind.TELECOMMAND, can_id.id, item, can_id.source)
                    )
            case _:
                yield LinkFault(
                    FaultKind.CAN_TYPE,
                    f"{frame.id:08X}: type {can_id.type} with ID {can_id.id} is not a request",
                )


_SINGLE_FRAMES: Final[dict[int, ReplyKind]] = {
    MessageType.TELECOMMAND_ACK: ReplyKind.ACK,
    MessageType.TELECOMMAND_NACK: ReplyKind.NACK,
    MessageType.TELEMETRY_NACK: ReplyKind.NACK,
    MessageType.TELEMETRY: ReplyKind.TELEMETRY,
    MessageType.EVENT: ReplyKind.EVENT,
}
"""Type → kind of the replies of which one frame is all."""


class CanHostReceiver(_Receiver[Reply]):
    """The OBC's end: CAN frames in, replies and faults out.

    Frames to other addresses, requests from other masters and, if `device` is set, frames from other devices
    are ignored.
    """

    def __init__(
        self,
        address: int,
        device: int | None = None,
        *,
        max_size: int = DEFAULT_MAX_SIZE,
        timeout_s: float = DEFAULT_TIMEOUT_S,
    ) -> None:
        super().__init__(address, max_size=max_size, timeout_s=timeout_s)
        self._device = device

    def _concerns(self, can_id: CanId) -> bool:
        return super()._concerns(can_id) and self._device in (None, can_id.source)

    def _interpret(self, can_id: CanId, frame: CanFrame, now: float) -> Iterator[Reply | LinkFault]:
        match can_id.type:
            case number if number in _SINGLE_FRAMES:
                yield self._single(can_id, frame)
            case MessageType.TELEMETRY_EXTENDED:
                kind = ReplyKind.BURST if can_id.id == BURST_ID else ReplyKind.TELEMETRY
                yield from self._add_segment(kind, frame.id, can_id, frame.data, now)
            case MessageType.UNSOLICITED_FIRST | MessageType.UNSOLICITED_BODY | MessageType.UNSOLICITED_LAST:
                yield from self._unsolicited(can_id, frame.data, now)
            case MessageType.TELECOMMAND | MessageType.TELEMETRY_REQUEST | MessageType.TELECOMMAND_EXTENDED:
                return
            case _:
                yield LinkFault(FaultKind.CAN_TYPE, f"{frame.id:08X}: type {can_id.type} is not a reply")

    @staticmethod
    def _single(can_id: CanId, frame: CanFrame) -> Reply | LinkFault:
        kind = _SINGLE_FRAMES[can_id.type]
        if kind is not ReplyKind.NACK:
            return Reply(kind, can_id.id, frame.data, source=can_id.source)
        if not frame.data:
            return LinkFault(FaultKind.CAN_LENGTH, f"{frame.id:08X}: NACK without a code")
        return Reply(kind, can_id.id, code=error_code(frame.data[0]), source=can_id.source)

    def _unsolicited(self, can_id: CanId, data: bytes, now: float) -> Iterator[Reply | LinkFault]:
        key = CanId(MessageType.UNSOLICITED_FIRST, can_id.id, can_id.source, can_id.destination).pack()
        first = can_id.type == MessageType.UNSOLICITED_FIRST
        if first and self._assembler.drop(key):
            yield LinkFault(FaultKind.CAN_INCOMPLETE, f"{key:08X}: interrupted by the start of another")
        if can_id.type == MessageType.UNSOLICITED_LAST and not self._assembler.has(key):
            yield Reply(ReplyKind.UNSOLICITED, can_id.id, data, source=can_id.source)
            return
        yield from self._add_segment(ReplyKind.UNSOLICITED, key, can_id, data, now)

    def _add_segment(
        self, kind: ReplyKind, key: int, can_id: CanId, data: bytes, now: float
    ) -> Iterator[Reply | LinkFault]:
        for item in self._assembler.add(key, data, now):
            yield item if isinstance(item, LinkFault) else Reply(kind, can_id.id, item, source=can_id.source)
