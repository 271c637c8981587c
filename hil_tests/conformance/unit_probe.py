"""The tester's side of any unit, based on its definition: rows on any link, and the serial line."""

from __future__ import annotations

from abc import abstractmethod
from collections import deque
from collections.abc import Sequence
from typing import Any, Final

from starhil.hil_tests.conformance.case import CaseFailed, check, check_equal
from starhil.hil_tests.conformance.link_probe import (
    SHOWN_BYTES,
    PortProbe,
    ProbeTimes,
    SerialWire,
    checked_values,
)
from starhil.hil_tests.conformance.ports import Port
from starhil.protocol.codec import Row
from starhil.protocol.composed_stack import ComposedStack
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.messages import ErrorCode, LinkFault, Reply, ReplyKind, Request
from starhil.protocol.serial_framing import Dialect
from starhil.protocol.serial_stack import build_serial_stack, serial_answers
from starhil.protocol.values import Value

PAUSE: Final = 1.6
"""Silence after which a message has certainly timed out, as a multiple of the time-out."""


class UnitProbe(PortProbe):
    """Talks to a unit over a link.

    Attributes
    ----------
    lively
        Row that is requested to check that the unit answers.
    """

    def __init__(self, port: Port[Any], icd: InterfaceDefinition, times: ProbeTimes | None) -> None:
        super().__init__(port, icd, times)
        self.lively = min(icd.telemetry.values(), key=lambda row: row.size)
        self._settings: list[tuple[Row, bytes]] = []

    # --- the link ---

    @abstractmethod
    def post(self, request: Request, *, answered: bool = True) -> None:
        """Send a request without waiting; `answered` unless no answer is expected."""

    @abstractmethod
    def next_reply(self) -> Reply | LinkFault | None:
        """Return the next reply, or None if none arrives in time."""

    @abstractmethod
    def unsolicited_replies(self, seconds: float) -> list[Reply]:
        """Return the messages of unsolicited telemetry that arrive within a time."""

    def answers(self, row: Row) -> tuple[str, ...]:
        """Return the answers of a row on this link."""
        return row.answers

    def can_refuse(self, klass: str) -> bool:  # noqa: ARG002 -- for links on which it depends
        """Return whether replies of a class can express a refusal."""
        return True

    @property
    def has_codes(self) -> bool:
        """Whether a refusal carries a code."""
        return True

    # --- requests ---

    def request(self, row: Row, data: bytes = b"") -> Request:
        """Return the request for a row."""
        return self.icd.request(row, data)

    def ask(self, request: Request) -> Reply | LinkFault | None:
        """Send a request and return the answer; of an answer in several parts, return the last."""
        self.post(request)
        answer = self.next_reply()
        while isinstance(answer, Reply) and not answer.final:
            answer = self.next_reply()
        return answer

    def telemetry(self, row: Row) -> Reply:
        """Return the telemetry of a row; any other answer fails the case."""
        self.post(self.request(row))
        return self.expect_telemetry(row)

    def expect_telemetry(self, row: Row) -> Reply:
        """Take the next answer, which must be the telemetry of a row."""
        answer = self.next_reply()
        what = f"telemetry {row.name} of {row.size} bytes"
        if not isinstance(answer, Reply) or answer.kind is not ReplyKind.TELEMETRY:
            raise CaseFailed(what, describe(answer))
        if (answer.id, answer.klass, len(answer.data)) != (row.id, row.klass, row.size):
            raise CaseFailed(what, describe(answer))
        return answer

    def values(self, row: Row) -> dict[str, Value]:
        """Return the checked values of a telemetry row."""
        return checked_values(row, self.telemetry(row).data)

    def command(self, row: Row, data: bytes) -> None:
        """Send a telecommand that must be accepted, or not answered if the row has no answer on this link."""
        if not self.answers(row):
            self.post(self.request(row, data), answered=False)
            self.expect_silence(f"{row.name} is not answered on this link")
            return
        answer = self.ask(self.request(row, data))
        accepted = isinstance(answer, Reply) and answer.kind is ReplyKind.ACK and answer.id == row.id
        check(accepted, f"acknowledge of {row.name}", describe(answer))

    def expect_refusal(self, request: Request, code: ErrorCode) -> None:
        """Send a request that must be refused, or not answered if replies cannot express a refusal."""
        what = f"{request.klass} {request.id}".strip()
        row = self.icd.rows_by_key.get((request.klass, request.id))
        if not self.can_refuse(request.klass) or (row is not None and not self.answers(row)):
            self.post(request, answered=False)
            self.expect_silence(f"no reply can express the refusal of {what}")
            return
        answer = self.ask(request)
        refused = isinstance(answer, Reply) and answer.kind is ReplyKind.NACK
        check(refused, f"refusal of {what}", describe(answer))
        if isinstance(answer, Reply) and self.has_codes:
            check_equal(int(answer.code), int(self.icd.error_number(code)), f"code of the refusal of {what}")

    def expect_alive(self) -> None:
        """Fail the case unless the next valid request is answered."""
        self.drain()
        self.telemetry(self.lively)

    # --- around a run ---

    def silence(self, *, booting: bool) -> str | None:
        """Send three requests; return None if one is answered correctly, otherwise the invalid answer."""
        end = self.now() + (self.times.boot_s if booting else 0.0)
        while True:
            self.drain()
            answer = self.ask(self.request(self.lively))
            if isinstance(answer, Reply) and len(answer.data) == self.lively.size:
                return None
            if self.now() >= end:
                return describe(answer)

    def settings(self) -> Sequence[tuple[Row, Row]]:
        """Return the telecommands whose values a telemetry row reports, each with this row."""
        rows = ((row, next(iter(row.named_fields.values()), None)) for row in self.icd.telemetry.values())
        return [
            (self.icd.telecommands[field.telecommand], row)
            for row, field in rows
            if field is not None and field.telecommand is not None
        ]

    def prepare(self) -> None:
        """Record the settings that can be read."""
        self._settings = [(command, self.telemetry(row).data) for command, row in self.settings()]

    def restore(self) -> None:
        """Restore the settings."""
        self.recover()
        self.drain()
        for command, data in self._settings:
            self.command(command, data)


