"""The tester's side of a device on a serial line, in any of the three reply dialects."""

from __future__ import annotations

from typing import Final

from starhil.hil_tests.conformance.case import CaseFailed
from starhil.hil_tests.conformance.link_probe import (
    BURST_ID,
    FIRST_TELEMETRY,
    Answer,
    LinkProbe,
    ProbeTimes,
    SerialWire,
)
from starhil.hil_tests.conformance.ports import Port
from starhil.protocol.codec import Row
from starhil.protocol.icd import InterfaceDefinition

BURST_BODY: Final = 23
"""Size of an ID, a packet number and 20 bytes of data."""

GENERATION_2: Final = {0x07: "ack", 0x0F: "nack", 0x2F: "event", 0x4F: "unsolicited"}


def framed(row_id: int, data: bytes = b"") -> bytes:
    """Frame a request: 1F 7F, ID and data with each 1F doubled, 1F FF."""
    return b"\x1f\x7f" + (bytes([row_id]) + data).replace(b"\x1f", b"\x1f\x1f") + b"\x1f\xff"


class SerialProbe(SerialWire, LinkProbe):
    """Talks to CubeStar over a serial port.

    Parameters
    ----------
    port
        The port.
    icd
        Rows and names.
    dialect
        `a`, `b` or `c`.
    baud
        Bit rate of the line, for the cases on its pace; None if unknown.
    """

    def __init__(
        self,
        port: Port[bytes],
        icd: InterfaceDefinition,
        *,
        dialect: str = "b",
        baud: int | None = None,
        times: ProbeTimes | None = None,
    ) -> None:
        super().__init__(port, icd, times)
        self.dialect = dialect
        self.baud = baud
        self._buffer = bytearray()
        self._asked: list[int] = []

    def answers(self, row_id: int) -> bool:
        """Return whether the definition has an answer to a request on the serial line."""
        row = self.icd.row_by_id(row_id)
        serial = self.icd.link.serial
        framing = None if serial is None else serial.framing
        return row is None or row.name not in getattr(framing, "unanswered", ())

    def tells_refusal(self, row: Row) -> bool:
        """Return whether a refusal differs from the data, which in dialects a and b may be one byte as well."""
        return self.dialect == "c" or row.size != 1

    def post(self, row_id: int, data: bytes = b"") -> None:
        """Send a request without waiting."""
        if self.answers(row_id):
            self.expecting(row_id)
        self.send(framed(row_id, data))

    def expecting(self, *answers: str | int) -> None:
        """Record the requested rows in order, because answers in dialect b contain no ID."""
        self._asked.extend(map(int, answers))

    def expect_exactly(self, answer: str) -> None:
        """Take the next answer, which must be the telemetry of the row with this ID."""
        self.expect_telemetry(int(answer))

    def send_text(self, text: str) -> None:
        """Send bytes written in hexadecimal."""
        self.send(bytes.fromhex(text))

    def _receive(self, timeout_s: float) -> bool:
        data = self.port.receive(timeout_s)
        if data is None:
            return False
        self._note("<-", data)
        self._buffer += data
        return True

    def drain(self) -> None:
        """Discard everything received."""
        super().drain()
        self._buffer.clear()
        self._asked.clear()

    def unexpected_answer(self, quiet_s: float) -> Answer:
        """Return an unexpected answer."""
        self.sleep(quiet_s)
        while (packet := self._packet()) is not None:
            answer = self._answer(*packet)
            if answer.kind != "unsolicited":
                return answer
        return self._malformed() if self._buffer else Answer("none")

    def receive_unsolicited(self, seconds: float) -> list[Answer]:
        """Return the messages of unsolicited telemetry that arrive within a time.

        Anything else fails the case.
        """
        self.sleep(seconds)
        found = []
        while (packet := self._packet()) is not None:
            answer = self._answer(*packet)
            if answer.kind != "unsolicited":
                raise CaseFailed("nothing but unsolicited telemetry", str(answer))
            found.append(answer)
        return found

    def next_answer(self, timeout_s: float | None = None) -> Answer:
        """Return the next unread answer."""
        end = self.now() + (self.times.answer_s if timeout_s is None else timeout_s)
        while True:
            if (packet := self._packet()) is not None:
                answer = self._answer(*packet)
                if answer.kind != "unsolicited":
                    return answer
                continue
            if len(self._buffer) >= 2 and not self._starts_well():
                return self._malformed()
            left = end - self.now()
            if left <= 0 or not self._receive(left):
                self._asked.clear()
                return self._malformed() if self._buffer else Answer("none")

    def _starts_well(self) -> bool:
        starts = (0x7F, *GENERATION_2) if self.dialect == "c" else (0x7F,)
        return self._buffer[0] == 0x1F and self._buffer[1] in starts

    def _malformed(self) -> Answer:
        data = bytes(self._buffer)
        self._buffer.clear()
        return Answer("malformed", data=data)

    def _packet(self) -> tuple[int, bytes] | None:
        """Remove a complete packet from the buffer; return its start byte and unstuffed body, or None."""
        if len(self._buffer) < 2 or not self._starts_well():
            return None
        body = bytearray()
        position = 2
        while position < len(self._buffer):
            byte = self._buffer[position]
            if byte != 0x1F:
                body.append(byte)
                position += 1
                continue
            if position + 1 >= len(self._buffer):
                return None
            follower = self._buffer[position + 1]
            if follower == 0xFF:
                start = self._buffer[1]
                del self._buffer[: position + 2]
                return start, bytes(body)
            if follower != 0x1F:
                return -1, self._malformed().data
            body.append(0x1F)
            position += 2
        return None

    def _answer(self, start: int, body: bytes) -> Answer:
        if start < 0 or (not body and self.dialect != "b"):
            return Answer("malformed", data=body)
        if start == 0x7F and len(body) == BURST_BODY and body[0] == BURST_ID and not self._expects(len(body)):
            return Answer("burst", data=body[1:], row_id=BURST_ID)
        if self.dialect == "c":
            return self._answer_generation_2(start, body)
        if self.dialect == "b":
            if not self._asked:
                return Answer("malformed", data=body)
            return self._answer_generation_1(self._asked.pop(0), body, None)
        if self._asked and self._asked[0] == body[0]:
            self._asked.pop(0)
        return self._answer_generation_1(body[0], body[1:], body[0])

    def _expects(self, size: int) -> bool:
        """Return whether the requested row has the size of a burst packet, in dialect b."""
        row = self.icd.telemetry_by_id.get(self._asked[0]) if self._asked and self.dialect == "b" else None
        return row is not None and row.size == size

    def _answer_generation_1(self, row_id: int, data: bytes, seen: int | None) -> Answer:
        """Interpret an answer of generation 1: telemetry, or one byte for an acknowledge or refusal."""
        row = self.icd.telemetry_by_id.get(row_id)
        if row is not None and len(data) == row.size:
            return Answer("telemetry", data=data, row_id=seen)
        is_telecommand = row_id < FIRST_TELEMETRY
        if len(data) != 1:
            return Answer("malformed" if is_telecommand else "telemetry", data=data, row_id=seen)
        if data[0] == 0:
            return Answer("ack" if is_telecommand else "malformed", data=data, row_id=seen)
        return Answer("nack", code=data[0], row_id=seen)

    def _answer_generation_2(self, start: int, body: bytes) -> Answer:
        row_id, data = body[0], body[1:]
        match GENERATION_2.get(start):
            case "ack" if row_id >= FIRST_TELEMETRY:
                return Answer("telemetry", data=data, row_id=row_id)
            case "ack" if not data:
                return Answer("ack", row_id=row_id)
            case "nack" if len(data) == 1 and data[0]:
                return Answer("nack", code=data[0], row_id=row_id)
            case "unsolicited" | "event":
                return Answer("unsolicited", data=data, row_id=row_id)
            case _:
                return Answer("malformed", data=body)
