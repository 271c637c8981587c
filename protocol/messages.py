"""Messages of every link: requests, replies, link faults, and the published error codes."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum, Flag, IntEnum, StrEnum
from typing import Final, Protocol, TypeVar

Arriving_contra = TypeVar("Arriving_contra", contravariant=True)
Message_co = TypeVar("Message_co", covariant=True)

FIRST_TELEMETRY_ID: Final = 128
"""On CubeSpace's links, IDs from this one on are telemetry, lower IDs are telecommands."""

DEFAULT_MAX_SIZE: Final = 512
"""Longest message that a receiver accepts: the buffer size of the published host library."""

DEFAULT_TIMEOUT_S: Final = 0.5
"""Silence within a message after which it is abandoned."""

BURST_ID: Final = 119


class ErrorCode(IntEnum):
    """Result of a request: generation 1 has 0 to 4, generation 2 added 5 to 10."""

    OK = 0
    INVALID_ID = 1
    INVALID_LENGTH = 2
    INVALID_PARAMETER = 3
    CRC = 4
    NOT_IMPLEMENTED = 5
    BUSY = 6
    SEQUENCE = 7
    INTERNAL = 8
    PASSTHROUGH_TIMEOUT = 9
    PASSTHROUGH_TARGET = 10


class RequestKind(StrEnum):
    """Kinds of rows, and of the requests that an OBC sends."""

    TELECOMMAND = "telecommand"
    TELEMETRY = "telemetry"

    @classmethod
    def of(cls, row_id: int) -> RequestKind:
        return cls.TELEMETRY if row_id >= FIRST_TELEMETRY_ID else cls.TELECOMMAND


class ReplyKind(Enum):
    """Kinds of messages that a device sends."""

    ACK = "ack"
    NACK = "nack"
    TELEMETRY = "telemetry"
    UNSOLICITED = "unsolicited"
    EVENT = "event"
    BURST = "burst"
    ECHO = "echo"
    """The request itself, sent back."""


class FaultKind(Enum):
    """Kinds of faults in received bytes or CAN frames."""

    UART_PROTOCOL = "uart_protocol"
    """Bytes outside a message, or bytes that violate the framing."""
    UART_INCOMPLETE = "uart_incomplete"
    """A message began and did not end."""
    UART_OVERLONG = "uart_overlong"
    """A message longer than the receiver accepts."""
    UART_SHORT = "uart_short"
    """A message shorter than header and check."""
    UART_CHECK = "uart_check"
    UART_ADDRESS = "uart_address"
    CAN_SEQUENCE = "can_sequence"
    """A segment out of order."""
    CAN_INCOMPLETE = "can_incomplete"
    """A segmented message that did not end in time."""
    CAN_LENGTH = "can_length"
    """A data length that the message type does not allow."""
    CAN_TYPE = "can_type"
    """A message type that a device or host does not accept."""
    CAN_OVERLONG = "can_overlong"
    """A segmented message longer than the receiver accepts, or too many incomplete messages."""


class Flaw(Flag):
    """Errors in a message that is sent with them on purpose, and is well-formed otherwise."""

    NONE = 0
    CHECK = 1
    """A wrong check, on a serial line that has one."""
    SEQUENCE = 2
    """A wrong sequence number in the header, or a wrong segment counter on CAN."""


@dataclass(frozen=True, slots=True)
class Request:
    """A telecommand with its parameters, or a request for telemetry."""

    kind: RequestKind
    id: int
    """ID on the wire, 0 to 255."""
    data: bytes = b""
    source: int = 0
    """Address of the sender; 0 on a serial line whose messages carry none."""
    message_class: str = ""
    """Class of the row, if the unit has classes."""
    sequence: int = 0
    """Sequence number in the header, if any; the reply repeats it."""
    flags: int = 0
    """Flags in the header, if any; the reply repeats them."""
    polled: bool = True
    """Whether the request is answered; otherwise it is only executed."""

    @classmethod
    def of(cls, row_id: int, data: bytes = b"", source: int = 0) -> Request:
        """Return a request whose kind follows from its ID."""
        return cls(RequestKind.of(row_id), row_id, data, source)


@dataclass(frozen=True, slots=True)
class Reply:
    """The answer of a device to a request, or an unsolicited message."""

    kind: ReplyKind
    id: int | None
    """ID of the answered request or of the message; None if the serial dialect does not carry it.
    """
    data: bytes = b""
    code: ErrorCode | int = ErrorCode.OK
    """Error code of a NACK; an unpublished code is a plain number."""
    destination: int = 0
    """Address of the receiver (set on the device side); 0 on a serial line whose messages carry none."""
    source: int = 0
    """Address of the sender (set on the OBC side); 0 on a serial line whose messages carry none."""
    message_class: str = ""
    """Class of the row, if the unit has classes."""
    sequence: int = 0
    flags: int = 0
    final: bool = True
    """Whether this is the last reply to the request."""
    uptime_ns: int = 0
    """Time since the device started, if the header carries `ticks`."""
    time_ns: int = 0
    """Time of the device's clock since the unit's epoch, if the header carries `time`."""
    flaw: Flaw = Flaw.NONE
    """Errors with which it is sent (set on the device side)."""

    @classmethod
    def echo(cls, request: Request) -> Reply:
        return cls(
            ReplyKind.ECHO,
            request.id,
            request.data,
            destination=request.source,
            message_class=request.message_class,
            sequence=request.sequence,
            flags=request.flags,
        )


@dataclass(frozen=True, slots=True)
class LinkFault:
    """Input that is not a valid message: the kind for counters, and a text."""

    kind: FaultKind
    detail: str


class Receiver(Protocol[Arriving_contra, Message_co]):
    """The receiving side of a link: bytes or CAN frames in, messages and faults out."""

    @property
    @abstractmethod
    def busy(self) -> bool:
        """Whether a message is incomplete, so that `flush` may become due."""

    @abstractmethod
    def feed(self, item: Arriving_contra, now: float, /) -> Sequence[Message_co | LinkFault]:
        """Return the messages and faults that an item completes; `now` is the time of arrival, s."""

    @abstractmethod
    def flush(self, now: float, /) -> list[LinkFault]:
        """Drop an incomplete message after a silence of the time-out; return the faults."""


def error_code(raw: int) -> ErrorCode | int:
    """Return the ErrorCode of a number, or the number itself if it is not a published code."""
    try:
        return ErrorCode(raw)
    except ValueError:
        return raw
