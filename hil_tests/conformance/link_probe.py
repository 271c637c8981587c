"""The tester's side of a serial or CAN link, for any unit: requests, strict decoding of answers, and a log.

The judge (`starhil.hil_tests.judge`) encodes and decodes; a probe adds the port, its clock and the time-outs.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final, Protocol

from starhil.hil_tests.conformance.case import CaseFailed, CaseSkipped, Probe, check, check_equal
from starhil.hil_tests.conformance.ports import Port
from starhil.hil_tests.judge.definition import Unit
from starhil.hil_tests.judge.messages import Answer, Request, Value
from starhil.hil_tests.judge.rows import Row

INVALID_ID: Final = "invalid_id"
INVALID_LENGTH: Final = "invalid_length"
INVALID_PARAMETER: Final = "invalid_parameter"
INVALID_CRC: Final = "crc"
SEQUENCE: Final = "sequence"

SETTING_ACTIONS: Final = frozenset({None, "nothing", "set_parameters", "subscribe", "select_unsolicited"})
"""Actions of the device model that repeating a telecommand with the same data does not carry out again."""
UNSOLICITED_PARAMETERS: Final = frozenset({"unsolicited_rate", "unsolicited_selection"})
"""Parameters that change what a unit sends unasked."""
LONG_PAUSE_S: Final = 0.8
"""Pause after which the device has abandoned an incomplete message (after 0.5 s)."""
LATE_S: Final = 1.0
"""Time after the time-out in which an answer is still taken, to be named as late."""
FRAME_S: Final = 10.0
"""Longest time from one measurement to the next."""
RECOVERY_S: Final = 1.0
"""Pause after a failed case, in which time-outs of the device pass."""
LIVELY_SIZE: Final = 8
"""Bytes of telemetry in which a lost or shifted byte shows."""
REPORT_QUANTITIES: Final = {
    "request.last": "last telecommand",
    "request.error": "its error",
    "request.index": "index of the refused field",
}
"""Quantities by which a telemetry row reports the last telecommand."""


@dataclass(frozen=True)
class ProbeTimes:
    """Timeouts of the tester."""

    answer_s: float = 1.0
    """Maximum time for an answer."""
    quiet_s: float = 0.1
    """Silence that counts as no answer."""
    boot_s: float = 15.0
    """Maximum time from a reset to the first answer in standby."""
    image_s: float = 20.0
    """Maximum time for taking an image."""


class Settings(Protocol):
    """The settings of a unit that a run changes and restores."""

    def prepare(self, probe: LinkProbe) -> None:
        """Record the settings, and set those that the cases need."""

    def restore(self, probe: LinkProbe) -> None:
        """Restore the recorded settings; raises CaseFailed, which names those that the unit does not accept."""


class ReadableSettings:
    """Settings for any unit: the telecommands whose values a telemetry row reports, unless they do something once, such as a reset."""

    def __init__(self) -> None:
        self._found: list[tuple[Row, dict[str, Value]]] = []

    def prepare(self, probe: LinkProbe) -> None:
        kept = SETTING_ACTIONS.union(probe.unit.plugin.actions if probe.unit.plugin is not None else ())
        for command, row, places in probe.unit.reported:
            if command.action in kept and not changes_link(probe.unit, command):
                seen = probe.telemetry(row.name)
                self._found.append((command, {name: seen[place] for name, place in places.items()}))

    def restore(self, probe: LinkProbe) -> None:
        for command, values in self._found:
            probe.command(command.name, **values)


def changes_link(unit: Unit, command: Row) -> bool:
    """Return whether a telecommand sets how the unit is reached, or what it sends unasked."""
    names = {item.parameter for item in command.named.values() if item.parameter is not None}
    return any(name in UNSOLICITED_PARAMETERS or unit.device_parameters[name].of_link for name in names)


def lively_row(unit: Unit, can_refuse: Callable[[str], bool]) -> Row:
    """Return the smallest row whose errors show: of several bytes, in a class that can be refused, read without effect."""

    def unsuitable(row: Row) -> tuple[bool, bool, bool, int]:
        return row.action is not None, not can_refuse(row.message_class), row.size < LIVELY_SIZE, row.size

    return min(unit.readable.values(), key=unsuitable)


class LinkProbe(Probe):
    """Talks to a unit over a serial or CAN link.

    `settings` are what a run restores; by default, those that can be read.
    `unsolicited` has the unsolicited telemetry since `drain` or `receive_unsolicited`: messages on serial, frames on CAN.
    """

    has_unsolicited = True
    """Whether the link carries unsolicited telemetry."""
    numbers = 0
    """How many numbers the header has for messages; 0 if it has none."""
    has_codes = True
    """Whether a refusal carries a code."""
    names_rows = True
    """Whether an answer names its row."""

    def __init__(
        self, port: Port[Any], unit: Unit, times: ProbeTimes | None, settings: Settings | None = None
    ) -> None:
        super().__init__(port)
        self.unit = unit
        self.times = times or ProbeTimes()
        self.settings = settings or ReadableSettings()
        self.unsolicited: list[Any] = []
        self._prepared = False

    @cached_property
    def lively(self) -> Row:
        """Row that is requested to check that the unit answers."""
        return lively_row(self.unit, self.can_refuse)

    # --- the link ---

    @abstractmethod
    def post_request(self, request: Request, *, answered: bool = True) -> None:
        """Send a request without waiting; `answered` unless no answer is expected."""

    @property
    def addresses(self) -> Mapping[str, str]:
        """Names in braces for the addresses on the link, which a case written as text has in its traffic."""
        return {}

    @abstractmethod
    def exchange(self, sent: Sequence[str], answers: Sequence[str]) -> None:
        """Send raw traffic, and take the answers to it, which must be these; both in the format of `dialogue`."""

    @abstractmethod
    def _answer_within(self, seconds: float) -> Answer | None:
        """Return the next unread answer that arrives within a time; unsolicited telemetry is put aside."""

    def next_answer(self, timeout_s: float | None = None) -> Answer:
        """Return the next unread answer; none, which names one that comes after the time-out."""
        began = self.now()
        answer = self._answer_within(self.times.answer_s if timeout_s is None else timeout_s)
        if answer is not None:
            return answer
        late = self._answer_within(LATE_S)
        seconds = self.now() - began
        return Answer("none", fault=f"late: {late} after {seconds:.1f} s; see --time-out" if late else "")

    def unexpected_answer(self, quiet_s: float) -> Answer:
        self.sleep(quiet_s)
        return self._answer_within(0.0) or Answer("none")

    def receive_unsolicited(self, seconds: float, after: Callable[[], None] | None = None) -> list[Answer]:
        """Return the messages of unsolicited telemetry that arrive within a time, counted from the end of an action."""
        self.unsolicited.clear()
        if after is not None:
            after()
        self.sleep(seconds)
        return self._unsolicited_answers()

    @abstractmethod
    def _unsolicited_answers(self) -> list[Answer]:
        """Return the messages in `unsolicited`."""

    @contextmanager
    def streaming(self, rows: Iterable[Row]) -> Iterator[None]:  # noqa: ARG002 -- where messages say it themselves
        """Take messages of these rows that no request awaits for unsolicited telemetry."""
        yield

    def check_numbers(self, answers: Sequence[Answer]) -> None:
        """Fail the case unless the numbers that the unit has given successive messages are successive."""
        seen = [answer.number for answer in answers if answer.number is not None]
        if seen:
            check_equal(seen, [(seen[0] + step) % self.numbers for step in range(len(seen))], "the numbers")

    @abstractmethod
    def _receive(self, timeout_s: float) -> bool:
        """Store the next input; return whether anything arrived in time."""

    def answers(self, row: Row) -> Sequence[str]:
        return row.answers

    def can_refuse(self, message_class: str) -> bool:  # noqa: ARG002 -- for links on which it depends
        """Return whether answers of a class can express a refusal."""
        return True

    def distinguishes_refusal(self, row: Row) -> bool:  # noqa: ARG002 -- on most links, of every row
        """Return whether a refusal of a telemetry row differs from its data."""
        return True

    def sleep(self, seconds: float) -> None:
        """Wait; received data are kept."""
        end = self.now() + seconds
        while (left := end - self.now()) > 0:
            self._receive(left)

    def drain(self) -> None:
        """Discard everything received."""
        while self.port.receive(0.0) is not None:
            pass

    # --- requests ---

    def telecommands(self) -> Iterable[Row]:
        return self.unit.telecommands.values()

    def telemetry_rows(self) -> Iterable[Row]:
        """Return the telemetry of the unit that can be read: by a request, or by waiting for it."""
        return (row for row in self.unit.telemetry.values() if not row.only_sent or row.is_streamed)

    def post(self, row: Row | int, data: bytes = b"", message_class: str = "") -> None:
        """Send a request for a row, or for an ID that need not belong to one, without waiting."""
        self.post_request(self.unit.request(row, data, message_class))

    def ask(self, row: Row | int, data: bytes = b"", message_class: str = "") -> Answer:
        """Send a request and return the answer; of an answer in several parts, the last.

        Other rows that answer a request follow its reply, or replace it.
        """
        others = []
        if isinstance(row, Row):
            named = [item.partition(":")[2] for item in self.answers(row)]
            others = [self.unit.telemetry[name] for name in named if name]
        if others and not self.names_rows:
            raise CaseSkipped(f"on this link an answer does not name its row, such as {others[0].name}")
        self.post(row, data, message_class)
        answer = self.last_answer()
        if not isinstance(row, Row) or not others or answer.kind not in ("ack", "telemetry"):
            return answer
        if answer.row_id != row.id and "reply" not in self.answers(row):
            self._check_row(others.pop(0), answer)
            answer = replace(answer, kind="ack", row_id=row.id, message_class=row.message_class)
        for other in others:
            self._check_row(other, self.next_answer())
        return answer

    def _check_row(self, row: Row, answer: Answer) -> None:
        named = answer.row_id in (None, row.id)
        if answer.kind != "telemetry" or len(answer.data) != row.size or not named:
            raise CaseFailed(f"row {row.name} ({row.id}) of {row.size} bytes as an answer", str(answer))
        checked_values(row, answer.data)

    def last_answer(self) -> Answer:
        """Return the next answer; of one in several parts, the last."""
        while not (answer := self.next_answer()).final:
            pass
        return answer

    def data_of(self, row: Row) -> bytes:
        """Read the bytes of a row, or wait for one that is only sent; any other answer fails the case."""
        if row.only_sent:
            return self._awaited(row).data
        self.post(row)
        return self.expect_telemetry(row).data

    def _awaited(self, row: Row) -> Answer:
        """Return the next message of a row that is sent at a rate or with each frame."""
        if not (row.is_streamed and self.has_unsolicited):
            raise CaseSkipped(f"{row.name} is only sent, and not regularly on this link")
        period_s = 1.0 / row.unsolicited if isinstance(row.unsolicited, float) else FRAME_S
        end = self.now() + period_s + self.times.answer_s
        self.unsolicited.clear()
        while self.now() < end:
            self._receive(end - self.now())
            for answer in self._unsolicited_answers():
                if (answer.row_id, answer.message_class) == (row.id, row.message_class) and len(
                    answer.data
                ) == row.size:
                    return answer
        raise CaseFailed(f"{row.name} ({row.id}) of {row.size} bytes within {period_s:g} s", "nothing")

    def expect_telemetry(self, row: Row, timeout_s: float | None = None) -> Answer:
        """Take the next answer, which must be the telemetry of a row."""
        answer = self.next_answer(timeout_s)
        named = answer.row_id is None or (answer.row_id, answer.message_class) in (
            (row.id, row.message_class),
            (row.id, ""),
        )
        if answer.kind != "telemetry" or len(answer.data) != row.size or not named:
            raise CaseFailed(f"telemetry {row.name} ({row.id}) of {row.size} bytes", str(answer))
        return answer

    def values(self, row: Row) -> dict[str, Value]:
        """Read the values of a row; one outside its limits fails the case."""
        return checked_values(row, self.data_of(row))

    def telemetry(self, name: str) -> dict[str, Value]:
        row = self.unit.telemetry[name]
        return row.decode(self.data_of(row))

    def command(self, name: str, **values: Value) -> None:
        """Send a telecommand by name, which must be accepted."""
        row = self.unit.telecommands[name]
        self.send_command(row, row.encode(values))

    def send_command(self, row: Row, data: bytes = b"") -> None:
        """Send a telecommand that must be accepted, or not answered if the row has no answer on this link."""
        if not self.answers(row):
            self.post_request(self.unit.request(row, data), answered=False)
            return
        answer = self.ask(row, data)
        accepted = answer.kind == "ack" and answer.row_id in (None, row.id)
        check(accepted, f"acknowledge of telecommand {row.name} ({row.id})", answer)

    def expect_refusal(self, row: Row | int, data: bytes, error: str, message_class: str = "") -> None:
        """Send a request that must be refused with a code.

        Where no answer can express the refusal it must not be answered, and a row that reports the last
        telecommand must report it.
        """
        request = self.unit.request(row, data, message_class)
        known = self.unit.row(request)
        what = f"{request} ({known.name})" if known is not None else str(request)
        if not self.can_refuse(request.message_class) or (
            known is not None and "reply" not in self.answers(known)
        ):
            self.post_request(request, answered=False)
            self.expect_silence(f"no answer can express the refusal of {what} on this link")
            self.check_reported(request.id, error)
            return
        self.post(row, data, message_class)
        self.expect_nack(f"refusal of {what}", error)

    def expect_nack(self, what: str, error: str) -> None:
        """Take the next answer, which must be a refusal with the code of an error, if refusals have one on this link."""
        answer, code = self.last_answer(), self.unit.code(error) if self.has_codes else None
        refused = answer.kind == "nack" and code in (None, answer.code)
        check(refused, what if code is None else f"{what} with code {code}", answer)

    def expect_refused(self, name: str, error: str, **values: Value) -> None:
        """Send a telecommand by name, which must be refused with a code."""
        row = self.unit.telecommands[name]
        self.expect_refusal(row, row.encode(values), error)

    def check_reported(self, row_id: int, error: str, index: int | None = None) -> None:
        """Read the row that reports the last telecommand, if the unit has one: ID, error, and index of a field."""
        expectations: dict[str, Value | None] = {
            "request.last": row_id,
            "request.error": error,
            "request.index": index,
        }
        for row in self.unit.readable.values():
            named = {item.value: name for name, item in row.named.items() if item.value in REPORT_QUANTITIES}
            if "request.error" not in named:
                continue
            values = self.telemetry(row.name)
            for quantity, name in named.items():
                expected = expectations[str(quantity)]
                if quantity == "request.error" and not isinstance(values[name], str):
                    expected = self.unit.code(error)
                if expected is not None:
                    check_equal(values[name], expected, REPORT_QUANTITIES[str(quantity)])

    def expect_silence(self, why: str, seconds: float | None = None) -> None:
        """Fail the case if anything but unsolicited telemetry arrives within a time."""
        answer = self.unexpected_answer(self.times.quiet_s if seconds is None else seconds)
        if answer.kind != "none":
            raise CaseFailed(f"nothing ({why})", str(answer))

    def expect_alive(self) -> None:
        """Fail the case unless the next valid request is answered."""
        self.data_of(self.lively)

    def wait_for(self, name: str, expected: Mapping[str, Value], within_s: float) -> dict[str, Value]:
        """Read a row until its fields have the wanted values; fail the case if this takes too long."""
        end = self.now() + within_s
        row = self.unit.telemetry[name]
        while True:
            answer = self.ask(row)
            last: object = answer
            if answer.kind == "telemetry" and len(answer.data) == row.size:
                values = row.decode(answer.data)
                if all(values[key] == value for key, value in expected.items()):
                    return values
                last = {key: values[key] for key in expected}
            if self.now() > end:
                raise CaseFailed(f"{name} with {dict(expected)} within {within_s:g} s", str(last))
            self.sleep(0.02)

    # --- around a case ---

    def begin(self, *, intrusive: bool) -> None:  # noqa: ARG002 (the same for all cases)
        """Begin a case without unread input."""
        self.drain()

    def end(self, *, intrusive: bool, passed: bool) -> None:  # noqa: ARG002 (the same for all cases)
        """End a case; nothing more may arrive."""
        if passed:
            # shorter than the silence with which most cases end by themselves: this only catches stragglers
            self.expect_silence("the case is over", self.times.quiet_s / 4)

    def recover(self) -> None:
        """Let time-outs of the device pass after a failed case."""
        self.sleep(RECOVERY_S)

    # --- around a run ---

    def identity(self) -> str:
        """Return what the unit reports of its identity; empty if no row does."""
        parts: dict[str, Value] = {}
        for row in self.unit.readable.values():
            names = [name for name, item in row.named.items() if (item.value or "").startswith("identity.")]
            parts |= {
                name: value
                for name, value in (self.telemetry(row.name) if names else {}).items()
                if name in names
            }
        return ", ".join(f"{name} {value!s}" for name, value in parts.items())

    def silence(self, *, booting: bool) -> str | None:
        """Read three telemetry rows; return None if one is answered correctly, otherwise the invalid answer, and what to check.

        If the unit may be booting, the requests are repeated until it must have booted.
        """
        rows = sorted(self.unit.readable.values(), key=lambda row: row.size)[:3]
        end = self.now() + (self.times.boot_s if booting else 0.0)
        if not rows:
            return None if self.receive_unsolicited(FRAME_S) else "nothing"
        while True:
            bad_answers = [answer for row in rows if (answer := self._bad_answer(row)) is not None]
            if len(bad_answers) < len(rows):
                return None
            if self.now() >= end:
                worst = max(bad_answers, key=lambda answer: (bool(answer.fault), answer.kind != "none"))
                unclear = worst.kind != "none" and not worst.fault
                return f"{worst}; check --dialect, --baud and the addresses" if unclear else str(worst)

    def _bad_answer(self, row: Row) -> Answer | None:
        """Request a row; return the answer if it is neither valid telemetry nor a published refusal."""
        self.drain()
        answer = self.ask(row)
        if answer.kind == "telemetry" and len(answer.data) == row.size:
            return None
        return None if answer.kind == "nack" and 0 < answer.code <= 10 else answer

    def prepare(self) -> None:
        """Record the settings of the unit, and set those that the cases need."""
        self.settings.prepare(self)
        self._prepared = True

    def restore(self) -> None:
        """Restore the settings that `prepare` recorded."""
        if self._prepared:
            self.recover()
            self.drain()
            self.settings.restore(self)


def checked_values(row: Row, data: bytes) -> dict[str, Value]:
    """Decode telemetry; a value outside its limits, or an unused bit that is set, fails the case."""
    for fault in row.faults(data):
        raise CaseFailed(f"values of {row.name} within the limits of the interface definition", fault)
    return row.decode(data)
