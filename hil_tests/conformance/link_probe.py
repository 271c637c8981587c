"""The tester's side of a serial or CAN link: requests, strict decoding of answers, and a log.

The framing is implemented independently from the public description and shares no code with the codecs of the
product.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Final, Literal

from starhil.hil_tests.conformance.case import CaseFailed
from starhil.hil_tests.conformance.ports import Port
from starhil.hil_tests.conformance.unit_settings import UnitSettings
from starhil.protocol.codec import Row
from starhil.protocol.errors import ProtocolError
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.values import Value

OK: Final = 0
INVALID_ID: Final = 1
INVALID_LENGTH: Final = 2
INVALID_PARAMETER: Final = 3
INVALID_CRC: Final = 4
SEQUENCE: Final = 7

FIRST_TELEMETRY: Final = 128
BURST_ID: Final = 119

LONG_PAUSE_S: Final = 0.8
"""Pause after which the device has abandoned an incomplete message (after 0.5 s)."""
RECOVERY_S: Final = 1.0
"""Pause after a failed case, in which time-outs of the device pass."""

SHOWN_BYTES: Final = 48
"""Number of serial bytes shown in a line of the log."""

LIVELY: Final = ("identification", "device_status", "acknowledge")
"""Rows of which every unit answers at least one."""

AnswerKind = Literal["ack", "nack", "telemetry", "burst", "unsolicited", "malformed", "none"]


@dataclass(frozen=True)
class Answer:
    """An answer of the device.

    Attributes
    ----------
    kind
        Kind of answer: `none` if there was no answer in time, `malformed` if it could not be decoded.
    code
        Error code of a refusal.
    data
        Telemetry, or the malformed bytes.
    row_id
        Row ID in the answer; None if the dialect has none.
    other
        CAN address to which it was sent; 0 on serial.
    """

    kind: AnswerKind
    code: int = 0
    data: bytes = b""
    row_id: int | None = None
    other: int = 0

    def __str__(self) -> str:
        match self.kind:
            case "nack":
                return f"refusal with code {self.code}"
            case "telemetry" | "burst" | "unsolicited" | "malformed":
                return f"{self.kind} of {len(self.data)} bytes: {self.data[:24].hex(' ')}"
            case _:
                return "acknowledge" if self.kind == "ack" else "nothing"


@dataclass(frozen=True)
class ProbeTimes:
    """Timeouts of the tester.

    Attributes
    ----------
    answer_s
        Maximum time for an answer.
    quiet_s
        Silence that counts as no answer.
    boot_s
        Maximum time from a reset to the first answer in standby.
    image_s
        Maximum time for taking an image.
    """

    answer_s: float = 1.0
    quiet_s: float = 0.1
    boot_s: float = 15.0
    image_s: float = 20.0


class PortProbe(ABC):
    """A port with its clock, for any kind of traffic."""

    link: str
    """`serial` or `can`."""

    def __init__(self, port: Port[Any], icd: InterfaceDefinition, times: ProbeTimes | None) -> None:
        self.port = port
        self.icd = icd
        self.times = times or ProbeTimes()
        self.log: list[str] = []

    def drain(self) -> None:
        """Discard everything received."""
        while self.port.receive(0.0) is not None:
            pass

    @abstractmethod
    def _receive(self, timeout_s: float) -> bool:
        """Store the next input; return whether anything arrived in time."""

    def now(self) -> float:
        """Time of the port, s."""
        return self.port.now()

    def sleep(self, seconds: float) -> None:
        """Wait; received data are kept."""
        end = self.now() + seconds
        while (left := end - self.now()) > 0:
            self._receive(left)

    @abstractmethod
    def expect_silence(self, why: str, seconds: float | None = None) -> None:
        """Fail the case if anything arrives within a time."""

    @abstractmethod
    def expect_alive(self) -> None:
        """Fail the case unless the next valid request is answered."""

    # --- around a case ---

    def begin(self, *, intrusive: bool) -> None:  # noqa: ARG002 (the same for all cases)
        """Begin a case without unread input."""
        self.drain()

    def end(self, *, intrusive: bool, passed: bool) -> None:  # noqa: ARG002 (the same for all cases)
        """End a case; nothing more may arrive."""
        if passed:
            self.expect_silence("the case is over", self.times.quiet_s / 4)

    def recover(self) -> None:
        """Let time-outs of the device pass after a failed case."""
        self.sleep(RECOVERY_S)


class SerialWire(PortProbe):
    """Sends bytes on a serial line, and logs both directions."""

    link = "serial"

    def send(self, data: bytes) -> None:
        """Send raw bytes."""
        self._note("->", data)
        self.port.send(data)

    def _note(self, way: str, data: bytes) -> None:
        more = f" … ({len(data)} bytes)" if len(data) > SHOWN_BYTES else ""
        self.log.append(f"{self.now():.4f} {way} {data[:SHOWN_BYTES].hex(' ').upper()}{more}")


class LinkProbe(PortProbe):
    """Talks to CubeStar over a link."""

    _found: UnitSettings | None = None

    # --- the link ---

    @abstractmethod
    def post(self, row_id: int, data: bytes = b"") -> None:
        """Send a request without waiting."""

    def answers(self, row_id: int) -> bool:  # noqa: ARG002 (on most links, every request)
        """Return whether the link answers a request."""
        return True

    def tells_refusal(self, row: Row) -> bool:  # noqa: ARG002 (on most links, of every row)
        """Return whether a refusal of a telemetry row differs from its data."""
        return True

    @abstractmethod
    def send_text(self, text: str) -> None:
        """Send hexadecimal bytes, or a CAN frame in which HH and DD are the addresses of host and device."""

    @abstractmethod
    def expecting(self, *answers: str) -> None:
        """Record the rows that raw traffic is going to request, in order."""

    @abstractmethod
    def expect_exactly(self, answer: str) -> None:
        """Take the next answer to raw traffic, given by row ID on serial and as a frame pattern on CAN."""

    @abstractmethod
    def next_answer(self, timeout_s: float | None = None) -> Answer:
        """Return the next unread answer; skip unsolicited telemetry."""

    @abstractmethod
    def unexpected_answer(self, quiet_s: float) -> Answer:
        """Return an unexpected answer within a time."""

    @abstractmethod
    def receive_unsolicited(self, seconds: float) -> list[Answer]:
        """Return the messages of unsolicited telemetry that arrive within a time."""

    # --- requests ---

    def ask(self, row_id: int, data: bytes = b"") -> Answer:
        """Send a request and return the answer to it."""
        self.post(row_id, data)
        return self.next_answer()

    def telemetry(self, name: str) -> dict[str, Value]:
        """Read a row by name; any other answer fails the case."""
        row = self.icd.telemetry[name]
        return row.decode(self.data_of(row))

    def data_of(self, row: Row) -> bytes:
        """Read the bytes of a row; any other answer fails the case."""
        self.post(row.id)
        return self.expect_telemetry(row.id)

    def command(self, name: str, **values: Value) -> None:
        """Send a telecommand by name; any answer but an acknowledge fails the case."""
        row = self.icd.telecommands[name]
        self.expect_ack(row.id, row.encode(values))

    def expect_ack(self, row_id: int, data: bytes = b"") -> None:
        """Send a telecommand that must be accepted; one that the link does not answer is taken to be."""
        if not self.answers(row_id):
            self.post(row_id, data)
            return
        answer = self.ask(row_id, data)
        if answer.kind != "ack":
            raise CaseFailed(f"acknowledge of telecommand {self._name(row_id)}", str(answer))

    def expect_refusal(self, row_id: int, data: bytes, code: int) -> None:
        """Send a request that must be refused with a code, on a link that does not answer it in silence."""
        if not self.answers(row_id):
            self.post(row_id, data)
            self.expect_silence(f"{self._name(row_id)} is not answered on this link")
            seen = self.telemetry("acknowledge")
            known = self.icd.enums["error_code"].names
            if seen["last_telecommand"] != row_id or seen["error"] != known[code]:
                raise CaseFailed(f"acknowledge row with {row_id} and {known[code]}", str(seen))
            return
        answer = self.ask(row_id, data)
        if answer.kind != "nack" or answer.code != code:
            raise CaseFailed(f"refusal of {self._name(row_id)} with code {code}", str(answer))

    def expect_refused(self, name: str, code: int, **values: Value) -> None:
        """Send a telecommand by name, which must be refused with a code."""
        row = self.icd.telecommands[name]
        self.expect_refusal(row.id, row.encode(values), code)

    def expect_telemetry(self, row_id: int, timeout_s: float | None = None) -> bytes:
        """Take the next answer, which must be the telemetry of a row, and return its data."""
        row = self.icd.telemetry_by_id[row_id]
        answer = self.next_answer(timeout_s)
        right_id = answer.row_id in (None, row_id)
        if answer.kind != "telemetry" or len(answer.data) != row.size or not right_id:
            raise CaseFailed(f"telemetry {self._name(row_id)} of {row.size} bytes", str(answer))
        return answer.data

    def expect_silence(self, why: str, seconds: float | None = None) -> None:
        """Fail the case if anything arrives within a time."""
        answer = self.unexpected_answer(self.times.quiet_s if seconds is None else seconds)
        if answer.kind != "none":
            raise CaseFailed(f"nothing ({why})", str(answer))

    def expect_alive(self) -> None:
        """Fail the case unless the next valid request is answered."""
        self.telemetry("identification")

    def _name(self, row_id: int) -> str:
        row = self.icd.row_by_id(row_id)
        return f"{row_id} ({row.name})" if row is not None else str(row_id)

    # --- state of the device ---

    def wait_for(self, name: str, wanted: Mapping[str, Value], within_s: float) -> dict[str, Value]:
        """Read a row until its fields have the wanted values; fail the case if this takes too long."""
        end = self.now() + within_s
        while True:
            row = self.icd.telemetry[name]
            answer = self.ask(row.id)
            seen: object = answer
            if answer.kind == "telemetry" and len(answer.data) == row.size:
                values = row.decode(answer.data)
                if all(values[key] == value for key, value in wanted.items()):
                    return values
                seen = {key: values[key] for key in wanted}
            if self.now() > end:
                raise CaseFailed(f"{name} with {dict(wanted)} within {within_s:g} s", str(seen))
            self.sleep(0.02)

    def standby(self) -> None:
        """Bring the device into standby."""
        if self.telemetry("device_status")["mode"] != "standby":
            self.command("set_mode", mode="standby")
            self.wait_for("device_status", {"mode": "standby"}, 2.0)

    def reset(self) -> None:
        """Reset the device and wait until it is in standby."""
        self.command("reset")
        if not self.answers(self.icd.telecommands["reset"].id):
            self.expect_silence("reset is not answered on this link", 0.05)
        self.sleep(0.05)
        self.drain()
        self.wait_for("device_status", {"mode": "standby"}, self.times.boot_s)

    def parameter(self, name: str) -> dict[str, Value]:
        """Read value and limits of a parameter."""
        self.command("select_parameter", parameter=self.icd.parameters[name].id)
        return self.telemetry("parameter")

    def value_of(self, name: str) -> float:
        """Read the value of a parameter."""
        return float(self.parameter(name)["value"])

    def set_parameter(self, name: str, number: float) -> None:
        """Set a parameter, which must be accepted."""
        self.command("set_parameter", parameter=self.icd.parameters[name].id, value=number)

    @contextmanager
    def parameters_kept(self, *names: str) -> Iterator[None]:
        """Restore the values of parameters afterwards."""
        before = {name: self.value_of(name) for name in names}
        try:
            yield
        finally:
            for name, value in before.items():
                self.set_parameter(name, value)

    # --- around a run ---

    def silence(self, *, booting: bool) -> str | None:
        """Read three telemetry rows; return None if one is answered correctly, otherwise the invalid answer.

        If the unit may be booting, the requests are repeated until it must have booted.
        """
        end = self.now() + (self.times.boot_s if booting else 0.0)
        while True:
            seen = [str(answer) for name in LIVELY if (answer := self._bad_answer(name)) is not None]
            if len(seen) < len(LIVELY):
                return None
            if self.now() >= end:
                return next((text for text in seen if text != "nothing"), "nothing")

    def _bad_answer(self, name: str) -> Answer | None:
        """Request a row; return the answer if it is neither valid telemetry nor a published refusal."""
        self.drain()
        row = self.icd.telemetry[name]
        answer = self.ask(row.id)
        if answer.kind == "telemetry" and len(answer.data) == row.size:
            return None
        if answer.kind == "nack" and answer.code in self.icd.enums["error_code"].names:
            return None
        return answer

    def prepare(self) -> None:
        """Record the settings of the unit, and set its defaults for the cases."""
        self._found = UnitSettings.read(self)
        self._found.prepare(self)

    def restore(self) -> None:
        """Restore the settings that `prepare` recorded.

        Raises
        ------
        CaseFailed
            The unit does not accept some of them; the text names them.
        """
        if self._found is None:
            return
        self.recover()
        self.drain()
        try:
            self._found.restore(self)
        except CaseFailed as failure:
            raise CaseFailed(f"the stored parameters restored ({self._found})", failure.seen) from None


def checked_values(row: Row, data: bytes) -> dict[str, Value]:
    """Decode telemetry; a value outside its limits fails the case."""
    try:
        return row.decode(data, check=True)
    except ProtocolError as error:
        raise CaseFailed(
            f"values of {row.name} within the limits of the interface definition", str(error)
        ) from None
