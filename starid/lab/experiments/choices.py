"""The free choices behind the column "as the author ran it", and the published numbers that depend on each.

`choices.csv` lists choices that the text of the thesis does not make, with the experiment and the beginning of the
quantities that are computed with them. Constants that were fitted to published numbers are named by the rows
themselves (`Row.fitted`).
"""

from __future__ import annotations

import csv
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from starid.lab.experiments.experiment import Row

CHOICES_FILE: Final = Path(__file__).with_name("choices.csv")


def choices() -> list[tuple[str, str, str]]:
    """Return the lines of `choices.csv`: choice, experiment, beginning of the quantities."""
    with CHOICES_FILE.open(encoding="utf-8", newline="") as stream:
        return [(line["choice"], line["experiment"], line["quantity"]) for line in csv.DictReader(stream)]


def numbers_by_choice(rows: Iterable[tuple[str, Row]]) -> dict[str, dict[str, int]]:
    """For each choice, how many published numbers depend on it, how many agree, and how many it was fitted to.

    Parameters
    ----------
    rows
        Rows with the names of their experiments.
    """
    lines = choices()
    found: dict[str, dict[str, int]] = {}
    for experiment, row in rows:
        if row.author == "—" or row.kind not in ("agrees", "fitted"):
            continue
        used = [
            name for name, where, start in lines if where == experiment and row.quantity.startswith(start)
        ]
        for name in dict.fromkeys([*used, *([row.fitted] if row.fitted else [])]):
            entry = found.setdefault(name, {"numbers": 0, "agree": 0, "fitted": 0})
            entry["numbers"] += row.of
            entry["agree"] += row.met
            entry["fitted"] += row.of if name == row.fitted else 0
    return found
