"""CAN framing of the CubeSpace family: 29-bit identifiers and segments that count down, as sans-I/O receivers.

Identifier: type[28:24], telecommand or telemetry id[23:16], source[15:8], destination[7:0]. Up to 8 bytes go in one
frame. More than 8 go in segments of 7 bytes and a last byte that counts the segments still to come, down to 0; the
last segment is as short as its data.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum
from typing import Final, Generic, TypeVar

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

MAX_STANDARD_ID: Final = 0x7FF
MAX_EXTENDED_ID: Final = 0x1FFFFFFF
MAX_FRAME_DATA: Final = 8
SEGMENT_DATA: Final = 7
MAX_MESSAGE: Final = 256 * SEGMENT_DATA
"""Longest message that the counter of segments can tell."""

DEFAULT_MAX_SIZE: Final = 512
"""Longest message that a receiver takes, as the published host library's buffer."""

DEFAULT_TIMEOUT_S: Final = 0.5
"""Silence within a segmented message after which it is given up."""

MAX_OPEN_MESSAGES: Final = 32
"""Segmented messages that a receiver keeps open at once; a further one takes the place of the oldest."""


@dataclass(frozen=True, slots=True)
class CanFrame:
    """One classic CAN data or remote frame."""

    id: int
    """Identifier, 11 or 29 bits."""
    data: bytes = b""
    extended: bool = True
    remote: bool = False
    timestamp: float | None = None
    """Seconds since 1970 when the frame was seen, or None."""

    def __post_init__(self) -> None:
        """Refuse what cannot be on a CAN bus."""
        if not 0 <= self.id <= (MAX_EXTENDED_ID if self.extended else MAX_STANDARD_ID):
            raise ProtocolError(
                f"CAN id {self.id:#x} is not a {'29' if self.extended else '11'}-bit identifier"
            )
        if len(self.data) > MAX_FRAME_DATA:
            raise ProtocolError(f"CAN frame with {len(self.data)} bytes, at most {MAX_FRAME_DATA}")
        if self.remote and self.data:
            raise ProtocolError("CAN remote frame with data")


class MessageType(IntEnum):
    """Bits 28 to 24 of the identifier."""

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


@dataclass(frozen=True, slots=True)
class CanIdentifier:
    """The four parts of an identifier."""

    type: int
    """A `MessageType`, or a number up to 31 that is none."""
    id: int
    source: int
    destination: int

    def pack(self) -> int:
        """Return the 29-bit identifier."""
        for name, value, highest in (
            ("type", self.type, 31),
            ("id", self.id, 255),
            ("source", self.source, 255),
            ("destination", self.destination, 255),
        ):
            if not 0 <= value <= highest:
                raise ProtocolError(f"CAN identifier: {name} {value} is outside 0 to {highest}")
        return self.type << 24 | self.id << 16 | self.source << 8 | self.destination

    @classmethod
    def unpack(cls, raw: int) -> CanIdentifier:
        """Take a 29-bit identifier apart."""
        return cls(raw >> 24 & 0x1F, raw >> 16 & 0xFF, raw >> 8 & 0xFF, raw & 0xFF)


def segment(data: bytes) -> list[bytes]:
    """Cut a message into frame payloads: one as it is, or segments that count down to 0."""
    if len(data) <= MAX_FRAME_DATA:
        return [data]
    if len(data) > MAX_MESSAGE:
        raise ProtocolError(f"message of {len(data)} bytes does not fit CAN segments (at most {MAX_MESSAGE})")
    parts = [data[start : start + SEGMENT_DATA] for start in range(0, len(data), SEGMENT_DATA)]
    return [part + bytes((len(parts) - 1 - number,)) for number, part in enumerate(parts)]


def encode_request_frames(request: Request, source: int, destination: int) -> list[CanFrame]:
    """Make the frames by which an OBC at `source` asks the device at `destination`."""
    if request.kind is RequestKind.TELEMETRY:
        kind = MessageType.TELEMETRY_REQUEST
    elif len(request.data) > MAX_FRAME_DATA:
        kind = MessageType.TELECOMMAND_EXTENDED
    else:
        kind = MessageType.TELECOMMAND
    identifier = CanIdentifier(kind, request.id, source, destination).pack()
    return [CanFrame(identifier, payload) for payload in segment(request.data)]


