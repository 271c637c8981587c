"""Telemetry values that no derived case can judge, because only their limits are known; they are listed as skipped."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import partial
from typing import Any, Final

from starhil.hil_tests.conformance.attitude_cases import AttitudeRow, changes_mode
from starhil.hil_tests.conformance.case import Case, CaseSkipped, Probe, case_in
from starhil.hil_tests.conformance.clock_cases import (
    COUNT_INCREMENTS,
    FRAMES,
    counts_of,
    plain_command,
    times_of,
)
from starhil.hil_tests.conformance.link_probe import REPORT_QUANTITIES
from starhil.hil_tests.judge.definition import Unit
from starhil.hil_tests.judge.rows import Field, Row

AREA: Final = "unjudged"
CLAUSE: Final = "[[telemetry]]: `value` of a field"
PLUGIN: Final = "plugin"
NAMED_FIELDS: Final = 3
"""Number of fields that a reason names; reports have all."""


def unjudged_cases(unit: Unit, fields: Iterable[tuple[Row, Field]]) -> Iterator[Case[Any]]:
    """Yield a case for each kind of quantity that these fields report, which no other case judges."""
    groups: dict[str, list[str]] = {}
    for row, item in fields:
        if item.quantity:
            groups.setdefault(_kind(unit, item), []).append(f"{row.name}.{item.name} ({item.quantity})")
    for kind, found in groups.items():
        whose = "quantities of the plugin" if kind == PLUGIN else f"quantities {kind}"
        title = f"values of {whose}, of which a derived case knows only the limits"
        yield case_in(AREA, kind, title, partial(_listed, kind, found), CLAUSE)


def is_unjudged(area: str) -> bool:
    """Return whether the cases of an area only list values."""
    return area.endswith(f".{AREA}")


def unjudged_fields(unit: Unit, compared: Iterable[tuple[Row, str]]) -> Iterator[tuple[Row, Field]]:
    """Yield the fields that no case of a serial line or CAN judges; `compared` are judged by cases of several rows."""
    fields = {(row.name, name) for row, name in compared}
    for row in unit.telemetry.values():
        judged = {item.name for item in _judged(unit, row)}
        for name, item in row.named.items():
            if name not in judged and (row.name, name) not in fields:
                yield row, item


def _kind(unit: Unit, item: Field) -> str:
    if unit.plugin is not None and item.quantity in unit.plugin.quantities:
        return PLUGIN
    return item.quantity.partition(".")[0].partition("[")[0]


def _listed(kind: str, fields: list[str], probe: Probe) -> None:
    probe.log += [f"not judged: {name}" for name in fields]
    names = ", ".join(fields[:NAMED_FIELDS])
    listed = names if len(fields) <= NAMED_FIELDS else f"{len(fields)} fields, such as {names}"
    remedy = "a file *_cases.py beside the definition can judge them" + (
        "; an attitude is judged in quantities attitude.…" if kind == PLUGIN else ""
    )
    raise CaseSkipped(f"{listed}; {remedy}")


def _judged(unit: Unit, row: Row) -> Iterator[Field]:
    """Yield the fields of a row that cases of the row compare with something else than their limits."""
    if row.only_sent and not row.is_streamed:
        return
    yield from stated(unit, row)
    yield from (item for item in row.named.values() if item.quantity in REPORT_QUANTITIES)
    for time in times_of(row):
        yield from time.fields
    if not row.only_sent:
        commanded = plain_command(unit) is not None
        yield from (
            item
            for item in counts_of(row, COUNT_INCREMENTS)
            if COUNT_INCREMENTS[item.quantity][0] or commanded
        )
    yield from counts_of(row, FRAMES)


def stated(unit: Unit, row: Row) -> Iterator[Field]:
    """Yield the fields of a row that are judged on any link: constants, attitudes, and the mode if it can be commanded."""
    yield from (item for item in row.named.values() if item.const is not None)
    if changes_mode(unit.telecommands.values()):
        yield from (item for item in row.named.values() if item.quantity == "mode")
    attitude = AttitudeRow.of(row, unit.conventions)
    if attitude is not None:
        yield from (item for reading in attitude.readings for item in reading.fields)
        yield from (item for item in row.named.values() if item.name == attitude.flag)
