"""Requirements on a performance report, from a TOML file, and their verdicts.

    [[requirement]]
    id = "STR-010"
    figure = "total.across"     # arcseconds; `starhil campaign --figures` lists all names
    max = 60.0
    text = "Attitude error across the boresight"

    [[requirement]]
    id = "STR-020"
    figure = "rate.0.3.correct" # per cent
    min = 99.0

A figure is known only to an interval: a probability to its confidence interval, an error that is not significant to the
smallest significant one. A requirement is met, or not met, if all of the interval is on one side of its limit; else the campaign
has not shown it, and more images would.
"""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Annotated, Final, Literal, NamedTuple, TypeAlias

from pydantic import Field, ValidationError, model_validator

from starhil.emulator.errors import EmulatorError
from starhil.emulator.profile.toml_file import read_toml
from starhil.emulator.simulation.config_model import Strict
from starhil.protocol.errors import did_you_mean
from starhil.protocol.files.validation import problems

Verdict: TypeAlias = Literal["met", "not met", "not shown"]
MAX_REQUIREMENTS: Final = 1000


class Figure(NamedTuple):
    """A figure of the report and the interval to which it is known."""

    value: float
    """The estimate; NaN if it was not evaluated."""
    low: float
    high: float
    unit: str


class Requirement(Strict):
    """A limit on a figure."""

    id: Annotated[str, Field(min_length=1, max_length=60)]
    """Identifier in your specification."""
    figure: str
    min: float | None = None
    max: float | None = None
    text: Annotated[str, Field(max_length=300)] = ""
    """What is required, in words."""

    @model_validator(mode="after")
    def _limit(self) -> Requirement:
        if (self.min is None) == (self.max is None):
            raise ValueError("give either min or max")
        return self

    @property
    def limit(self) -> str:
        return f"at least {self.min:g}" if self.min is not None else f"at most {self.max:g}"

    def verdict(self, figure: Figure) -> Verdict:
        met = figure.low >= self.min if self.min is not None else figure.high <= (self.max or 0.0)
        missed = figure.high < self.min if self.min is not None else figure.low > (self.max or 0.0)
        return "met" if met else "not met" if missed else "not shown"


class _Requirements(Strict):
    requirement: Annotated[
        tuple[Requirement, ...], Field(min_length=1, max_length=MAX_REQUIREMENTS, strict=False)
    ]


def read_requirements(path: Path, figures: Collection[str]) -> tuple[Requirement, ...]:
    """Read a file of requirements.

    Raises EmulatorError: it cannot be read, is not valid, or names a figure that the report does not have.
    """
    values = read_toml(path, "requirements")
    try:
        requirements = _Requirements.model_validate(values).requirement
    except ValidationError as error:
        raise EmulatorError(
            *(f"requirements {path}: {problem}" for problem in problems(error, _Requirements, values))
        ) from None
    unknown = [
        f"requirements {path}: {item.id}: no figure {item.figure!r}"
        f"{did_you_mean(item.figure, figures) or '; starhil campaign --figures lists them'}"
        for item in requirements
        if item.figure not in figures
    ]
    if unknown:
        raise EmulatorError(*unknown)
    return requirements
