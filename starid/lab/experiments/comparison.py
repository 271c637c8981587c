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
``more, less``     ours is better, as it is larger or smaller
=================  ===============================================================================

An agreement says little if one constant answer agrees with a whole column of a table: `null_model` finds the best one
and marks the checks that it meets as weak. (Constants fitted to published numbers: see `tables`.)
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Final, Literal, TypedDict

from starid.errors import StaridError

Kind = Literal["", "agrees", "fitted", "better", "ours"]
"""Class of a check: agreement with a published number, the same after a constant was fitted to that number (only in
the report, see `tables`), improvement on it, our own bound, or none ("")."""


class ReproduceError(StaridError):
    """A reproduction that cannot be run as requested."""


@dataclass(frozen=True, slots=True)
class Row:
    """A row of the report.

    Attributes
    ----------
    quantity
        What was measured, and under what conditions.
    published, ours, author, printed
        The published value, this project's, and those from the author's version of the algorithm and from the
        printed one, as printed in the report; "—" if there is none.
    target
        What is checked, and the tolerance and its origin; "" without a check.
    passed
        Outcome of the check; None if there is none.
    remark
        Why the values differ, or how to read them.
    kind
        Class of the check.
    met, of
        How many of the published numbers in the row agree, and how many there are.
    interval
        Lowest and highest value that agrees, for one published number.
    weak, weak_met
        How many of the published numbers the best constant answer of the null model meets as well, and how
        many of these agree.
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

    def to_dict(self) -> dict[str, Any]:
        """Convert to plain values."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Outcome:
        """Make an outcome from the values of `to_dict`."""
        rows = tuple(Row(**{**row, "interval": tuple(row["interval"])}) for row in values["rows"])
        return cls(rows, tuple(values["files"]), tuple(values["notes"]))


@dataclass(frozen=True, slots=True)
class Published:
    """What the thesis prints of a quantity.

    Attributes
    ----------
    text
        The number, several numbers separated by spaces, or a phrase; "" for nothing.
    unit, digits
        Unit, and decimals with which the report shows it.
    check
        How it is checked; "" if it is only shown.
    remark
        Remark in the report.
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


class Readings(TypedDict, total=False):
    """A number from the author's version of the algorithm, from the printed one, and ours."""

    author: float
    printed: float
    ours: float


def space_before(unit: str) -> str:
    """Separator between a number and its unit."""
    return "" if unit in ("", "°", "″") else " "


def value_text(value: float | str | None, unit: str, digits: int) -> str:
    """Format a value for the report; "—" for None."""
    if value is None:
        return "—"
    return value if isinstance(value, str) else f"{value:.{digits}f}{space_before(unit)}{unit}"


Tolerance = tuple[float, str]
"""Largest difference from the published number, and its origin."""


def rounding(digits: int, unit: str = "") -> Tolerance:
    """Half a unit of the last printed digit."""
    return 0.501 * 10.0**-digits, f"half of the last digit, {0.5 * 10.0**-digits:g}{space_before(unit)}{unit}"


def sampling(percent: float, trials: float, sigmas: float = 3.0) -> Tolerance:
    """Tolerance for two shares (percent) counted in equally many trials, as a multiple of the standard error.

    The standard error is computed for (k + 1)/(n + 2), so that a published 0 or 100 % has an uncertainty too.
    """
    share = (0.01 * percent * trials + 1.0) / (trials + 2.0)
    error = 100.0 * math.sqrt(2.0 * share * (1.0 - share) / trials)
    return sigmas * error, f"{sigmas:g} standard errors of two shares of {trials:g}, {sigmas * error:.2g} %"


def _mean(_: float, sigma: float, trials: float) -> Tolerance:
    error = 3.0 * sigma * math.sqrt(2.0 / trials)
    return error, f"3 standard errors of two means of {trials:g}, {error:.2g}"


def _deviation(_: float, sigma: float, trials: float) -> Tolerance:
    error = 3.0 * sigma / math.sqrt(trials - 1.0)
    return error, f"3 standard errors of two deviations of {trials:g}, {error:.2g}"


def _coefficient(published: float, trials: float) -> Tolerance:
    """By Fisher's transformation."""
    error = 3.0 * (1.0 - published**2) * math.sqrt(2.0 / (trials - 3.0))
    return error, f"3 standard errors of two coefficients of {trials:g}, {error:.2g}"


