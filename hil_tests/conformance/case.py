"""A conformance case: what it checks, its source, and its function; and the probe that the function gets."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from types import ModuleType
from typing import Any, Generic, TypeVar

from starhil.hil_tests.attitude import Quaternion
from starhil.hil_tests.conformance.ports import Port
from starhil.hil_tests.judge.links import BUSES
from starhil.hil_tests.judge.messages import Value
from starhil.hil_tests.judge.rows import Field, Row

ProbeType = TypeVar("ProbeType")

TruthSource = Callable[[], Quaternion]
"""Returns the true attitude from ICRS to the sensor at present."""


class CaseFailed(Exception):  # noqa: N818 (the outcome of a case, not an error of the bench)
    """The device violated the rule; what was expected and what was seen, one line each."""

    def __init__(self, expected: str, seen: str) -> None:
        super().__init__(f"expected {expected}; seen {seen}")
        self.expected = expected
        self.seen = seen


class CaseSkipped(Exception):  # noqa: N818 (the outcome of a case, not an error of the bench)
    """The device lacks a feature that the case needs; the text names it."""


class Probe(ABC):
    """Talks to a unit over a link. The run sets `truth` if the true attitude is known; `log` has the sent and received traffic."""

    link: str
    """Name in the table of links."""

    def __init__(self, port: Port[Any]) -> None:
        self.port = port
        self.log: list[str] = []
        self.truth: TruthSource | None = None

    def now(self) -> float:
        """Time of the port, s."""
        return self.port.now()

    @abstractmethod
    def sleep(self, seconds: float) -> None:
        """Wait."""

    @abstractmethod
    def drain(self) -> None:
        """Discard everything received."""

    # --- rows ---

    @abstractmethod
    def telecommands(self) -> Iterable[Row]:
        """Return the telecommands that the link carries."""

    @abstractmethod
    def telemetry_rows(self) -> Iterable[Row]:
        """Return the telemetry that the link carries."""

    def carries(self, row: Row, item: Field) -> bool:  # noqa: ARG002 -- most links, every row whole
        return True

    @abstractmethod
    def values(self, row: Row) -> dict[str, Value]:
        """Read the values of a row; one outside its limits fails the case."""

    @abstractmethod
    def command(self, name: str, **values: Value) -> None:
        """Send a telecommand by name, which must be accepted."""

    # --- around a case ---

    @abstractmethod
    def begin(self, *, intrusive: bool) -> None:
        """Prepare for a case."""

    @abstractmethod
    def end(self, *, intrusive: bool, passed: bool) -> None:
        """Check the conditions that must hold after a case, and prepare for the next one.

        Raises `CaseFailed` if they do not hold.
        """

    @abstractmethod
    def recover(self) -> None:
        """Wait for the after-effects of a failed case."""

    # --- around a run ---

    @abstractmethod
    def identity(self) -> str:
        """Return what the device reports of its identity."""

    @abstractmethod
    def silence(self, *, booting: bool) -> str | None:
        """Return None if the device answers, otherwise the invalid answer or `nothing`."""

    @abstractmethod
    def prepare(self) -> None:
        """Record the settings of the device before cases that change them."""

    @abstractmethod
    def restore(self) -> None:
        """Restore the settings after such cases."""


@dataclass(frozen=True)
class Case(Generic[ProbeType]):
    """One check."""

    id: str
    """Dotted name, unique: link, area, check."""
    area: str
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
    links: tuple[str, ...] = BUSES
    cases: list[Case[ProbeType]] = field(default_factory=list)

    def case(
        self, name: str, title: str, clause: str | None = None, *, intrusive: bool | None = None
    ) -> Callable[[Callable[[ProbeType], None]], Callable[[ProbeType], None]]:
        def register(run: Callable[[ProbeType], None]) -> Callable[[ProbeType], None]:
            source = self.clause if clause is None else clause
            changes = self.intrusive if intrusive is None else intrusive
            self.cases.append(case_in(self.name, name, title, run, source, intrusive=changes))
            return run

        return register


def clause_of(row: Row) -> str:
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
