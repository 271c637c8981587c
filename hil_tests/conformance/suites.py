"""All cases of a link, with IDs that begin with the name of the link."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any, Final

from starhil.hil_tests.conformance import behaviour_cases, image_cases, serial_cases, traffic_cases
from starhil.hil_tests.conformance.can_cases import can_cases
from starhil.hil_tests.conformance.case import Case, cases_of
from starhil.hil_tests.conformance.row_cases import row_cases
from starhil.hil_tests.conformance.unit_cases import unit_cases, unit_row_cases
from starhil.hil_tests.errors import BenchError
from starhil.protocol.icd import InterfaceDefinition

CUBESTAR_ROWS: Final = frozenset(
    {"identification", "communication_status", "acknowledge", "device_status", "parameter"}
)
"""Telemetry rows that the cases for CubeStar need."""


def is_cubestar(icd: InterfaceDefinition) -> bool:
    """Return whether a unit has the rows that the cases for CubeStar need; other units get derived cases."""
    return icd.telemetry.keys() >= CUBESTAR_ROWS


def serial_suite(icd: InterfaceDefinition) -> tuple[Case[Any], ...]:
    """Return the cases for a unit on a serial line: CubeStar's, or cases derived from its definition.

    Raises
    ------
    BenchError
        The unit has no serial link.
    """
    if icd.link.serial is None:
        raise BenchError(f"unit {icd.name}: has no serial link")
    if is_cubestar(icd):
        return _named("serial", cases_of(serial_cases), _common(icd))
    return _named("serial", unit_cases(icd))


def can_suite(icd: InterfaceDefinition) -> tuple[Case[Any], ...]:
    """Return the cases for a unit on CAN: CubeStar's, or cases derived from its definition.

    Raises
    ------
    BenchError
        The unit has no CAN link.
    """
    if icd.link.can is None:
        raise BenchError(f"unit {icd.name}: has no CAN link")
    cubestar = is_cubestar(icd)
    rows = _common(icd) if cubestar else unit_row_cases(icd, clause="[link.can]")
    return _named("can", can_cases(icd, cubestar=cubestar), rows)


def _common(icd: InterfaceDefinition) -> list[Case[Any]]:
    return [*row_cases(icd), *cases_of(behaviour_cases, image_cases, traffic_cases)]


def _named(link: str, *tables: Iterable[Case[Any]]) -> tuple[Case[Any], ...]:
    """Prefix case ID and area with the link; the area is the first part of the ID."""
    return tuple(
        replace(item, id=f"{link}.{item.id}", area=f"{link}.{item.id.split('.', 1)[0]}")
        for table in tables
        for item in table
    )