def encode_reply_frames(reply: Reply, source: int) -> list[CanFrame]:
    """Make the frames by which the device at `source` answers `reply.destination`.

    Unsolicited telemetry of up to 8 bytes is one frame of the type `last`; more is first, body … and last with the
    counting byte in each. No public source shows that layout: the three types are confirmed, their use is ours.
    Burst packets go as segmented telemetry under the burst's id (ours).
    """
    if reply.id is None:
        raise ProtocolError(f"a {reply.kind.value} on CAN needs an id")
    long = len(reply.data) > MAX_FRAME_DATA
    match reply.kind:
        case ReplyKind.ACK:
            kinds, payloads = [MessageType.TELECOMMAND_ACK], [b""]
        case ReplyKind.NACK:
            telemetry = reply.id >= FIRST_TELEMETRY_ID
            kinds = [MessageType.TELEMETRY_NACK if telemetry else MessageType.TELECOMMAND_NACK]
            payloads = [bytes((int(reply.code),))]
        case ReplyKind.UNSOLICITED:
            payloads = segment(reply.data)
            kinds = [MessageType.UNSOLICITED_BODY] * len(payloads)
            kinds[0], kinds[-1] = MessageType.UNSOLICITED_FIRST, MessageType.UNSOLICITED_LAST
        case ReplyKind.EVENT:
            if long:
                raise ProtocolError(f"event {reply.id} of {len(reply.data)} bytes does not fit one CAN frame")
            kinds, payloads = [MessageType.EVENT], [reply.data]
        case _:
            payloads = segment(reply.data)
            kind = MessageType.TELEMETRY_EXTENDED if long else MessageType.TELEMETRY
            kinds = [kind] * len(payloads)
    return [
        CanFrame(CanIdentifier(kind, reply.id, source, reply.destination).pack(), payload)
        for kind, payload in zip(kinds, payloads, strict=True)
    ]


@dataclass(slots=True)
class _Assembly:
    """A segmented message that is coming in."""

    first: int
    """Counter of the first segment."""
    left: int
    """Segments still to come."""
    time: float
    """When the last segment came (s)."""
    data: bytearray
    broken: bool = False
    """A segment was lost: the rest is passed over, without another fault."""


class _Assembler:
    """Joins segments by identifier; keeps within bounds of size, number and time."""

    def __init__(self, max_size: int, timeout_s: float) -> None:
        if max_size < 1 or timeout_s <= 0:
            raise ProtocolError(f"receiver limits {max_size} bytes, {timeout_s} s must be positive")
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
        """Tell whether a message of the key is open."""
        return key in self._open

    def drop(self, key: int) -> bool:
        """Give up the message of a key; return whether there was one."""
        return self._open.pop(key, None) is not None

    def add(self, key: int, payload: bytes, now: float) -> tuple[bytes | None, LinkFault | None]:
        """Take a segment; return the whole message if it is complete, and the fault if there is one.

        A segment out of order breaks its message. What follows of it is passed over, up to the segment that counts 0
        or to one that counts as high as the first did: with that one the message begins anew.
        """
        if not payload:
            self.drop(key)
            return None, LinkFault(FaultKind.CAN_LENGTH, f"{key:08X}: segment without its counter")
        part, left = payload[:-1], payload[-1]
        message = self._open.get(key)
        if message is None:
            return None, self._begin(key, part, left, now)
        in_order = not message.broken and left == message.left - 1 and (not left or len(part) == SEGMENT_DATA)
        if not in_order:
            return None, self._out_of_order(key, message, part, left, now)
        message.data += part
        message.left, message.time = left, now
        if len(message.data) + left > self._max_size:
            message.broken = bool(left)
            if not left:
                del self._open[key]
            return None, LinkFault(
                FaultKind.CAN_OVERLONG, f"{key:08X}: message longer than {self._max_size} bytes"
            )
        if left:
            return None, None
        del self._open[key]
        return bytes(message.data), None

    def _begin(self, key: int, part: bytes, left: int, now: float) -> LinkFault | None:
        if left == 0 or len(part) != SEGMENT_DATA:
            return LinkFault(
                FaultKind.CAN_SEQUENCE,
                f"{key:08X}: segment counter {left} with {len(part)} bytes begins nothing",
            )
        fault = None
        if len(self._open) >= MAX_OPEN_MESSAGES:
            oldest = min(self._open, key=lambda other: self._open[other].time)
            del self._open[oldest]
            fault = LinkFault(FaultKind.CAN_OVERLONG, f"{oldest:08X}: too many messages open at once")
        self._open[key] = _Assembly(left, left, now, bytearray(part))
        return fault

    def _out_of_order(
        self, key: int, message: _Assembly, part: bytes, left: int, now: float
    ) -> LinkFault | None:
        text = f"{key:08X}: segment counter {left} with {len(part)} bytes, expected {message.left - 1}"
        fault = None if message.broken else LinkFault(FaultKind.CAN_SEQUENCE, text)
        message.broken = True
        message.time = now
        if left >= message.first and len(part) == SEGMENT_DATA:
            self._open[key] = _Assembly(left, left, now, bytearray(part))
        elif left == 0:
            del self._open[key]
        return fault