_SAMPLED: Final[dict[str, Callable[..., Tolerance]]] = {
    "sampling": sampling,
    "mean": _mean,
    "deviation": _deviation,
    "coefficient": _coefficient,
}


def _tolerance(known: Published, trials: int) -> Tolerance:
    word, _, rest = known.check.partition(" ")
    if word in ("digit", "rounding"):
        return rounding(known.digits if word == "digit" else int(rest), known.unit)
    if word in _SAMPLED:
        numbers = [float(each) for each in rest.split()] or [float(trials)]
        return _SAMPLED[word](known.numbers[0], *numbers)
    return float(word), rest


def row(
    quantity: str,
    *,
    ours: float | str,
    published: float | str | None = None,
    unit: str = "",
    digits: int = 2,
    at_least: float | None = None,
    at_most: float | None = None,
    passed: bool | None = None,
    target: str = "",
    remark: str = "",
) -> Row:
    """Make a row for the report; with a bound it becomes a check of class "ours".

    `starid.lab.experiments.comparison` makes the checks against published numbers.

    Parameters
    ----------
    quantity
        What was measured.
    ours, published
        Values: numbers (printed with `digits` decimals and `unit`) or text; published may be None.
    at_least, at_most
        Bounds on `ours`, set by this project; `ours` must then be a number.
    passed, target
        Result of another kind of check, and its description.
    remark
        Why the two values differ.
    """
    space = space_before(unit)
    if isinstance(ours, str) and not (at_least is None and at_most is None):
        raise ReproduceError(f"reproduce: {quantity}: text cannot have bounds; give a number")
    bounds = []
    if at_least is not None and not isinstance(ours, str):
        bounds.append(f"≥ {at_least:g}{space}{unit}")
        passed = bool(ours >= at_least) and passed is not False
    if at_most is not None and not isinstance(ours, str):
        bounds.append(f"≤ {at_most:g}{space}{unit}")
        passed = bool(ours <= at_most) and passed is not False
    verdict = None if passed is None else bool(passed)
    return Row(
        quantity,
        value_text(published, unit, digits),
        value_text(ours, unit, digits),
        target or ", ".join(bounds),
        verdict,
        remark,
        kind="" if verdict is None else "ours",
        met=int(verdict is True),
        of=int(verdict is not None),
    )


def shown(
    quantity: str,
    *,
    published: float | str | None = None,
    author: float | str | None = None,
    printed: float | str | None = None,
    ours: float | str | None = None,
    unit: str = "",
    digits: int = 2,
    remark: str = "",
) -> Row:
    """Make a row without a check."""
    values = (value_text(value, unit, digits) for value in (published, ours, author, printed))
    one, two, three, four = values
    return Row(quantity, one, two, author=three, printed=four, remark=remark)


def _checked(informing: Row, kind: Kind, target: str, matches: Sequence[bool]) -> Row:
    """Turn a row into a check that passes if all its published numbers match."""
    met, of = sum(map(bool, matches)), len(matches)
    return replace(informing, kind=kind, target=target, passed=met == of, met=met, of=of)


def best_constant(intervals: Iterable[Sequence[float]]) -> float:
    """Value in most of the intervals: the best answer that ignores all that varies within a table."""
    known = list(intervals)
    lows = [low for low, _ in known]
    return max(lows, key=lambda value: sum(low <= value <= high for low, high in known))


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


def agreement(
    quantity: str,
    *,
    published: float,
    tolerance: Tolerance,
    author: float | None = None,
    printed: float | None = None,
    ours: float | str | None = None,
    unit: str = "",
    digits: int = 2,
    remark: str = "",
) -> Row:
    """Make a check for agreement with a published number.

    The value checked is the author's version, or else the printed one, or else ours.

    Raises
    ------
    ReproduceError
        There is no number to check.
    """
    checked = author if author is not None else printed if printed is not None else ours
    if checked is None or isinstance(checked, str):
        raise ReproduceError(
            f"reproduce: {quantity}: there is no number to compare; give author, printed or ours"
        )
    largest, origin = tolerance
    readings = {"published": published, "author": author, "printed": printed, "ours": ours}
    informing = shown(quantity, **readings, unit=unit, digits=digits, remark=remark)
    made = _checked(informing, "agrees", f"± {origin}", [abs(checked - published) <= largest])
    return replace(made, interval=(published - largest, published + largest))


