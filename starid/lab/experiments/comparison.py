"""Checks against published numbers: agreement within a stated tolerance, or improvement on the number.

`compared` makes the row of a quantity from what an experiment measured and what the thesis prints. The check is
a word and its arguments, in a column of `published.csv` or formed by an experiment for a line of a large table:

=================  ===============================================================================
``digit``          half of the last of the digits shown
``rounding N``     half of the Nth decimal
``sampling N``     three standard errors of two shares of N trials (without N: of the trials made)
``mean S N``       three standard errors of two means of N trials with the standard deviation S
``deviation S N``  the same of two standard deviations
``coefficient N``  the same of two correlation coefficients
``X ORIGIN``       at most X, and why
``same``           equal, each of several numbers
``> X``, ``< X``   larger or smaller than X; the thesis has a phrase
``more``, ``less`` ours is better, as it is larger or smaller
``≥ X``, ``≤ X``   a requirement of this project on ours
=================  ===============================================================================

An agreement says little if one constant answer agrees with a whole column of a table: `null_model` finds the best one
and marks the checks that it meets as weak. (Constants fitted to published numbers: see `tables`.)
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Literal

import numpy as np

from starid.errors import StaridError

Kind = Literal["", "agrees", "fitted", "better", "ours"]
"""Class of a check: agreement with a published number, the same after a constant was fitted to that number (only in
the report, see `tables`), improvement on it, our own bound, or none ("")."""


class ReproduceError(StaridError):
    """A reproduction that cannot be run as requested."""


@dataclass(frozen=True, slots=True)
class Row:
    """A row of the report: a quantity with the published value and ours, "—" if there is none, and a check, if any.

    Attributes
    ----------
    author, printed
        The values from the author's version of the algorithm, and from the printed one.
    target, passed, kind
        What is checked, with the tolerance and its origin; the outcome, None without a check; class of the check.
    met, of
        How many of the published numbers in the row agree, and how many there are.
    interval
        Lowest and highest value that agrees, for one published number.
    weak, weak_met
        How many of the numbers the best constant answer of the null model meets as well, and how many of these agree.
    """

    quantity: str
    published: str
    ours: str
    target: str = ""
    passed: bool | None = None
    remark: str = ""
    author: str = "—"
    printed: str = "—"
    kind: Kind = ""
    met: int = 0
    of: int = 0
    interval: tuple[float, ...] = ()
    weak: int = 0
    weak_met: int = 0


@dataclass(frozen=True, slots=True)
class Outcome:
    """What an experiment adds to the report: rows, names of files, and paragraphs of Markdown."""

    rows: tuple[Row, ...]
    files: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def failed(self) -> tuple[Row, ...]:
        """Rows whose check failed."""
        return tuple(row for row in self.rows if row.passed is False)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Outcome:
        """Make an outcome from the values of `dataclasses.asdict`."""
        rows = tuple(Row(**{**row, "interval": tuple(row["interval"])}) for row in values["rows"])
        return cls(rows, tuple(values["files"]), tuple(values["notes"]))


@dataclass(frozen=True, slots=True)
class Published:
    """What the thesis prints of a quantity: a number, several separated by spaces, a phrase, or "" for nothing.

    `digits` are the decimals with which the report shows it; without a check it is only shown.
    """

    text: str
    unit: str = ""
    digits: int = 2
    check: str = ""
    remark: str = ""

    @property
    def numbers(self) -> list[float]:
        """The numbers; none in a phrase."""
        try:
            return [float(word) for word in self.text.split()]
        except ValueError:
            return []


def space_before(unit: str) -> str:
    """Separator between a number and its unit."""
    return "" if unit in ("", "°", "″") else " "


def value_text(value: Any, unit: str, digits: int) -> str:
    """Format a number, several numbers or a text for the report; "—" for None."""
    if value is None or isinstance(value, str):
        return value or "—"
    if np.ndim(value) > 0:
        return ", ".join(f"{each:.{digits}f}" for each in value) + unit
    return f"{value:.{digits}f}{space_before(unit)}{unit}"


_ROUNDING_ERROR: Final = 1e-12
"""A published deviation below this is a rounding error."""

Tolerance = tuple[float, str]
"""Largest difference from the published number, and its origin."""


def _rounding(digits: int, unit: str) -> Tolerance:
    return 0.501 * 10.0**-digits, f"half of the last digit, {0.5 * 10.0**-digits:g}{space_before(unit)}{unit}"


def _share(percent: float, trials: float) -> float:
    """The standard error is that of (k + 1)/(n + 2), so that a published 0 or 100 % has an uncertainty too."""
    share = (0.01 * percent * trials + 1.0) / (trials + 2.0)
    return 300.0 * math.sqrt(2.0 * share * (1.0 - share) / trials)


def _mean(_: float, sigma: float, trials: float) -> float:
    return 3.0 * max(sigma, _ROUNDING_ERROR) * math.sqrt(2.0 / trials)


def _deviation(_: float, sigma: float, trials: float) -> float:
    return 3.0 * max(sigma, _ROUNDING_ERROR) / math.sqrt(trials - 1.0)


def _coefficient(published: float, trials: float) -> float:
    """By Fisher's transformation."""
    return 3.0 * (1.0 - published**2) * math.sqrt(2.0 / (trials - 3.0))


