"""All cases of a link: those that the definition of a unit yields, and the unit's own.

A unit's own cases are beside its definition, in files `*_cases.toml` (`case_file`) and `*_cases.py`. A Python file defines
areas (`CaseArea`), whose cases get the probe of the link, or a function `generated`, which yields cases on serial and CAN
for a given definition. If a file defines `settings`, that creates the object which records the settings of the unit before
a run on these links, and restores them afterwards. An own case replaces the derived one with the same ID.
"""

from __future__ import annotations

import runpy
from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path
from typing import Any

from starhil.hil_tests.conformance.can_cases import can_cases, can_names
from starhil.hil_tests.conformance.case import Case, CaseArea, on_link
from starhil.hil_tests.conformance.case_file import text_cases
from starhil.hil_tests.conformance.link_probe import ReadableSettings, Settings
from starhil.hil_tests.conformance.serial_cases import serial_cases, serial_names
from starhil.hil_tests.errors import BenchError
from starhil.hil_tests.judge.definition import Unit


def serial_suite(unit: Unit) -> tuple[Case[Any], ...]:
    """Return the cases for a unit on a serial line; raises BenchError if it has none."""
    return suite(
        unit, "serial", unit.serial, serial_cases, lambda path: text_cases(path, "serial", serial_names(unit))
    )


def can_suite(unit: Unit) -> tuple[Case[Any], ...]:
    """Return the cases for a unit on CAN; raises BenchError if it has no such link."""
    return suite(unit, "CAN", unit.can, can_cases, lambda path: text_cases(path, "can", can_names(unit)))


def settings_of(unit: Unit) -> Settings:
    """Return what records and restores the settings of a unit: its own object, or one for any unit."""
    for path in _own_files(unit, "*_cases.py"):
        if "settings" in (contents := _contents(path)):
            own: Settings = contents["settings"]()
            return own
    return ReadableSettings()


def suite(
    unit: Unit,
    name: str,
    model: object,
    derived: Callable[[Unit], Iterable[Case[Any]]],
    in_file: Callable[[Path], Iterable[Case[Any]]],
) -> tuple[Case[Any], ...]:
    """Return derived and own cases; `in_file` returns those of a file `*_cases.toml`.

    Raises BenchError: the unit has no such link, or a file is wrong or fails; the text names it.
    """
    if model is None:
        raise BenchError(f"unit {unit.name}: has no {name} link")
    link, cases = name.lower(), list(derived(unit))
    for path in _own_files(unit, "*_cases.*"):
        if path.suffix == ".toml":
            cases += in_file(path)
        elif path.suffix == ".py":
            contents = _contents(path)
            for area in contents.values():
                cases += area.cases if isinstance(area, CaseArea) and link in area.links else ()
            if "generated" in contents and link in CaseArea.links:
                cases += contents["generated"](unit)
    return on_link(link, cases)


def _own_files(unit: Unit, pattern: str) -> list[Path]:
    return sorted(unit.folder.glob(pattern)) if unit.folder is not None else []


@cache
def _contents(path: Path) -> dict[str, Any]:
    try:
        return runpy.run_path(str(path), run_name=path.stem)
    except Exception as error:
        raise BenchError(f"{path}: {type(error).__name__}: {error}") from error