_Event = TypeVar("_Event")


class _Receiver(ABC, Generic[_Event]):
    """What both ends have in common: frames in, events and faults out."""

    def __init__(self, address: int, max_size: int, timeout_s: float) -> None:
        self.address = address
        """Own address; may be changed while running."""
        self._assembler = _Assembler(max_size, timeout_s)

    @property
    def busy(self) -> bool:
        """Whether a segmented message is open, so that `flush` may be due."""
        return self._assembler.busy

    def flush(self, now: float) -> list[LinkFault]:
        """Give up segmented messages that have been silent for the time-out."""
        return self._assembler.flush(now)

    def feed(self, frame: CanFrame, now: float) -> list[_Event | LinkFault]:
        """Take a frame that arrived at time `now` (s, any origin) and return what it completes."""
        events: list[_Event | LinkFault] = list(self.flush(now))
        if frame.extended and not frame.remote:
            identifier = CanIdentifier.unpack(frame.id)
            if self._concerns(identifier):
                events.extend(self._take(identifier, frame, now))
        return events

    def _concerns(self, identifier: CanIdentifier) -> bool:
        return identifier.destination == self.address

    @abstractmethod
    def _take(self, identifier: CanIdentifier, frame: CanFrame, now: float) -> Iterator[_Event | LinkFault]:
        """Work off a frame that is addressed to this end."""


class CanDeviceReceiver(_Receiver[Request]):
    """The device's end: frames in, requests and faults out. Frames for other addresses are not its business."""

    def __init__(
        self, address: int, *, max_size: int = DEFAULT_MAX_SIZE, timeout_s: float = DEFAULT_TIMEOUT_S
    ) -> None:
        super().__init__(address, max_size, timeout_s)

    def _take(self, identifier: CanIdentifier, frame: CanFrame, now: float) -> Iterator[Request | LinkFault]:
        is_telemetry = identifier.id >= FIRST_TELEMETRY_ID
        match identifier.type:
            case MessageType.TELECOMMAND if not is_telemetry:
                segmented = CanIdentifier(
                    MessageType.TELECOMMAND_EXTENDED, identifier.id, identifier.source, identifier.destination
                )
                if self._assembler.drop(segmented.pack()):
                    yield LinkFault(
                        FaultKind.CAN_SEQUENCE, f"{frame.id:08X}: cuts off a segmented telecommand"
                    )
                yield Request(RequestKind.TELECOMMAND, identifier.id, frame.data, identifier.source)
            case MessageType.TELEMETRY_REQUEST if is_telemetry:
                yield Request(RequestKind.TELEMETRY, identifier.id, frame.data, identifier.source)
            case MessageType.TELECOMMAND_EXTENDED if not is_telemetry:
                data, fault = self._assembler.add(frame.id, frame.data, now)
                if fault is not None:
                    yield fault
                if data is not None:
                    yield Request(RequestKind.TELECOMMAND, identifier.id, data, identifier.source)
            case _:
                yield LinkFault(
                    FaultKind.CAN_TYPE,
                    f"{frame.id:08X}: type {identifier.type} with id {identifier.id} is no request",
                )


