"""Checks against published numbers: agreement within a stated tolerance, or improvement on the number.

An agreement says little if one constant answer agrees with a whole column of a table: `null_model` finds the best one
and marks the checks that it meets as weak. (Constants fitted to published numbers: see `choices`.)

`published.csv` holds the numbers that the thesis prints: experiment, quantity, the number or numbers, unit, digits,
tolerance, remark. `compared` makes the check of a quantity from what an experiment measured. The tolerance is
``digit`` (half of the last of the digits shown), ``rounding N`` (of N digits), ``sampling`` (see `sampling`), ``the
same``, or a number and its origin.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, TypedDict

from starid.lab.experiments.experiment import Kind, ReproduceError, Row, space_before, value_text


class Readings(TypedDict, total=False):
    """A number from the author's version of the algorithm, from the printed one, and ours."""

    author: float
    printed: float
    ours: float


Tolerance = tuple[float, str]
"""Largest difference from the published number, and its origin."""


def rounding(digits: int, unit: str = "") -> Tolerance:
    """Half a unit of the last printed digit."""
    return 0.501 * 10.0**-digits, f"half of the last digit, {0.5 * 10.0**-digits:g}{space_before(unit)}{unit}"


def sampling(percent: float, trials: int, sigmas: float = 3.0) -> Tolerance:
    """Tolerance for two shares (percent) counted in equally many trials, as a multiple of the standard error.

    The standard error is computed for (k + 1)/(n + 2), so that a published 0 or 100 % has an uncertainty too.
    """
    share = (0.01 * percent * trials + 1.0) / (trials + 2.0)
    error = 100.0 * math.sqrt(2.0 * share * (1.0 - share) / trials)
    return sigmas * error, f"{sigmas:g} standard errors of two shares of {trials}, {sigmas * error:.2g} %"


def sampled_mean(sigma: float, trials: int, sigmas: float = 3.0) -> Tolerance:
    """Tolerance for two means over equally many trials, as a multiple of the standard error."""
    error = sigma * math.sqrt(2.0 / trials)
    return sigmas * error, f"{sigmas:g} standard errors of two means of {trials}, {sigmas * error:.2g}"


def sampled_deviation(sigma: float, trials: int, sigmas: float = 3.0) -> Tolerance:
    """Tolerance for two standard deviations over equally many trials, as a multiple of the standard error."""
    error = sigma / math.sqrt(trials - 1)
    return sigmas * error, f"{sigmas:g} standard errors of two deviations of {trials}, {sigmas * error:.2g}"


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
    return Row(
        quantity,
        value_text(published, unit, digits),
        value_text(ours, unit, digits),
        remark=remark,
        author=value_text(author, unit, digits),
        printed=value_text(printed, unit, digits),
    )


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


@lru_cache(maxsize=1)
def _published() -> dict[tuple[str, str], dict[str, str]]:
    with Path(__file__).with_name("published.csv").open(encoding="utf-8", newline="") as stream:
        return {(line["experiment"], line["quantity"]): line for line in csv.DictReader(stream)}


def published(experiment: str, quantity: str) -> list[float]:
    """Return the published numbers of a quantity; none if the thesis has none."""
    line = _published().get((experiment, quantity))
    return [] if line is None else [float(word) for word in line["published"].split()]


def compared(
    experiment: str,
    quantity: str,
    *,
    author: Any = None,
    printed: Any = None,
    ours: Any = None,
    trials: int = 0,
    remark: str = "",
) -> Row:
    """Check a quantity of `published.csv`; several numbers must agree one by one.

    Parameters
    ----------
    experiment, quantity
        Key in `published.csv`.
    author, printed, ours
        The number, or as many as are published; the first that is given is checked.
    trials
        Number of trials, for the tolerance ``sampling``.
    remark
        Added to that of the table.
    """
    line, numbers = _published()[experiment, quantity], published(experiment, quantity)
    unit, digits, rule = line["unit"], int(line["digits"]), line["tolerance"]
    remark = f"{line['remark']} {remark}".strip()
    if len(numbers) == 1 and rule != "the same":
        word, _, rest = rule.partition(" ")
        if word == "sampling":
            tolerance = sampling(numbers[0], trials)
        elif word in ("digit", "rounding"):
            tolerance = rounding(digits if word == "digit" else int(rest), unit)
        else:
            tolerance = float(word), rest
        readings = {
            name: None if value is None else float(value)
            for name, value in (("author", author), ("printed", printed), ("ours", ours))
        }
        return agreement(
            quantity,
            published=numbers[0],
            tolerance=tolerance,
            **readings,
            unit=unit,
            digits=digits,
            remark=remark,
        )

    def text(values: Any) -> str | None:
        return None if values is None else ", ".join(f"{value:.{digits}f}" for value in values) + unit

    checked = next(values for values in (author, printed, ours) if values is not None)
    largest, origin = (0.0, rule) if rule == "the same" else rounding(digits, unit)
    return same(
        quantity,
        published=text(numbers) or "",
        author=text(author),
        printed=text(printed),
        ours=text(ours),
        matches=[bool(abs(a - b) <= largest) for a, b in zip(checked, numbers, strict=True)],
        target=origin if rule == "the same" else f"each ± {origin}",
        remark=remark,
    )