_SAMPLED: Final[dict[str, tuple[str, str, Callable[..., float]]]] = {
    "sampling": ("shares", " %", _share),
    "mean": ("means", "", _mean),
    "deviation": ("deviations", "", _deviation),
    "coefficient": ("coefficients", "", _coefficient),
}
"""Word of a check → what is sampled, its unit, and three standard errors of the difference of two."""
_BOUNDS: Final[dict[str, tuple[Kind, Callable[[Any, Any], bool]]]] = {
    ">": ("agrees", operator.gt),
    "<": ("agrees", operator.lt),
    "≥": ("ours", operator.ge),
    "≤": ("ours", operator.le),
}


def _tolerance(published: Published, trials: int) -> Tolerance:
    word, _, rest = published.check.partition(" ")
    if word == "same":
        return 0.0, "the same"
    if word in ("digit", "rounding"):
        return _rounding(published.digits if word == "digit" else int(rest), published.unit)
    if word in _SAMPLED:
        what, unit, error_of = _SAMPLED[word]
        arguments = [float(each) for each in rest.split()] or [trials]
        error = error_of(published.numbers[0], *arguments)
        return error, f"3 standard errors of two {what} of {arguments[-1]:g}, {error:.2g}{unit}"
    return float(word), rest


def compared(
    quantity: str,
    entry: Published,
    *,
    author: Any = None,
    printed: Any = None,
    ours: Any = None,
    trials: int = 0,
    remark: str = "",
) -> Row:
    """Compare what was measured with what the thesis prints.

    `author`, `printed` and `ours` are a number, as many as are published, or a text; the first that is given is
    checked. `trials` is the number of trials for the tolerance ``sampling``; the remark is added to that of the table.

    Raises
    ------
    ReproduceError
        There is no number to check.
    """
    numbers, unit = entry.numbers, entry.unit
    published = entry.text if not numbers else numbers[0] if len(numbers) == 1 else numbers
    one, two, three, four = (
        value_text(each, unit, entry.digits) for each in (published, ours, author, printed)
    )
    informing = Row(quantity, one, two, author=three, printed=four, remark=f"{entry.remark} {remark}".strip())
    if not entry.check:
        return informing
    checked = next((value for value in (author, printed, ours) if value is not None), None)
    if checked is None or isinstance(checked, str):
        raise ReproduceError(
            f"reproduce: {quantity}: there is no number to compare; give author, printed or ours"
        )
    word, _, rest = entry.check.partition(" ")
    if word in _BOUNDS:
        kind, holds = _BOUNDS[word]
        return _checked(
            informing,
            kind,
            f"{word} {float(rest):g}{space_before(unit)}{unit}",
            [holds(checked, float(rest))],
        )
    if word in ("more", "less"):
        return _improved(informing, entry, checked, numbers[0], larger=word == "more")
    largest, origin = _tolerance(entry, trials)
    matches = [bool(abs(a - b) <= largest) for a, b in zip(np.atleast_1d(checked), numbers, strict=True)]
    target = origin if word == "same" else f"± {origin}" if len(numbers) == 1 else f"each ± {origin}"
    interval = (numbers[0] - largest, numbers[0] + largest) if len(numbers) == 1 else ()
    return replace(_checked(informing, "agrees", target, matches), interval=interval)


def _checked(informing: Row, kind: Kind, target: str, matches: Sequence[bool]) -> Row:
    """Turn a row into a check that passes if all its numbers match."""
    met, of = sum(map(bool, matches)), len(matches)
    remark = f"{met} of {of} agree. {informing.remark}".strip() if of > 1 else informing.remark
    return replace(informing, kind=kind, target=target, passed=met == of, met=met, of=of, remark=remark)


def _improved(informing: Row, known: Published, ours: float, published: float, *, larger: bool) -> Row:
    """Check that ours is better than a published number; the remark states by how much."""
    gain = ours - published if larger else published - ours
    better = f"by {value_text(gain, known.unit, known.digits)}"
    if ours > 0.0 and published > 0.0 and not larger and published >= 2.0 * ours:
        better = f"by a factor of {published / ours:.3g}"
    made = _checked(informing, "better", f"{'≥' if larger else '≤'} {informing.published}", [gain >= 0.0])
    return replace(made, remark=f"Better {better}. {made.remark}".strip()) if made.passed else made


def claimed(
    quantity: str,
    *,
    matches: Sequence[bool],
    target: str,
    published: str = "—",
    author: str = "—",
    printed: str = "—",
    ours: str = "—",
    remark: str = "",
    null: Sequence[bool] = (),
    kind: Kind = "agrees",
) -> Row:
    """Make a row for what no number states; `target` names the rule by which each of several claims holds or not.

    `null` says which of them the null model meets.
    """
    made = _checked(
        Row(quantity, published, ours, author=author, printed=printed, remark=remark), kind, target, matches
    )
    weak_met = sum(bool(a and b) for a, b in zip(matches, null, strict=True)) if null else 0
    return replace(made, weak=sum(map(bool, null)), weak_met=weak_met)


def best_constant(intervals: Iterable[Sequence[float]]) -> float:
    """Value in most of the intervals: the best answer that ignores all that varies within a table."""
    known = list(intervals)
    return max((low for low, _ in known), key=lambda value: sum(low <= value <= high for low, high in known))


def null_model(rows: Sequence[Row]) -> list[Row]:
    """Mark as weak the checks in one column of a table that its best constant answer meets as well."""
    intervals = [row.interval for row in rows if row.interval]
    if not intervals:
        return list(rows)
    constant = best_constant(intervals)
    return [
        replace(row, weak=row.of, weak_met=row.met)
        if row.interval and row.interval[0] <= constant <= row.interval[1]
        else row
        for row in rows
    ]
