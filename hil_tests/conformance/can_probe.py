"""The tester's side of a CAN link with the CubeSpace layout of CAN IDs; checks every frame."""

from __future__ import annotations

from typing import Final

from starhil.hil_tests.conformance.case import CaseFailed, check
from starhil.hil_tests.conformance.link_probe import (
    BURST_ID,
    FIRST_TELEMETRY,
    Answer,
    AnswerKind,
    LinkProbe,
    PortProbe,
    ProbeTimes,
)
from starhil.hil_tests.conformance.ports import Port
from starhil.hil_tests.raw_traffic import format_frame, matches, parse_frame, pattern
from starhil.protocol.can_framing import CanFrame
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.messages import ErrorCode

TELECOMMAND: Final = 1
TELEMETRY_REQUEST: Final = 4
TELEMETRY_NACK: Final = 6
TELECOMMAND_SEGMENT: Final = 7
UNSOLICITED_FIRST: Final = 10
UNSOLICITED_BODY: Final = 11
UNSOLICITED_LAST: Final = 12
UNSOLICITED: Final = (9, UNSOLICITED_FIRST, UNSOLICITED_BODY, UNSOLICITED_LAST)


def can_id_of(kind: int, number: int, source: int, destination: int) -> int:
    """Return a 29-bit CAN ID: type[28:24], row ID[23:16], source[15:8], destination[7:0]."""
    return kind << 24 | number << 16 | source << 8 | destination


def segments(data: bytes) -> list[bytes]:
    """Split data into segments of 7 bytes, each with a byte that counts the remaining ones."""
    parts = [data[start : start + 7] for start in range(0, len(data), 7)]
    return [part + bytes([len(parts) - 1 - number]) for number, part in enumerate(parts)]


