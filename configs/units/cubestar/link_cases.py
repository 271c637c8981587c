"""CubeStar's own cases of its links: latency, unsolicited telemetry, stuffing, flagged errors, and each parameter."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

from starhil.configs.units.cubestar.controls import (
    LINK_PARAMETERS,
    parameter,
    parameters_kept,
    set_parameter,
    value_of,
)
from starhil.hil_tests.conformance.can_probe import CanProbe
from starhil.hil_tests.conformance.case import Case, CaseArea, check, check_equal, rule
from starhil.hil_tests.conformance.link_probe import (
    INVALID_ID,
    INVALID_LENGTH,
    INVALID_PARAMETER,
    LONG_PAUSE_S,
    LinkProbe,
    checked_values,
)
from starhil.hil_tests.conformance.ports import CanFrame
from starhil.hil_tests.conformance.serial_probe import SerialProbe
from starhil.hil_tests.judge.can import TELECOMMAND_SEGMENT, can_id_of, segments
from starhil.hil_tests.judge.definition import Parameter, Unit
from starhil.hil_tests.judge.messages import Answer, Value

HOST_TIMEOUT_S: Final = 0.3
"""Shortest time-out in published flight software (AlbertaSat, first version)."""

TIMING: Final = CaseArea[LinkProbe]("timing", "host time-out of AlbertaSat, first version")
UNSOLICITED: Final = CaseArea[LinkProbe](
    "unsolicited",
    "types 10 to 12, start bytes 1F 4F (libCubeObc); serial dialects a and b have none: R20, docs/rules.md",
    intrusive=True,
)
STUFFING: Final = CaseArea[SerialProbe](
    "stuffing", "1F in the data is doubled (libCubeObc, CTS)", intrusive=True, links=("serial",)
)
SERIAL_ERRORS: Final = CaseArea[SerialProbe](
    "errors",
    "configs/units/cubestar: communication_status 144, link errors are flagged and otherwise ignored",
    intrusive=True,
    links=("serial",),
)
CAN_ERRORS: Final = CaseArea[CanProbe](
    "errors",
    "configs/units/cubestar: communication_status 144, flag can_telecommand_error",
    intrusive=True,
    links=("can",),
)
CAN_UNSOLICITED: Final = CaseArea[CanProbe](
    "unsolicited",
    "types 10 to 12 (libCubeObc); their use: R20, docs/rules.md",
    intrusive=True,
    links=("can",),
)

READ: Final = "1F 7F 80 1F FF"
"""Request for identification."""
COMBINED: Final = 211
COMBINED_SIZE: Final = 54


# --- time ---


@TIMING.case("reply", "fifty requests are each answered within 300 ms")
def reply_time(probe: LinkProbe) -> None:
    worst = 0.0
    for _ in range(50):
        begin = probe.now()
        probe.expect_alive()
        worst = max(worst, probe.now() - begin)
    check(worst <= HOST_TIMEOUT_S, f"at most {HOST_TIMEOUT_S:g} s", f"{worst:.3f} s")


# --- unsolicited telemetry ---


def _unsolicited_rows(probe: LinkProbe, name: str, rate: float, seconds: float) -> list[Answer]:
    """Return the unsolicited telemetry of a row that arrives within a time."""
    row = probe.unit.telemetry[name]
    probe.command("set_unsolicited", telemetry=row.id, rate=rate)
    try:
        return probe.receive_unsolicited(seconds)
    finally:
        probe.command("set_unsolicited", telemetry=row.id, rate=0.0)


@UNSOLICITED.case("rate", "unsolicited telemetry is sent at its rate, and stops")
def unsolicited(probe: LinkProbe) -> None:
    row = probe.unit.telemetry["identification"]
    seen = _unsolicited_rows(probe, "identification", 10.0, 2.0)
    if not probe.has_unsolicited:
        check(not seen, "no unsolicited telemetry on this link", f"{len(seen)} messages")
        return
    check(18 <= len(seen) <= 22, "18 to 22 messages in 2 s", len(seen))
    check_equal({(item.row_id, len(item.data)) for item in seen}, {(row.id, row.size)}, "row and length")
    after = probe.receive_unsolicited(0.5)
    check(len(after) <= 1, "no more", f"{len(after)} messages")


@UNSOLICITED.case("long", "a long row is sent complete as unsolicited telemetry")
def unsolicited_long(probe: LinkProbe) -> None:
    row = probe.unit.telemetry["star_tracker"]
    seen = _unsolicited_rows(probe, "star_tracker", 5.0, 1.0)
    if not probe.has_unsolicited:
        check(not seen, "no unsolicited telemetry on this link", f"{len(seen)} messages")
        return
    check(len(seen) >= 3, "3 messages or more in 1 s", len(seen))
    check_equal({(item.row_id, len(item.data)) for item in seen}, {(row.id, row.size)}, "row and length")
    for item in seen:
        checked_values(row, item.data)


@UNSOLICITED.case("refused", "unsolicited telemetry of an unknown row is refused", "published error codes")
def unsolicited_refused(probe: LinkProbe) -> None:
    probe.expect_refused("set_unsolicited", INVALID_PARAMETER, telemetry=200, rate=1.0)


@CAN_UNSOLICITED.case(
    "segments", "an unsolicited long row is sent as first, body and last, with counters down to 0"
)
def unsolicited_segments(probe: CanProbe) -> None:
    """star_tracker has 54 bytes, so 8 frames."""
    probe.command("set_unsolicited", telemetry=COMBINED, rate=5.0)
    try:
        probe.receive_unsolicited(1.0)
        seen = probe.unsolicited[:8]
    finally:
        probe.command("set_unsolicited", telemetry=COMBINED, rate=0.0)
    check_equal([frame.id >> 24 for frame in seen], [10, *[11] * 6, 12], "types")
    check_equal([frame.data[-1] if frame.data else -1 for frame in seen], list(range(7, -1, -1)), "counters")
    check_equal(sum(len(frame.data) - 1 for frame in seen), COMBINED_SIZE, "bytes")


# --- stuffing ---


def _expect_refusal_of(probe: SerialProbe, row_id: int, text: str, error: str) -> None:
    probe.send_text(text)
    probe.expecting(str(row_id))
    answer = probe.next_answer()
    code = probe.unit.code(error)
    check(answer.kind == "nack" and answer.code == code, f"refusal with code {code}", answer)


@STUFFING.case("taken-out", "a doubled 1F is one byte of data")
def unstuffed(probe: SerialProbe) -> None:
    """Parameter 31 does not exist, so the device refuses its ID, not the length."""
    row = probe.unit.telecommands["select_parameter"]
    _expect_refusal_of(probe, row.id, f"1F 7F {row.id:02X} 1F 1F 1F FF", INVALID_PARAMETER)


@STUFFING.case("not-a-mark", "1F 1F FF within data is a byte 1F and a byte FF, not an end")
def not_a_mark(probe: SerialProbe) -> None:
    """The device refuses the length: three bytes instead of one for select_parameter."""
    row = probe.unit.telecommands["select_parameter"]
    _expect_refusal_of(probe, row.id, f"1F 7F {row.id:02X} 1F 1F FF 00 1F FF", INVALID_LENGTH)


# --- errors are flagged ---

FLAG_NAMES: Final = (
    "telecommand_overrun",
    "uart_protocol_error",
    "uart_incomplete",
    "i2c_telemetry_error",
    "i2c_telecommand_error",
    "can_telecommand_error",
)


@dataclass(frozen=True)
class FlagRow:
    """Malformed traffic and the flags that it sets.

    Attributes
    ----------
    id, title
        Name of the case, and the defect of the traffic.
    sent
        Raw traffic, in the format of `LinkProbe.send_text`.
    flags
        Exactly these flags must be set.
    pause_s
        Silence expected before the flags are read, s; None to read them at once.
    """

    id: str
    title: str
    sent: tuple[str, ...]
    flags: frozenset[str]
    pause_s: float | None = 0.0


def check_flags(probe: LinkProbe, expected: frozenset[str]) -> dict[str, Value]:
    """Read `communication_status` and return it; fail the case unless exactly these flags are set."""
    status = probe.telemetry("communication_status")
    seen = {flag for flag in FLAG_NAMES if status[flag]}
    check(seen == expected, f"flags {_names(expected)}", _names(seen))
    return status


def add_flag_cases(area: CaseArea[Any], rows: Iterable[FlagRow]) -> None:
    """Add one case per row."""
    for row in rows:
        area.case(row.id, f"{row.title} sets its flag and is not counted")(partial(_flags, row))


def _flags(row: FlagRow, probe: LinkProbe) -> None:
    probe.command("clear_counters")
    for text in row.sent:
        probe.send_text(text)
    if row.pause_s is not None:
        probe.expect_silence("no request was made", max(row.pause_s, probe.times.quiet_s))
    status = check_flags(probe, row.flags)
    counts = (status["telecommand_count"], status["telemetry_count"])
    check_equal(counts, (0, 1), "counts of telecommands and telemetry")
    probe.command("clear_counters")
    check_flags(probe, frozenset())


def _names(flags: Iterable[str]) -> str:
    return ", ".join(sorted(flags)) or "none"


PROTOCOL_ERROR: Final = frozenset({"uart_protocol_error"})
INCOMPLETE: Final = frozenset({"uart_incomplete"})
OVERLONG: Final = "1F 7F 80" + "00" * 600 + "1F FF"
SERIAL_FLAGS: Final = (
    FlagRow("junk", "bytes outside a message", ("00 55 AA",), PROTOCOL_ERROR),
    FlagRow("empty", "a message without an ID", ("1F 7F 1F FF",), PROTOCOL_ERROR),
    FlagRow("bad-escape", "a bad escape within a message", ("1F 7F 80 1F 00",), PROTOCOL_ERROR),
    FlagRow("overlong", "a message that is too long", (OVERLONG,), PROTOCOL_ERROR),
    FlagRow("cut-off", "a message interrupted by another", ("1F 7F 02 11 22",), INCOMPLETE, pause_s=None),
    FlagRow("half", "an incomplete message", ("1F 7F 02 11 22",), INCOMPLETE, pause_s=LONG_PAUSE_S),
)

add_flag_cases(SERIAL_ERRORS, SERIAL_FLAGS)


@SERIAL_ERRORS.case("none", "valid requests set no flag")
def no_serial_flag(probe: SerialProbe) -> None:
    probe.command("clear_counters")
    for _ in range(20):
        probe.telemetry("identification")
    probe.expecting(*["128"] * 5)
    probe.send(bytes.fromhex(READ) * 5)
    for _ in range(5):
        probe.expect_telemetry(probe.unit.telemetry["identification"])
    check_flags(probe, frozenset())


UNKNOWN: Final = 60
"""An ID without a telecommand."""
CAN_ERROR: Final = frozenset({"can_telecommand_error"})
CAN_FLAGS: Final = (
    FlagRow("type", "a message type that is not a request", ("0580HHDD#00",), CAN_ERROR),
    FlagRow("swapped-kinds", "a telecommand frame with a telemetry ID", ("0180HHDD#",), CAN_ERROR),
    FlagRow("sequence", "a segment out of order", ("073CHHDD#0001020304050602", "073CHHDD#0001020304050600"), CAN_ERROR),
    FlagRow("begins-nothing", "a last segment without others", ("073CHHDD#00010203040500",), CAN_ERROR),
    FlagRow("no-counter", "a segment without a counter", ("073CHHDD#",), CAN_ERROR),
    FlagRow("half", "half a message", ("073CHHDD#0001020304050602",), CAN_ERROR, pause_s=LONG_PAUSE_S),
)  # fmt: skip
add_flag_cases(CAN_ERRORS, CAN_FLAGS)


@CAN_ERRORS.case("none", "good requests, and frames for others, set no flag")
def no_can_flag(probe: CanProbe) -> None:
    probe.command("clear_counters")
    for text in ("0480HHFE#", "1F80HHFE#00", "480#0102", "0480HHDD#R", "073CHHFE#00"):
        probe.send_text(text)
    probe.expect_silence("they are not for the device")
    can_id = can_id_of(TELECOMMAND_SEGMENT, UNKNOWN, probe.host, probe.device)
    for part in segments(bytes(30)):
        probe.send(CanFrame(can_id, part))
    probe.expect_answer("nack", "one refusal of an unknown telecommand", INVALID_ID)
    status = probe.telemetry("communication_status")
    check(not status["can_telecommand_error"], "no flag", "can_telecommand_error")


# --- parameters ---


def generated(unit: Unit) -> Iterator[Case[LinkProbe]]:
    """Yield the cases for each parameter of the unit."""
    for item in unit.parameters.values():
        yield from _parameter_cases(item)


PARTNERS: Final = {
    "max_star_pixels": ("min_star_pixels", 1.0),
    "min_star_pixels": ("max_star_pixels", 255.0),
    "update_rate": ("exposure", 1.0),
    "exposure": ("update_rate", 0.01),
    "delay_time": ("update_rate", 0.01),
}
"""Parameters that limit each other → the other parameter, and its value that allows the full range."""
F32_ROUNDING: Final = 1e-6
UNSET: Final = frozenset({"unsolicited_rate"})
"""Parameters whose largest value would flood the line."""


def _parameter_cases(item: Parameter) -> Iterator[Case[LinkProbe]]:
    clause = f"configs/units/cubestar parameter {item.name}; {rule(19)}"

    def limits(probe: LinkProbe) -> None:
        seen = parameter(probe, item.name)
        check_equal(seen["parameter"], item.id, "number")
        for key, wanted in (("minimum", item.minimum), ("maximum", item.maximum)):
            check_equal(seen[key], float(wanted), key)
        value = float(seen["value"])
        check(_within(value, item), f"a value within {item.minimum:g} to {item.maximum:g}", value)

    def refusals(probe: LinkProbe) -> None:
        before = value_of(probe, item.name)
        row = probe.unit.telecommands["set_parameter"]
        for bad in _outside(item):
            data = row.encode({"parameter": item.id, "value": bad})
            answer = probe.ask(row, data)
            if answer.kind == "ack":
                set_parameter(probe, item.name, before)
            refused = answer.kind == "nack" and answer.code == probe.unit.code(INVALID_PARAMETER)
            check(refused, f"{bad:g} refused with code 3", answer)
            check_equal(value_of(probe, item.name), before, "unchanged value")

    def values(probe: LinkProbe) -> None:
        partner, room = PARTNERS.get(item.name, (item.name, None))
        with parameters_kept(probe, item.name, partner):
            if room is not None:
                set_parameter(probe, partner, room)
            for good in _inside(item, value_of(probe, item.name)):
                set_parameter(probe, item.name, good)
                seen = float(probe.telemetry("parameter")["value"])
                same = abs(seen - good) <= F32_ROUNDING * max(abs(good), 1e-30)
                check(same, f"{item.name} {good!r}", f"{seen!r}")

    name = item.name
    for check_name, title, run in (
        ("limits", f"{name} reports its ID and limits", limits),
        ("refusals", f"{name} outside its limits is refused and unchanged", refusals),
        ("values", f"{name} accepts its smallest and largest value", values),
    ):
        yield Case(f"parameters.{name}.{check_name}", "parameters", title, clause, run, intrusive=True)


def _within(value: float, parameter: Parameter) -> bool:
    slack = F32_ROUNDING * max(abs(parameter.minimum), abs(parameter.maximum))
    return parameter.minimum - slack <= value <= parameter.maximum + slack


def _whole(parameter: Parameter) -> bool:
    return parameter.type not in ("f32", "f64")


def _outside(parameter: Parameter) -> list[float]:
    """Yield values that a parameter must refuse."""
    step = 1.0 if _whole(parameter) else max(1.0, abs(parameter.maximum)) * 0.01
    bad = [parameter.minimum - step, parameter.maximum + step, math.nan, math.inf, -math.inf]
    if _whole(parameter):
        bad.append(parameter.minimum + 0.5)
    if parameter.enum is not None:
        numbers = range(int(parameter.minimum), int(parameter.maximum))
        bad += [float(gap) for gap in sorted(set(numbers) - set(parameter.enum.values()))]
    return bad


def _inside(parameter: Parameter, present: float) -> list[float]:
    """Yield values that a parameter must accept."""
    if parameter.name in LINK_PARAMETERS:
        return [present]
    if parameter.enum is not None:
        return [float(number) for number in parameter.enum.values()]
    greatest = [] if parameter.name in UNSET else [parameter.maximum]
    return [parameter.minimum, *greatest, parameter.default_number]
