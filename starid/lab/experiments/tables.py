"""The tables beside this module: published numbers, known misses, and the free choices of the author's program.

`published.csv` holds a line for each quantity that the thesis prints in its text, or in a table of a few lines:
the numbers, their unit and digits, how they are checked (see `comparison`), and where they stand in the thesis. The
large tables have files of their own (`published_*.csv`), whose columns `columns.csv` describes.

A failed check listed in `known_misses.csv` is a known miss: the report shows it with its reason, and the exit status
stays 0. A failed check that is not listed is a regression.

The column "as the author ran it" rests on the choices of `choices.csv`, which the text of the thesis does not make. A
number is *used* with a choice if it is computed with it. It is *fitted* if the choice was made so that this very
number comes out: that it then agrees proves nothing, and such numbers form a class of their own.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any, Final, Literal

from starid.lab.experiments.comparison import Kind, Published, Row


def read_lines(name: str) -> list[dict[str, str]]:
    """Read a CSV file of this folder."""
    with Path(__file__).with_name(name).open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


PUBLISHED: Final = {
    (line["experiment"], line["quantity"]): Published(
        line["published"], line["unit"], int(line["digits"]), line["check"], line["remark"]
    )
    for line in read_lines("published.csv")
}
"""Experiment and quantity → what the thesis prints."""


def published(experiment: str, quantity: str) -> list[float]:
    """Return the published numbers of a quantity; none if the thesis has none."""
    known = PUBLISHED.get((experiment, quantity))
    return [] if known is None else known.numbers


def _confusion() -> dict[tuple[str, int], list[tuple[int, ...]]]:
    tables: dict[tuple[str, int], list[tuple[int, ...]]] = {}
    for kind, false_stars, _, *counts in (line.values() for line in read_lines("published_confusion.csv")):
        tables.setdefault((kind, int(false_stars)), []).append(tuple(map(int, counts)))
    return tables


CONFUSION: Final = _confusion()
"""Kind of noise and number of false stars → true and false positives, false and true negatives for μ = 0 … 5.

Tables A.1 to A.18. In table A.2 (position noise, no false stars) the copy of the thesis has lost the
positives for μ = 1 … 5; here they are 6 620 minus the negatives.
"""


def _numbers(line: Mapping[str, str], keys: int) -> dict[str, float]:
    return {name: float(text) for name, text in list(line.items())[keys:] if text}


CASE_STUDY: Final = {
    (int(line["false_stars"]), line["noise"]): _numbers(line, 2)
    for line in read_lines("published_case_study.csv")
}
"""Tables 6.3 and 6.4: number of false stars and kind of noise (factor 1) → indicators, percent, and mean and
standard deviation of the errors of rotation and translation, degrees."""

RECURSION: Final = {
    (float(line["overlap"]), int(line["factor"]), float(line["tau"])): _numbers(line, 3)
    for line in read_lines("published_recursion.csv")
}
"""Tables of the recursive algorithm: overlap ratio p, noise factor μ (= number of false stars f) and threshold τ
(0: LSI with the filter) → values, with the names of `rsi_trials.statistics`.

H.1 and H.2: mean and standard deviation of ε_f, of ε_θ (degrees), and of ε_ψ. 6.7, for τ > 0: share of frames
that trigger the update, and that have ε_ψ > τ, percent. 6.8, for τ > 0: mean and standard deviation of the
side of the search region, degrees, and its size, kB. 6.9: mean and standard deviation of the time of the
search and of the LASSO, milliseconds.
"""


COLUMNS: Final = {
    table: {line["column"]: line for line in lines}
    for table, lines in groupby(read_lines("columns.csv"), key=lambda line: line["table"])
}
"""Table and column → words, unit, digits and check (with the names of columns in braces) of its numbers."""


@dataclass(frozen=True, slots=True)
class KnownMiss:
    """Why a check fails, and how many of the numbers in its row agree nevertheless."""

    reason: str
    met: int = 0


KNOWN_MISSES: Final = {
    (line["experiment"], line["quantity"]): KnownMiss(line["reason"], int(line["agree"]))
    for line in read_lines("known_misses.csv")
}
"""Experiment and quantity → why the check fails."""


def known_miss(experiment: str, row: Row) -> KnownMiss | None:
    """Return the entry for a failed row; None if there is none or fewer numbers agree than it states."""
    if row.passed is not False:
        return None
    entry = KNOWN_MISSES.get((experiment, row.quantity))
    return entry if entry is not None and row.met >= entry.met else None


@dataclass(frozen=True, slots=True)
class Choice:
    """A line of `choices.csv`: a choice, and the quantities of an experiment (their beginning) that rest on it."""

    choice: str
    role: Literal["fitted", "used"]
    experiment: str
    quantity: str

    def bears_on(self, experiment: str, row: Row) -> bool:
        """Whether a check of a published number depends on this choice."""
        return (
            row.kind == "agrees"
            and row.author != "—"
            and self.experiment == experiment
            and row.quantity.startswith(self.quantity)
        )


CHOICES: Final[tuple[Choice, ...]] = tuple(
    Choice(**line)  # type: ignore[arg-type]
    for line in read_lines("choices.csv")
)


def class_of(experiment: str, row: Row) -> Kind:
    """Return the class of a check: "fitted" instead of "agrees" if a choice was fitted to its number."""
    fitted = any(each.role == "fitted" and each.bears_on(experiment, row) for each in CHOICES)
    return "fitted" if fitted else row.kind


def numbers_by_choice(rows: Iterable[tuple[str, Row]]) -> dict[str, dict[str, int]]:
    """For each choice, how many published numbers depend on it, how many agree, and how many it was fitted to.

    `rows` come with the names of their experiments.
    """
    by_choice: dict[str, dict[str, int]] = {
        each.choice: {"numbers": 0, "agree": 0, "fitted": 0} for each in CHOICES
    }
    for experiment, row in rows:
        bearing: dict[str, set[Any]] = {}
        for each in CHOICES:
            if each.bears_on(experiment, row):
                bearing.setdefault(each.choice, set()).add(each.role)
        for choice, roles in bearing.items():
            by_choice[choice]["numbers"] += row.of
            by_choice[choice]["agree"] += row.met
            by_choice[choice]["fitted"] += row.of if "fitted" in roles else 0
    return by_choice