_REPLY_TYPES: Final = {
    MessageType.TELECOMMAND_ACK: ReplyKind.ACK,
    MessageType.TELECOMMAND_NACK: ReplyKind.NACK,
    MessageType.TELEMETRY_NACK: ReplyKind.NACK,
    MessageType.TELEMETRY: ReplyKind.TELEMETRY,
    MessageType.EVENT: ReplyKind.EVENT,
}
"""Replies of one frame."""


class CanHostReceiver(_Receiver[Reply]):
    """The OBC's end: frames in, replies and faults out.

    Frames to other addresses, and requests by other masters, are not its business; with `device` given, neither are
    other devices.
    """

    def __init__(
        self,
        address: int,
        device: int | None = None,
        *,
        max_size: int = DEFAULT_MAX_SIZE,
        timeout_s: float = DEFAULT_TIMEOUT_S,
    ) -> None:
        super().__init__(address, max_size, timeout_s)
        self._device = device

    def _concerns(self, identifier: CanIdentifier) -> bool:
        return super()._concerns(identifier) and self._device in (None, identifier.source)

    def _take(self, identifier: CanIdentifier, frame: CanFrame, now: float) -> Iterator[Reply | LinkFault]:
        match identifier.type:
            case 2 | 3 | 5 | 6 | 9:
                yield self._single(identifier, frame)
            case MessageType.TELEMETRY_EXTENDED:
                kind = ReplyKind.BURST if identifier.id == BURST_ID else ReplyKind.TELEMETRY
                yield from self._segment(kind, frame.id, identifier, frame.data, now)
            case MessageType.UNSOLICITED_FIRST | MessageType.UNSOLICITED_BODY | MessageType.UNSOLICITED_LAST:
                yield from self._unsolicited(identifier, frame.data, now)
            case MessageType.TELECOMMAND | MessageType.TELEMETRY_REQUEST | MessageType.TELECOMMAND_EXTENDED:
                return
            case _:
                yield LinkFault(FaultKind.CAN_TYPE, f"{frame.id:08X}: type {identifier.type} is no reply")

    @staticmethod
    def _single(identifier: CanIdentifier, frame: CanFrame) -> Reply | LinkFault:
        kind = _REPLY_TYPES[MessageType(identifier.type)]
        if kind is not ReplyKind.NACK:
            return Reply(kind, identifier.id, frame.data, source=identifier.source)
        if not frame.data:
            return LinkFault(FaultKind.CAN_LENGTH, f"{frame.id:08X}: refusal without a code")
        return Reply(kind, identifier.id, code=error_code(frame.data[0]), source=identifier.source)

    def _unsolicited(self, identifier: CanIdentifier, data: bytes, now: float) -> Iterator[Reply | LinkFault]:
        key = CanIdentifier(
            MessageType.UNSOLICITED_FIRST, identifier.id, identifier.source, identifier.destination
        ).pack()
        first = identifier.type == MessageType.UNSOLICITED_FIRST
        if first and self._assembler.drop(key):
            yield LinkFault(FaultKind.CAN_INCOMPLETE, f"{key:08X}: cut off by the start of another")
        if identifier.type == MessageType.UNSOLICITED_LAST and not self._assembler.has(key):
            yield Reply(ReplyKind.UNSOLICITED, identifier.id, data, source=identifier.source)
            return
        yield from self._segment(ReplyKind.UNSOLICITED, key, identifier, data, now)

    def _segment(
        self, kind: ReplyKind, key: int, identifier: CanIdentifier, data: bytes, now: float
    ) -> Iterator[Reply | LinkFault]:
        whole, fault = self._assembler.add(key, data, now)
        if fault is not None:
            yield fault
        if whole is not None:
            yield Reply(kind, identifier.id, whole, source=identifier.source)
