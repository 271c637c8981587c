"""Published numbers that the reproduction is known to miss, each with the reason: `known_misses.csv`.

A failed check that is listed there is a known miss: the report shows it, and the exit status stays 0. A failed
check that is not listed is a regression. A row of several numbers is listed with how many agree.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from starid.lab.experiments.experiment import Row


@dataclass(frozen=True, slots=True)
class KnownMiss:
    """Why a check fails.

    Attributes
    ----------
    reason
        One sentence for the report.
    met
        How many of the published numbers in the row agree nevertheless.
    """

    reason: str
    met: int = 0


def _read() -> dict[str, dict[str, KnownMiss]]:
    known: dict[str, dict[str, KnownMiss]] = {}
    with Path(__file__).with_name("known_misses.csv").open(encoding="utf-8", newline="") as stream:
        for line in csv.DictReader(stream):
            miss = KnownMiss(line["reason"], int(line["agree"]))
            known.setdefault(line["experiment"], {})[line["quantity"]] = miss
    return known


KNOWN: Final = _read()
"""Experiment → quantity → why the check fails."""


def known_miss(
    experiment: str, row: Row, known: Mapping[str, Mapping[str, KnownMiss]] | None = None
) -> KnownMiss | None:
    """Return the entry for a failed row; None if there is none or fewer numbers agree than it states."""
    if row.passed is not False:
        return None
    entry = (KNOWN if known is None else known).get(experiment, {}).get(row.quantity)
    return entry if entry is not None and row.met >= entry.met else None
