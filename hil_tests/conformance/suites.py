"""All cases of a link: those that the definition of a unit yields, and the unit's own.

A unit's own cases are Python files `*_cases.py` beside its definition. Each defines areas (`CaseArea`), whose cases
get the probe of the link, or a function `generated`, which yields cases for the definition that it gets; `settings`,
if a file defines it, makes the object that records and restores the settings of the unit around a run. A case whose
ID the definition yields too replaces that case.
"""

from __future__ import annotations

import runpy
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

from starhil.hil_tests.conformance.can_cases import can_cases
from starhil.hil_tests.conformance.case import Case, CaseArea
from starhil.hil_tests.conformance.link_probe import ReadableSettings, Settings
from starhil.hil_tests.conformance.serial_cases import serial_cases
from starhil.hil_tests.errors import BenchError
from starhil.hil_tests.judge.definition import Unit


def serial_suite(unit: Unit) -> tuple[Case[Any], ...]:
    """Return the cases for a unit on a serial line; raises BenchError if it has none."""
    return _suite(unit, "serial", unit.serial, serial_cases)


def can_suite(unit: Unit) -> tuple[Case[Any], ...]:
    """Return the cases for a unit on CAN; raises BenchError if it has no such link."""
    return _suite(unit, "CAN", unit.can, can_cases)


def settings_of(unit: Unit) -> Settings:
    """Return what records and restores the settings of a unit: its own object, or one for any unit."""
    for contents in _own_files(unit.folder):
        if "settings" in contents:
            own: Settings = contents["settings"]()
            return own
    return ReadableSettings()


def _suite(
    unit: Unit, name: str, model: object, derived: Callable[[Unit], Iterable[Case[Any]]]
) -> tuple[Case[Any], ...]:
    """Return derived and own cases, with IDs and areas that begin with the link."""
    if model is None:
        raise BenchError(f"unit {unit.name}: has no {name} link")
    link = name.lower()
    found = {item.id: item for item in derived(unit)}
    for contents in _own_files(unit.folder):
        areas = [area for area in contents.values() if isinstance(area, CaseArea) and link in area.links]
        own = [item for area in areas for item in area.cases]
        own += contents["generated"](unit) if "generated" in contents else []
        found |= {item.id: item for item in own}
    return tuple(
        replace(item, id=f"{link}.{item.id}", area=f"{link}.{item.id.split('.', 1)[0]}")
        for item in found.values()
    )


@cache
def _own_files(folder: Path | None) -> tuple[dict[str, Any], ...]:
    """Run the files with a unit's own cases.

    Raises BenchError: a file fails; the text names it.
    """
    found = []
    for path in sorted(folder.glob("*_cases.py")) if folder is not None else ():
        try:
            found.append(runpy.run_path(str(path), run_name=path.stem))
        except Exception as error:
            raise BenchError(f"{path}: {type(error).__name__}: {error}") from error
    return tuple(found)