class CanWire(PortProbe):
    """Sends requests and decodes answers on a CAN bus, for the rows of any unit.

    Parameters
    ----------
    bus
        The bus.
    icd
        Rows and names.
    host, device
        CAN addresses of the tester and of the device.
    """

    link = "can"

    def __init__(
        self,
        bus: Port[CanFrame],
        icd: InterfaceDefinition,
        *,
        host: int = 1,
        device: int = 4,
        times: ProbeTimes | None = None,
    ) -> None:
        super().__init__(bus, icd, times)
        self.host = host
        self.device = device
        self.unsolicited: list[CanFrame] = []
        self._frames: list[CanFrame] = []

    def post_as(self, source: int, row_id: int, data: bytes = b"") -> None:
        """Send a request from a given address."""
        kind = TELEMETRY_REQUEST if row_id >= FIRST_TELEMETRY else TELECOMMAND
        payloads = [data]
        if len(data) > 8:
            kind, payloads = TELECOMMAND_SEGMENT, segments(data)
        for payload in payloads:
            self.send(CanFrame(can_id_of(kind, row_id, source, self.device), payload))

    def send(self, frame: CanFrame) -> None:
        """Send a raw frame."""
        self.log.append(f"{self.now():.4f} -> {format_frame(frame)}")
        self.port.send(frame)

    def send_text(self, text: str) -> None:
        """Send a frame in the format of `cansend`, with HH and DD for the addresses."""
        self.send(parse_frame(self.with_addresses(text)))

    def expecting(self, *answers: str) -> None:
        """Do nothing: an answer contains its row ID."""

    def expect_exactly(self, answer: str) -> None:
        """Take the next frame, which must match a pattern with HH, DD, and `..` for any byte."""
        wanted = pattern(self.with_addresses(answer))
        frame = self.next_frame()
        seen = "nothing" if frame is None else format_frame(frame)
        check(matches(wanted, seen), wanted, seen)

    def with_addresses(self, text: str) -> str:
        """Replace HH and DD in the text of a frame by the addresses of host and device."""
        return text.replace("HH", f"{self.host:02X}").replace("DD", f"{self.device:02X}")

    def _receive(self, timeout_s: float) -> bool:
        frame = self.port.receive(timeout_s)
        if frame is None:
            return False
        if not frame.extended or frame.remote or frame.id >> 8 & 0xFF != self.device:
            return True
        self.log.append(f"{self.now():.4f} <- {format_frame(frame)}")
        if frame.id >> 24 in UNSOLICITED:
            self.unsolicited.append(frame)
        else:
            self._frames.append(frame)
        return True

    def drain(self) -> None:
        """Discard everything received."""
        super().drain()
        self._frames.clear()
        self.unsolicited.clear()

    def unexpected_answer(self, quiet_s: float) -> Answer:
        """Return an unexpected answer."""
        self.sleep(quiet_s)
        return self._read(0.0) if self._frames else Answer("none")

    def receive_unsolicited(self, seconds: float) -> list[Answer]:
        """Return the messages of unsolicited telemetry that arrive within a time."""
        self.unsolicited.clear()
        self.sleep(seconds)
        found, data = [], b""
        for frame in self.unsolicited:
            kind, number, other = frame.id >> 24, frame.id >> 16 & 0xFF, frame.id & 0xFF
            if kind in (UNSOLICITED_FIRST, UNSOLICITED_BODY):
                data += frame.data[:-1]
            elif kind == UNSOLICITED_LAST:
                whole = data + frame.data[:-1] if data else frame.data
                found.append(Answer("unsolicited", data=whole, row_id=number, other=other))
                data = b""
        return found

    def next_frame(self, timeout_s: float | None = None) -> CanFrame | None:
        """Return the next frame of the device that is not unsolicited, or None."""
        end = self.now() + (self.times.answer_s if timeout_s is None else timeout_s)
        while not self._frames:
            left = end - self.now()
            if left <= 0 or not self._receive(left):
                break
        return self._frames.pop(0) if self._frames else None

    def next_answer(self, timeout_s: float | None = None) -> Answer:
        """Return the next unread answer."""
        return self._read(self.times.answer_s if timeout_s is None else timeout_s)

    def expect_answer(self, kind: AnswerKind, what: str, code: ErrorCode | None = None) -> Answer:
        """Take the next answer, which must be of a given kind, with a code if one is given."""
        answer = self.next_answer()
        number = None if code is None else int(self.icd.error_number(code))
        if answer.kind != kind or number not in (None, answer.code):
            raise CaseFailed(what, str(answer))
        return answer

    def _read(self, timeout_s: float) -> Answer:
        frame = self.next_frame(timeout_s)
        if frame is None:
            return Answer("none")
        kind, number = frame.id >> 24, frame.id >> 16 & 0xFF
        other = frame.id & 0xFF
        telemetry = number >= FIRST_TELEMETRY
        match kind:
            case 2 if not frame.data and not telemetry:
                return Answer("ack", row_id=number, other=other)
            case 3 | 6 if len(frame.data) == 1 and frame.data[0] and (kind == TELEMETRY_NACK) == telemetry:
                return Answer("nack", code=frame.data[0], row_id=number, other=other)
            case 5 if telemetry:
                return Answer("telemetry", data=frame.data, row_id=number, other=other)
            case 8 if telemetry or number == BURST_ID:
                return self._segmented(frame, number, other)
            case _:
                return Answer("malformed", data=frame.id.to_bytes(4, "big") + frame.data)

    def _segmented(self, first: CanFrame, number: int, other: int) -> Answer:
        """Join the segments of one message; a wrong counter or a short segment makes it malformed."""
        data = b""
        frame: CanFrame | None = first
        left = first.data[-1] if first.data else 0
        while frame is not None and frame.id == first.id and frame.data and frame.data[-1] == left:
            data += frame.data[:-1]
            if left == 0:
                kind: AnswerKind = "burst" if number == BURST_ID else "telemetry"
                return Answer(kind if len(data) > 8 else "malformed", data=data, row_id=number, other=other)
            if len(frame.data) != 8:
                break
            left -= 1
            frame = self.next_frame()
        seen = b"" if frame is None else frame.data
        return Answer("malformed", data=data + seen, row_id=number, other=other)


class CanProbe(CanWire, LinkProbe):
    """Talks to CubeStar over a CAN bus."""

    def post(self, row_id: int, data: bytes = b"") -> None:
        """Send a request without waiting."""
        self.post_as(self.host, row_id, data)
