"""A conformance case: what it checks, its source, and its function."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from types import ModuleType
from typing import Any, Generic, TypeVar

from starhil.hil_tests.judge.rows import Row

ProbeType = TypeVar("ProbeType")


class CaseFailed(Exception):  # noqa: N818 (the outcome of a case, not an error of the bench)
    """The device violated the rule; what was expected and what was seen, one line each."""

    def __init__(self, expected: str, seen: str) -> None:
        super().__init__(f"expected {expected}; seen {seen}")
        self.expected = expected
        self.seen = seen


class CaseSkipped(Exception):  # noqa: N818 (the outcome of a case, not an error of the bench)
    """The device lacks a feature that the case needs; the text names it."""


@dataclass(frozen=True)
class Case(Generic[ProbeType]):
    """One check."""

    id: str
    """Dotted name, unique: link, area, check."""
    area: str
    """Area of the protocol."""
    title: str
    """The checked behaviour, one line."""
    clause: str
    """Clause of a standard, or the source that confirms the behaviour."""
    run: Callable[[ProbeType], None]
    """Performs the check with a probe; raises `CaseFailed` or `CaseSkipped`."""
    intrusive: bool = False
    """Whether the case changes settings or state of the device, so that it is not for a unit in use."""


@dataclass(frozen=True)
class CaseArea(Generic[ProbeType]):
    """The cases of one area of the protocol, in the order of their declaration; its name is the prefix of their IDs.

    `clause` and `intrusive` are defaults; a unit's own cases run on `links`.
    """

    name: str
    clause: str
    intrusive: bool = False
    links: tuple[str, ...] = ("serial", "can")
    cases: list[Case[ProbeType]] = field(default_factory=list)

    def case(
        self, name: str, title: str, clause: str | None = None, *, intrusive: bool | None = None
    ) -> Callable[[Callable[[ProbeType], None]], Callable[[ProbeType], None]]:
        """Register a function as a case."""

        def register(run: Callable[[ProbeType], None]) -> Callable[[ProbeType], None]:
            source = self.clause if clause is None else clause
            changes = self.intrusive if intrusive is None else intrusive
            self.cases.append(case_in(self.name, name, title, run, source, intrusive=changes))
            return run

        return register


def clause_of(row: Row) -> str:
    """Return the source of a row."""
    return f"{row.kind} {row.name} ({row.provenance}{': ' + row.source if row.source else ''})"


def case_in(
    area: str,
    name: str,
    title: str,
    run: Callable[[Any], None],
    clause: str | Row,
    *,
    intrusive: bool = False,
) -> Case[Any]:
    """Return a case of an area; the clause may be a row, for its source."""
    source = clause_of(clause) if isinstance(clause, Row) else clause
    return Case(f"{area}.{name}", area, title, source, run, intrusive)


def cases_of(*modules: ModuleType) -> list[Case[Any]]:
    """Return the cases of all areas defined in modules, in order."""
    areas = (item for module in modules for item in vars(module).values() if isinstance(item, CaseArea))
    return [case for area in areas for case in area.cases]


def on_link(link: str, cases: Iterable[Case[Any]]) -> tuple[Case[Any], ...]:
    """Return cases with IDs and areas that begin with the link; of those with the same ID the last, in place of the first."""
    found = {item.id: item for item in cases}
    return tuple(
        replace(item, id=f"{link}.{item.id}", area=f"{link}.{item.id.split('.', 1)[0]}")
        for item in found.values()
    )


def rule(number: int) -> str:
    """Return the clause for a rule of this product (docs/rules.md)."""
    return f"R{number}, docs/rules.md"


def check(condition: object, expected: str, seen: object) -> None:
    """Raise `CaseFailed` unless the condition holds."""
    if not condition:
        raise CaseFailed(expected, _text(seen))


def check_equal(seen: object, expected: object, what: str) -> None:
    """Raise `CaseFailed` unless two values are equal."""
    if seen != expected:
        raise CaseFailed(f"{what} {_text(expected)}", _text(seen))


def _text(value: object) -> str:
    if value is None:
        return "nothing"
    return value.hex(" ") if isinstance(value, bytes | bytearray) else str(value)