class SerialUnitProbe(SerialWire, UnitProbe):
    """Talks to a unit over a serial port.

    Parameters
    ----------
    port
        The port.
    icd
        Definition of the unit.
    style
        Dialect of the replies, if the unit has dialects.
    """

    def __init__(
        self,
        port: Port[bytes],
        icd: InterfaceDefinition,
        *,
        style: Dialect | None = None,
        times: ProbeTimes | None = None,
    ) -> None:
        super().__init__(port, icd, times)
        self.stack = build_serial_stack(icd)
        self.timeout_s = icd.link.serial.timeout if icd.link.serial is not None else 0.5
        self.style = style or getattr(self.stack, "dialect", None)
        """Dialect of the replies, if the unit has dialects."""
        self.drain()

    # --- the line ---

    def answers(self, row: Row) -> tuple[str, ...]:
        """Return the answers of a row on the serial line."""
        return serial_answers(self.icd, row)

    def sleep_past_timeout(self) -> None:
        """Wait until an incomplete message has timed out."""
        self.sleep(PAUSE * self.timeout_s)

    def drain(self) -> None:
        """Discard everything received and expected."""
        super().drain()
        self.raw = b""
        """All bytes received since the last drain."""
        self._received = bytearray()
        self._receiver = self.stack.host(self.style)
        self._expected: deque[tuple[Request, int]] = deque()
        self._replies: deque[Reply | LinkFault] = deque()
        self._unsolicited: list[Reply] = []

    def _receive(self, timeout_s: float) -> bool:
        data = self.port.receive(timeout_s)
        if data is None:
            return False
        self._note("<-", data)
        self.raw += data
        self._received += data
        while self._received:  # byte by byte, because each reply determines what is expected next
            self._receive_byte(self._received.pop(0))
        return True

    def _receive_byte(self, byte: int) -> None:
        for event in self._receiver.feed(bytes((byte,)), self.now()):
            if isinstance(event, Reply) and event.kind in (ReplyKind.UNSOLICITED, ReplyKind.EVENT):
                self._unsolicited.append(event)
                continue
            self._replies.append(event)
            if self._expected and (isinstance(event, LinkFault) or event.final):
                self._expected.popleft()
                self._expect_next()

    def _expect_next(self) -> None:
        if self._expected:
            self._receiver.expect(*self._expected[0])

    # --- requests ---

    def expecting(self, *requests: Request) -> None:
        """Record the requests, in order."""
        for request in requests:
            row = self.icd.rows_by_key.get((request.klass, request.id))
            self._expected.append((request, row.size if row is not None and row.kind == "telemetry" else 0))
            if len(self._expected) == 1:
                self._expect_next()

    def post(self, request: Request, *, answered: bool = True) -> None:
        """Send a request without waiting."""
        if answered:
            self.expecting(request)
        self.send(self.stack.encode_request(request))

    def next_reply(self) -> Reply | LinkFault | None:
        """Return the next reply, or None if none arrives in time; data in several parts are joined."""
        end = self.now() + self.times.answer_s
        while not self._replies and (left := end - self.now()) > 0:
            self._receive(left)
        return self._replies.popleft() if self._replies else None

    def can_refuse(self, klass: str) -> bool:
        """Return whether replies of a class can express a refusal."""
        stack = self.stack
        return not isinstance(stack, ComposedStack) or bool(
            stack.reply_header.roles_in(klass) & {"status", "ack"}
        )

    @property
    def has_codes(self) -> bool:
        """Whether a refusal carries a code."""
        return not isinstance(self.stack, ComposedStack) or "status" in self.stack.reply_header.roles

    def expect_silence(self, why: str, seconds: float | None = None) -> None:
        """Fail the case if anything arrives within a time."""
        before = len(self.raw)
        self.sleep(self.times.quiet_s if seconds is None else seconds)
        check(len(self.raw) == before, f"nothing ({why})", self.raw[before:][:SHOWN_BYTES])

    def unsolicited_replies(self, seconds: float) -> list[Reply]:
        """Return the messages of unsolicited telemetry that arrive within a time."""
        self._unsolicited.clear()
        self.sleep(seconds)
        return list(self._unsolicited)


def describe(answer: Reply | LinkFault | None) -> str:
    """Describe an answer in one line."""
    if answer is None:
        return "nothing"
    if isinstance(answer, LinkFault):
        return f"malformed: {answer.detail}"
    code = f" with code {int(answer.code)}" if answer.kind is ReplyKind.NACK else ""
    where = f"{answer.klass} {answer.id}".strip()
    return f"{answer.kind.value} {where}{code}, {len(answer.data)} bytes: {answer.data[:24].hex(' ')}"
