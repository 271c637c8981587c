"""CubeSpace on CAN: 29-bit CAN IDs, and segments that count down.

    CAN ID   | type 28…24 | row 23…16 | source 15…8 | destination 7…0 |
    frame    | up to 8 bytes of data |
    segment  | 7 bytes of data | segments that follow |        the last one is as short as its data

Source: libCubeObc (masks and shifts, message types, "7 bytes and a counter"); SkCubeSat's driver expects the same.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, Protocol

from starhil.hil_tests.judge.messages import BURST_ID, FIRST_TELEMETRY, Answer, AnswerKind, Request

TELECOMMAND: Final = 1
TELEMETRY_REQUEST: Final = 4
TELEMETRY_NACK: Final = 6
TELECOMMAND_SEGMENT: Final = 7
UNSOLICITED_FIRST: Final = 10
UNSOLICITED_BODY: Final = 11
UNSOLICITED_LAST: Final = 12
UNSOLICITED: Final = (9, UNSOLICITED_FIRST, UNSOLICITED_BODY, UNSOLICITED_LAST)


class Frame(Protocol):
    """A received frame."""

    @property
    def id(self) -> int:
        """CAN ID."""

    @property
    def data(self) -> bytes:
        """Data."""


def can_id_of(kind: int, number: int, source: int, destination: int) -> int:
    """Return a 29-bit CAN ID."""
    return kind << 24 | number << 16 | source << 8 | destination


def segments(data: bytes) -> list[bytes]:
    """Split data into segments of 7 bytes, each with a byte that counts the remaining ones."""
    parts = [data[start : start + 7] for start in range(0, len(data), 7)]
    return [part + bytes([len(parts) - 1 - number]) for number, part in enumerate(parts)]


def frames_of(request: Request, source: int, destination: int) -> list[tuple[int, bytes]]:
    """Return CAN ID and data of the frames of a request."""
    kind = TELEMETRY_REQUEST if request.id >= FIRST_TELEMETRY else TELECOMMAND
    payloads = [request.data]
    if len(request.data) > 8:
        kind, payloads = TELECOMMAND_SEGMENT, segments(request.data)
    return [(can_id_of(kind, request.id, source, destination), payload) for payload in payloads]


def read_answer(frame: Frame, following: Callable[[], Frame | None]) -> Answer:
    """Return the answer that begins with a frame; `following` returns the next one."""
    kind, number, other = frame.id >> 24, frame.id >> 16 & 0xFF, frame.id & 0xFF
    telemetry = number >= FIRST_TELEMETRY
    match kind:
        case 2 if not frame.data and not telemetry:
            return Answer("ack", row_id=number, other=other)
        case 3 | 6 if len(frame.data) == 1 and frame.data[0] and (kind == TELEMETRY_NACK) == telemetry:
            return Answer("nack", code=frame.data[0], row_id=number, other=other)
        case 5 if telemetry:
            return Answer("telemetry", data=frame.data, row_id=number, other=other)
        case 8 if telemetry or number == BURST_ID:
            return _joined(frame, following)
        case _:
            return Answer("malformed", data=frame.id.to_bytes(4, "big") + frame.data)


def _joined(first: Frame, following: Callable[[], Frame | None]) -> Answer:
    """Join the segments of one message; a wrong counter or a short segment makes it malformed."""
    number, other = first.id >> 16 & 0xFF, first.id & 0xFF
    data, frame = b"", first
    left = first.data[-1] if first.data else 0
    while frame.id == first.id and frame.data and frame.data[-1] == left:
        data += frame.data[:-1]
        if left == 0:
            kind: AnswerKind = "burst" if number == BURST_ID else "telemetry"
            return Answer(kind if len(data) > 8 else "malformed", data=data, row_id=number, other=other)
        if len(frame.data) != 8:
            break
        left -= 1
        received = following()
        if received is None:
            return Answer("malformed", data=data, row_id=number, other=other)
        frame = received
    return Answer("malformed", data=data + frame.data, row_id=number, other=other)


def unsolicited(frames: list[Frame]) -> list[Answer]:
    """Return the messages in frames of unsolicited telemetry; one without its beginning or end is left out."""
    answers, data = [], b""
    for frame in frames:
        kind, number, other = frame.id >> 24, frame.id >> 16 & 0xFF, frame.id & 0xFF
        if kind in (UNSOLICITED_FIRST, UNSOLICITED_BODY):
            data += frame.data[:-1]
        elif kind == UNSOLICITED_LAST:
            whole = data + frame.data[:-1] if data else frame.data
            answers.append(Answer("unsolicited", data=whole, row_id=number, other=other))
            data = b""
    return answers
