"""All cases of a link, under identifiers that begin with the link's name."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

from starhil.hil_tests.conformance import behaviour_cases, can_cases, image_cases, serial_cases, traffic_cases
from starhil.hil_tests.conformance.can_probe import CanProbe
from starhil.hil_tests.conformance.case import Case
from starhil.hil_tests.conformance.row_cases import row_cases
from starhil.hil_tests.conformance.serial_probe import SerialProbe
from starhil.protocol.icd import InterfaceDefinition


def serial_suite(icd: InterfaceDefinition) -> tuple[Case[SerialProbe], ...]:
    """Return the cases for a device on a serial line."""
    return _named("serial", serial_cases.CASES, _common(icd))


def can_suite(icd: InterfaceDefinition) -> tuple[Case[CanProbe], ...]:
    """Return the cases for a device on CAN."""
    return _named("can", can_cases.CASES, _common(icd))


def _common(icd: InterfaceDefinition) -> list[Case[Any]]:
    return [*row_cases(icd), *behaviour_cases.CASES, *image_cases.CASES, *traffic_cases.CASES]


def _named(link: str, *tables: Iterable[Case[Any]]) -> tuple[Case[Any], ...]:
    """Put the link before identifier and area; the area is the first part of the identifier."""
    return tuple(
        replace(item, id=f"{link}.{item.id}", area=f"{link}.{item.id.split('.', 1)[0]}")
        for table in tables
        for item in table
    )
