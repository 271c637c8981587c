"""The tester's side of a unit on a serial line."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Final

from starhil.hil_tests.conformance.link_probe import LinkProbe, ProbeTimes, Settings
from starhil.hil_tests.conformance.ports import Port
from starhil.hil_tests.judge.definition import Unit
from starhil.hil_tests.judge.messages import Answer, Request
from starhil.hil_tests.judge.rows import Row
from starhil.hil_tests.judge.serial import SerialLine

DEFAULT_BAUD: Final = 115200
BITS_A_BYTE: Final = 10
PAUSE: Final = 1.6
"""Silence after which a message has certainly timed out, as a multiple of the time-out."""
GAP_S: Final = 0.05
"""Silence after which a message that has begun has no more bytes."""


class SerialProbe(LinkProbe):
    """Talks to a unit over a serial port.

    `dialect` is that of the answers, of a unit that has several; `baud` the bit rate of the line, None if unknown; `raw` are all
    bytes received since the last drain, without unsolicited telemetry, `sent` those sent last, and `numbered` the messages since
    the last drain to which the unit has given a number.
    """

    link = "serial"

    def __init__(
        self,
        port: Port[bytes],
        unit: Unit,
        *,
        dialect: str | None = None,
        baud: int | None = None,
        times: ProbeTimes | None = None,
        settings: Settings | None = None,
    ) -> None:
        super().__init__(port, unit, times, settings)
        self.line = SerialLine(unit, dialect)
        self.dialect = self.line.dialect
        self.baud = baud
        self.has_unsolicited = self.line.envelope.has_unsolicited
        self.has_codes = self.line.envelope.has_codes
        self.names_rows = self.line.envelope.names_rows
        self.numbers = self.line.envelope.numbers
        self.raw = b""
        self.sent = b""
        self._line_free = 0.0
        self._answers: deque[Answer] = deque()
        self.numbered: list[Answer] = []

    # --- the line ---

    def send(self, data: bytes) -> None:
        self._note("->", data)
        self.sent = data
        self.port.send(data)
        seconds = len(data) * BITS_A_BYTE / (self.baud or DEFAULT_BAUD)
        self._line_free = max(self._line_free, self.now()) + seconds

    def _note(self, way: str, data: bytes) -> None:
        self.log.append(f"{self.now():.4f} {way} {data.hex(' ').upper()}")

    def _receive(self, timeout_s: float) -> bool:
        data = self.port.receive(timeout_s)
        if data is None:
            return False
        self._note("<-", data)
        self.raw += data
        for answer in self.line.feed(data):
            if answer.number is not None:
                self.numbered.append(answer)
            if answer.kind == "unsolicited":
                self.unsolicited.append(answer)
                self.raw = self.raw.replace(
                    self.line.telemetry_frame(answer.body, answer.message_class), b"", 1
                )
            else:
                self._answers.append(answer)
        return True

    def _complete(self) -> None:
        """Wait for the rest of a message that has begun, such as unsolicited telemetry."""
        while self.line.received and self._receive(GAP_S):
            pass

    def drain(self) -> None:
        """Discard everything received and expected."""
        while self._receive(0.0):
            pass
        self._complete()
        self.raw = b""
        self.line.clear()
        self._answers.clear()
        self.unsolicited.clear()
        self.numbered.clear()

    def sleep_past_timeout(self) -> None:
        """Wait until what was sent has passed the line, and an incomplete message has timed out."""
        self.sleep(max(0.0, self._line_free - self.now()) + PAUSE * float(self.unit.serial.timeout))

    # --- answers ---

    def answers(self, row: Row) -> Sequence[str]:
        return self.unit.serial_answers(row)

    @contextmanager
    def streaming(self, rows: Iterable[Row]) -> Iterator[None]:
        """Take messages of these rows that no request awaits for unsolicited telemetry."""
        before = self.line.streamed
        self.line.streamed = before.union((row.message_class, row.id) for row in rows)
        try:
            yield
        finally:
            self.line.streamed = before

    def can_refuse(self, message_class: str) -> bool:
        """Return whether answers of a class can express a refusal."""
        return self.line.envelope.can_refuse(message_class)

    def distinguishes_refusal(self, row: Row) -> bool:
        """Return whether a refusal differs from the data, which in dialects a and b may be one byte as well."""
        return self.dialect not in ("a", "b") or row.size != 1

    def exchange(self, sent: Sequence[str], answers: Sequence[str]) -> None:
        """Send bytes, and take the telemetry or the refusal of each row."""
        requests = [self.unit.request(int(answer.partition("!")[0])) for answer in answers]
        for request in requests:
            self.line.expect(request)
        self.send(bytes.fromhex("".join(sent)))
        for request, answer in zip(requests, answers, strict=True):
            row, error = self.unit.row(request), answer.partition("!")[2]
            if error or row is None:
                self.expect_nack(f"refusal of {request}", error)
            else:
                self.expect_telemetry(row)

    def post_request(self, request: Request, *, answered: bool = True) -> None:
        """Send a request without waiting."""
        self.send(self.line.post(request, answered=answered))

    def next_answer(self, timeout_s: float | None = None) -> Answer:
        """Return the next unread answer; after none, no answer is awaited any more."""
        answer = super().next_answer(timeout_s)
        if answer.kind == "none":
            self.line.clear()
        return answer

    def _answer_within(self, seconds: float) -> Answer | None:
        """Return the next answer, when a message that has begun is complete; bytes without an end are a malformed one."""
        end = self.now() + seconds
        while not self._answers and (left := end - self.now()) > 0:
            self._receive(left)
        self._complete()
        if self._answers:
            return self._answers.popleft()
        rest = bytes(self.line.received)
        if rest:
            self.line.clear()
        return Answer("malformed", data=rest) if rest else None

    def _unsolicited_answers(self) -> list[Answer]:
        self._complete()
        return list(self.unsolicited)