def same(
    quantity: str,
    *,
    published: str,
    author: str | None = None,
    printed: str | None = None,
    ours: str | None = None,
    matches: Sequence[bool],
    target: str,
    remark: str = "",
    null: Sequence[bool] = (),
) -> Row:
    """Make one row for several published numbers; `target` names the rule by which each agrees or not.

    `null` says which of the numbers the null model meets.
    """
    met, of = sum(map(bool, matches)), len(matches)
    remark = f"{met} of {of} agree. {remark}".strip() if of > 1 else remark
    informing = shown(quantity, published=published, author=author, printed=printed, ours=ours, remark=remark)
    made = _checked(informing, "agrees", target, matches)
    weak_met = sum(bool(a and b) for a, b in zip(matches, null, strict=True)) if null else 0
    return replace(made, weak=sum(map(bool, null)), weak_met=weak_met)


def improvement(
    quantity: str,
    *,
    published: float,
    ours: float,
    larger: bool,
    unit: str = "",
    digits: int = 2,
    remark: str = "",
) -> Row:
    """Make a check that ours is better than a published number; the remark states by how much."""
    gain = ours - published if larger else published - ours
    better = f"by {value_text(gain, unit, digits)}"
    if ours > 0.0 and published > 0.0 and not larger and published >= 2.0 * ours:
        better = f"by a factor of {published / ours:.3g}"
    passed = bool(ours >= published if larger else ours <= published)
    remark = f"Better {better}. {remark}".strip() if passed else remark
    informing = shown(quantity, published=published, ours=ours, unit=unit, digits=digits, remark=remark)
    return _checked(informing, "better", f"{'≥' if larger else '≤'} {informing.published}", [passed])


def compared(
    quantity: str,
    known: Published,
    *,
    author: Any = None,
    printed: Any = None,
    ours: Any = None,
    trials: int = 0,
    remark: str = "",
) -> Row:
    """Check what was measured against what the thesis prints, or show both.

    Parameters
    ----------
    quantity, known
        What was measured, and what the thesis prints.
    author, printed, ours
        The number, or as many as are published; the first that is given is checked.
    trials
        Number of trials, for the tolerance ``sampling``.
    remark
        Added to that of the table.
    """
    numbers, unit, digits = known.numbers, known.unit, known.digits
    remark = f"{known.remark} {remark}".strip()
    readings = {"author": author, "printed": printed, "ours": ours}
    word, _, rest = known.check.partition(" ")
    if word in ("more", "less"):
        return improvement(
            quantity,
            published=numbers[0],
            ours=ours,
            larger=word == "more",
            unit=unit,
            digits=digits,
            remark=remark,
        )
    if len(numbers) == 1 and known.check not in ("", "same"):
        values = {name: None if value is None else float(value) for name, value in readings.items()}
        tolerance = _tolerance(known, trials)
        return agreement(
            quantity,
            published=numbers[0],
            tolerance=tolerance,
            **values,
            unit=unit,
            digits=digits,
            remark=remark,
        )
    if len(numbers) <= 1 and known.check != "same":
        published = numbers[0] if numbers else known.text or None
        informing = shown(quantity, published=published, **readings, unit=unit, digits=digits, remark=remark)
        if not known.check:
            return informing
        checked = next(value for value in readings.values() if value is not None)
        agrees = checked > float(rest) if word == ">" else checked < float(rest)
        return _checked(informing, "agrees", f"{known.check}{space_before(unit)}{unit}", [agrees])

    def text(values: Any) -> str | None:
        return None if values is None else ", ".join(f"{value:.{digits}f}" for value in values) + unit

    checked = next(values for values in readings.values() if values is not None)
    largest, origin = (0.0, "the same") if known.check == "same" else rounding(digits, unit)
    return same(
        quantity,
        published=text(numbers) or "",
        author=text(author),
        printed=text(printed),
        ours=text(ours),
        matches=[bool(abs(a - b) <= largest) for a, b in zip(checked, numbers, strict=True)],
        target=origin if known.check == "same" else f"each ± {origin}",
        remark=remark,
    )
