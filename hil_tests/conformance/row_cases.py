"""Conformance to the interface definition, row by row: row IDs, lengths, values, limits."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from typing import Final

from starhil.hil_tests.conformance.case import Case, CaseArea, check, check_equal, rule
from starhil.hil_tests.conformance.link_probe import (
    INVALID_ID,
    INVALID_LENGTH,
    INVALID_PARAMETER,
    LinkProbe,
    checked_values,
)
from starhil.hil_tests.conformance.unit_settings import LINK_PARAMETERS
from starhil.protocol.codec import Field, Row
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.values import Parameter

CODES: Final = "published error codes 0 to 4 (AlbertaSat, CTS)"
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


IDENTIFIERS: Final = CaseArea[LinkProbe](
    "identifiers", "telemetry 128 to 255, telecommands 0 to 127 (libCubeObc, CTS)"
)


def clause_of(row: Row) -> str:
    """Return the source of a row."""
    return f"configs/units/cubestar {row.name} ({row.provenance}{': ' + row.source if row.source else ''})"


def row_cases(icd: InterfaceDefinition) -> list[Case[LinkProbe]]:
    """Return the cases for a definition."""
    cases: list[Case[LinkProbe]] = list(IDENTIFIERS.cases)
    cases.extend(_telemetry_case(row) for row in icd.telemetry.values())
    for row in icd.telecommands.values():
        cases.extend(_length_cases(row))
        cases.extend(_field_cases(row))
    for parameter in icd.parameters.values():
        cases.extend(_parameter_cases(parameter))
    return cases


# --- row IDs ---


@IDENTIFIERS.case("telemetry", "each unknown telemetry ID is refused with code 1")
def unknown_telemetry(probe: LinkProbe) -> None:
    for row_id in range(128, 256):
        if row_id not in probe.icd.telemetry_by_id:
            probe.expect_refusal(row_id, b"", INVALID_ID)


@IDENTIFIERS.case("telecommands", "each unknown telecommand is refused with code 1", intrusive=True)
def unknown_telecommands(probe: LinkProbe) -> None:
    for row_id in range(128):
        if row_id not in probe.icd.telecommands_by_id:
            probe.expect_refusal(row_id, b"", INVALID_ID)
            probe.expect_refusal(row_id, b"\x01\x02", INVALID_ID)


@IDENTIFIERS.case("telemetry-with-data", "a telemetry request with data is refused for its length", rule(5))
def telemetry_with_data(probe: LinkProbe) -> None:
    for row in probe.icd.telemetry.values():
        if probe.tells_refusal(row):
            probe.expect_refusal(row.id, b"\x00", INVALID_LENGTH)


# --- telemetry ---


def _telemetry_case(row: Row) -> Case[LinkProbe]:
    def run(probe: LinkProbe) -> None:
        for _ in range(2):
            checked_values(row, probe.data_of(row))

    title = f"{row.name} has {row.size} bytes and values within their limits"
    return Case(f"telemetry.{row.name}", "telemetry", title, clause_of(row), run)


# --- telecommands: length ---


def _length_cases(row: Row) -> Iterator[Case[LinkProbe]]:
    whole = row.encode(row.example())

    def refused(data: bytes, why: str) -> Case[LinkProbe]:
        def run(probe: LinkProbe) -> None:
            probe.expect_refusal(row.id, data, INVALID_LENGTH)
            acknowledge = probe.telemetry("acknowledge")
            check_equal(acknowledge["last_telecommand"], row.id, "last telecommand")
            check_equal(acknowledge["error"], "invalid_length", "its error")

        title = f"{row.name} with {len(data)} bytes ({why}) is refused with code 2"
        return Case(
            f"lengths.{row.name}.{why}", "lengths", title, f"{CODES}; {clause_of(row)}", run, intrusive=True
        )

    yield refused(whole + b"\0\0", "long")
    if row.size > 0:
        yield refused(whole[:-1], "short")
    if row.size > 1:
        yield refused(b"", "empty")


# --- telecommands: fields ---


def _field_cases(row: Row) -> Iterator[Case[LinkProbe]]:
    for index, (name, field) in enumerate(row.named_fields.items()):
        for why, data in bad_values(row, field):
            yield _bad_field_case(row, name, index, why, data)


def bad_values(row: Row, field: Field) -> Iterator[tuple[str, bytes]]:
    """Yield data of a telecommand with one field outside its limits."""
    good = bytearray(row.encode(row.example()))

    def with_raw(raw: bytes) -> bytes:
        return bytes(good[: field.offset] + raw + good[field.offset + field.size :])

    if field.kind == "float":
        form = field.slot.format
        yield "nan", with_raw(struct.pack(form, math.nan))
        yield "infinite", with_raw(struct.pack(form, math.inf))
        low, high = field.physical_limits
        step = max(abs(low), abs(high), 1.0)
        if field.minimum is not None:
            yield "low", with_raw(struct.pack(form, low - 0.1 * step))
        if field.maximum is not None:
            yield "high", with_raw(struct.pack(form, high + 0.1 * step))
    elif field.kind == "enum" and not field.width:
        known = field.enum.values.values() if field.enum is not None else ()
        unknown = next(number for number in range(255, -1, -1) if number not in known)
        yield "unknown", with_raw(unknown.to_bytes(field.size, field.slot.order))
    elif field.kind == "integer":
        signed = field.type.startswith("i")
        low_raw, high_raw = field.raw_limits
        bits = 8 * field.size
        least, greatest = (-(1 << bits - 1), (1 << bits - 1) - 1) if signed else (0, (1 << bits) - 1)
        if low_raw > least:
            yield "low", with_raw((low_raw - 1).to_bytes(field.size, field.slot.order, signed=signed))
        if high_raw < greatest:
            yield "high", with_raw((high_raw + 1).to_bytes(field.size, field.slot.order, signed=signed))


def _bad_field_case(row: Row, name: str, index: int, why: str, data: bytes) -> Case[LinkProbe]:
    def run(probe: LinkProbe) -> None:
        probe.expect_refusal(row.id, data, INVALID_PARAMETER)
        acknowledge = probe.telemetry("acknowledge")
        check_equal(acknowledge["error"], "invalid_parameter", "error in acknowledge")
        check_equal(acknowledge["parameter_index"], index, "index of the refused field")

    title = f"{row.name} with {name} {why} is refused with code 3 and the index of the field"
    clause = f"{CODES}; {clause_of(row)}"
    return Case(f"fields.{row.name}.{name}.{why}", "fields", title, clause, run, intrusive=True)


# --- parameters ---


def _parameter_cases(parameter: Parameter) -> Iterator[Case[LinkProbe]]:
    clause = f"configs/units/cubestar parameter {parameter.name}; {rule(19)}"

    def limits(probe: LinkProbe) -> None:
        seen = probe.parameter(parameter.name)
        check_equal(seen["parameter"], parameter.id, "number")
        for key, wanted in (("minimum", parameter.minimum), ("maximum", parameter.maximum)):
            check_equal(seen[key], float(wanted), key)
        value = float(seen["value"])
        check(
            _within(value, parameter), f"a value within {parameter.minimum:g} to {parameter.maximum:g}", value
        )

    def refusals(probe: LinkProbe) -> None:
        before = probe.value_of(parameter.name)
        row = probe.icd.telecommands["set_parameter"]
        for bad in _outside(parameter):
            data = row.encode({"parameter": parameter.id, "value": bad}, check=False)
            answer = probe.ask(row.id, data)
            if answer.kind == "ack":
                probe.set_parameter(parameter.name, before)
            refused = answer.kind == "nack" and answer.code == INVALID_PARAMETER
            check(refused, f"{bad:g} refused with code 3", answer)
            check_equal(probe.value_of(parameter.name), before, "unchanged value")

    def values(probe: LinkProbe) -> None:
        partner, room = PARTNERS.get(parameter.name, (parameter.name, None))
        with probe.parameters_kept(parameter.name, partner):
            if room is not None:
                probe.set_parameter(partner, room)
            for good in _inside(parameter, probe.value_of(parameter.name)):
                probe.set_parameter(parameter.name, good)
                seen = float(probe.telemetry("parameter")["value"])
                same = abs(seen - good) <= F32_ROUNDING * max(abs(good), 1e-30)
                check(same, f"{parameter.name} {good!r}", f"{seen!r}")

    name = parameter.name
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
        bad += [float(gap) for gap in sorted(set(numbers) - set(parameter.enum.values.values()))]
    return bad


def _inside(parameter: Parameter, present: float) -> list[float]:
    """Yield values that a parameter must accept."""
    if parameter.name in LINK_PARAMETERS:
        return [present]
    if parameter.enum is not None:
        return [float(number) for number in parameter.enum.values.values()]
    greatest = [] if parameter.name in UNSET else [parameter.maximum]
    return [parameter.minimum, *greatest, parameter.to_number(parameter.default)]
