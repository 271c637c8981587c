"""Published numbers that the reproduction is known not to reach, each with its reason.

A check that is missed and stands here is a known miss: the report shows it, the exit status stays 0. A check that is
missed and does not stand here is a regression. A row that stands for several numbers is known with the number of them
that agree, and fewer are a regression.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from starid.thesis.experiments.experiment import Row


@dataclass(frozen=True, slots=True)
class KnownMiss:
    """Why a check is missed.

    Attributes
    ----------
    reason
        One sentence for the report.
    met
        How many of the row's published numbers agree all the same.
    """

    reason: str
    met: int = 0


KNOWN: Final[dict[str, dict[str, KnownMiss]]] = {}
"""Experiment → quantity → why it is missed."""


def known_miss(
    experiment: str, row: Row, known: Mapping[str, Mapping[str, KnownMiss]] | None = None
) -> KnownMiss | None:
    """The entry of a missed row, None if it is met, has none, or reaches less than the entry says."""
    if row.passed is not False:
        return None
    entry = (KNOWN if known is None else known).get(experiment, {}).get(row.quantity)
    return entry if entry is not None and row.met >= entry.met else None
