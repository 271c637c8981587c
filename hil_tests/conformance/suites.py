"""All cases of a link: those that the definition of a unit yields, and the unit's own.

A unit's own cases stand beside its definition, in files `*_cases.toml` (`case_file`) and `*_cases.py`. Each of the latter
defines areas (`CaseArea`), whose cases get the probe of the link, or a function `generated`, which yields cases for the
definition that it gets; `settings`, if a file defines it, makes the object that records and restores the settings of the
unit around a run. A case whose ID the definition yields too replaces that case.
"""

from __future__ import annotations

import runpy
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

from starhil.hil_tests.conformance.can_cases import can_cases, can_names
from starhil.hil_tests.conformance.case import Case, CaseArea
from starhil.hil_tests.conformance.case_file import CaseFile, read_case_file
from starhil.hil_tests.conformance.link_probe import ReadableSettings, Settings
from starhil.hil_tests.conformance.serial_cases import serial_cases, serial_names
from starhil.hil_tests.errors import BenchError
from starhil.hil_tests.judge.definition import Unit


def serial_suite(unit: Unit) -> tuple[Case[Any], ...]:
    """Return the cases for a unit on a serial line; raises BenchError if it has none."""
    return _suite(unit, "serial", unit.serial, serial_cases, serial_names)


def can_suite(unit: Unit) -> tuple[Case[Any], ...]:
    """Return the cases for a unit on CAN; raises BenchError if it has no such link."""
    return _suite(unit, "CAN", unit.can, can_cases, can_names)


def settings_of(unit: Unit) -> Settings:
    """Return what records and restores the settings of a unit: its own object, or one for any unit."""
    for contents in _own_files(unit.folder):
        if not isinstance(contents, CaseFile) and "settings" in contents:
            own: Settings = contents["settings"]()
            return own
    return ReadableSettings()


def _suite(
    unit: Unit,
    name: str,
    model: object,
    derived: Callable[[Unit], Iterable[Case[Any]]],
    names: Callable[[Unit], Mapping[str, str]],
) -> tuple[Case[Any], ...]:
    """Return derived and own cases, with IDs and areas that begin with the link."""
    if model is None:
        raise BenchError(f"unit {unit.name}: has no {name} link")
    link = name.lower()
    found = {item.id: item for item in derived(unit)}
    for contents in _own_files(unit.folder):
        if isinstance(contents, CaseFile):
            own = list(contents.cases(link, names(unit)))
        else:
            areas = [area for area in contents.values() if isinstance(area, CaseArea) and link in area.links]
            own = [item for area in areas for item in area.cases]
            own += contents["generated"](unit) if "generated" in contents else []
        found |= {item.id: item for item in own}
    return tuple(
        replace(item, id=f"{link}.{item.id}", area=f"{link}.{item.id.split('.', 1)[0]}")
        for item in found.values()
    )


@cache
def _own_files(folder: Path | None) -> tuple[CaseFile | dict[str, Any], ...]:
    """Read or run the files with a unit's own cases.

    Raises BenchError: a file is wrong or fails; the text names it.
    """
    found: list[CaseFile | dict[str, Any]] = []
    for path in sorted(folder.glob("*_cases.*")) if folder is not None else ():
        if path.suffix == ".toml":
            found.append(read_case_file(path))
        elif path.suffix == ".py":
            try:
                found.append(runpy.run_path(str(path), run_name=path.stem))
            except Exception as error:
                raise BenchError(f"{path}: {type(error).__name__}: {error}") from error
    return tuple(found)
