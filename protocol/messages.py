"""What crosses a link, whatever the link: requests, replies, faults and the published error codes."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, IntEnum
from typing import Final

FIRST_TELEMETRY_ID: Final = 128
"""Identifiers from here on are telemetry; those below are telecommands."""

BURST_ID: Final = 119
"""Identifier under which the packets of a file burst are sent."""


class ErrorCode(IntEnum):
    """Answer to a request: 0 to 4 are generation 1's, 5 to 10 were added by generation 2."""

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


class RequestKind(Enum):
    """What an OBC asks for."""

    TELECOMMAND = "telecommand"
    TELEMETRY = "telemetry"


class ReplyKind(Enum):
    """What a device sends."""

    ACK = "ack"
    NACK = "nack"
    TELEMETRY = "telemetry"
    UNSOLICITED = "unsolicited"
    EVENT = "event"
    BURST = "burst"


class FaultKind(Enum):
    """What was wrong with bytes or frames that gave no message."""

    UART_PROTOCOL = "uart_protocol"
    """Bytes outside or against the framing."""
    UART_INCOMPLETE = "uart_incomplete"
    """A message began and did not end."""
    UART_OVERLONG = "uart_overlong"
    """A message longer than the receiver takes."""
    CAN_SEQUENCE = "can_sequence"
    """A segment out of order."""
    CAN_INCOMPLETE = "can_incomplete"
    """A segmented message that did not end in time."""
    CAN_LENGTH = "can_length"
    """A data length that the message type does not allow."""
    CAN_TYPE = "can_type"
    """A message type that a device or host does not take."""
    CAN_OVERLONG = "can_overlong"
    """A segmented message longer than the receiver takes, or too many at once."""


@dataclass(frozen=True, slots=True)
class Request:
    """A telecommand with its parameters, or a request for telemetry."""

    kind: RequestKind
    id: int
    """Identifier on the wire, 0 to 255."""
    data: bytes = b""
    source: int = 0
    """CAN address of the asker; 0 on serial."""

    @classmethod
    def of(cls, identifier: int, data: bytes = b"", source: int = 0) -> Request:
        """Make a request whose kind follows from its identifier."""
        kind = RequestKind.TELEMETRY if identifier >= FIRST_TELEMETRY_ID else RequestKind.TELECOMMAND
        return cls(kind, identifier, data, source)


@dataclass(frozen=True, slots=True)
class Reply:
    """What a device answers or sends by itself."""

    kind: ReplyKind
    id: int | None
    """Identifier that is answered; None where a serial dialect does not carry it and nothing was expected."""
    data: bytes = b""
    code: ErrorCode | int = ErrorCode.OK
    """Error code of a NACK; an unknown code stays a plain number."""
    destination: int = 0
    """CAN address that the reply goes to (device side); 0 on serial."""
    source: int = 0
    """CAN address that the reply came from (OBC side); 0 on serial."""


@dataclass(frozen=True, slots=True)
class LinkFault:
    """Input that made no message: the kind is for the counters, the detail for a person."""

    kind: FaultKind
    detail: str


def error_code(raw: int) -> ErrorCode | int:
    """Name an error code; one that is not published stays a number."""
    try:
        return ErrorCode(raw)
    except ValueError:
        return raw
