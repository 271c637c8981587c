"""The free choices behind the column "as the author ran it", and the published numbers that each bears on.

`choices.csv` lists them, with the experiment and the beginning of the quantities. A number is *used* with a choice
if it is computed with it. It is *fitted* if the choice was made so that this very number comes out: that it then
agrees proves nothing, and such numbers form a class of their own, outside the totals.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

from starid.lab.experiments.experiment import Kind, Row


@dataclass(frozen=True, slots=True)
class Choice:
    """A line of `choices.csv`."""

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


def _read() -> tuple[Choice, ...]:
    with Path(__file__).with_name("choices.csv").open(encoding="utf-8", newline="") as stream:
        return tuple(Choice(**line) for line in csv.DictReader(stream))  # type: ignore[arg-type]


CHOICES: Final = _read()


def class_of(experiment: str, row: Row) -> Kind:
    """Return the class of a check: "fitted" instead of "agrees" if a choice was fitted to its number."""
    fitted = any(each.role == "fitted" and each.bears_on(experiment, row) for each in CHOICES)
    return "fitted" if fitted else row.kind


def numbers_by_choice(rows: Iterable[tuple[str, Row]]) -> dict[str, dict[str, int]]:
    """For each choice, how many published numbers depend on it, how many agree, and how many it was fitted to.

    Parameters
    ----------
    rows
        Rows with the names of their experiments.
    """
    known = list(rows)
    found: dict[str, dict[str, int]] = {}
    for name in dict.fromkeys(each.choice for each in CHOICES):
        lines = [each for each in CHOICES if each.choice == name]
        bearing = [
            (row, any(each.role == "fitted" and each.bears_on(experiment, row) for each in lines))
            for experiment, row in known
            if any(each.bears_on(experiment, row) for each in lines)
        ]
        found[name] = {
            "numbers": sum(row.of for row, _ in bearing),
            "agree": sum(row.met for row, _ in bearing),
            "fitted": sum(row.of for row, fitted in bearing if fitted),
        }
    return found
