"""Published results of the filter and of the recursive algorithm, from the CSV files beside this module."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

Key = tuple[float, int, float]
"""Overlap ratio p, noise factor μ (= number of false stars f), threshold τ (0: LSI with the filter)."""


def _lines(name: str) -> list[dict[str, str]]:
    with Path(__file__).with_name(name).open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


def _confusion() -> dict[tuple[str, int], list[tuple[int, ...]]]:
    tables: dict[tuple[str, int], list[tuple[int, ...]]] = {}
    for kind, false_stars, _, *counts in (line.values() for line in _lines("published_confusion.csv")):
        tables.setdefault((kind, int(false_stars)), []).append(tuple(map(int, counts)))
    return tables


def _recursion() -> dict[Key, dict[str, float]]:
    tables: dict[Key, dict[str, float]] = {}
    for line in _lines("published_recursion.csv"):
        overlap, factor, tau = (line.pop(name) for name in ("overlap", "factor", "tau"))
        numbers = {name: float(text) for name, text in line.items() if text}
        tables[float(overlap), int(factor), float(tau)] = numbers
    return tables


TABLES: Final = _confusion()
"""Kind of noise and number of false stars → true and false positives, false and true negatives for μ = 0 … 5.

Tables A.1 to A.18. In table A.2 (position noise, no false stars) the copy of the thesis has lost the
positives for μ = 1 … 5; here they are 6 620 minus the negatives.
"""

RECURSION: Final = _recursion()
"""Tables of the recursive algorithm, with the names of `rsi_parts.statistics`.

H.1 and H.2: mean and standard deviation of ε_f, of ε_θ (degrees), and of ε_ψ. 6.7, for τ > 0: share of frames
that trigger the update, and that have ε_ψ > τ, percent. 6.8, for τ > 0: mean and standard deviation of the
side of the search region, degrees, and its size, kB. 6.9: mean and standard deviation of the time of the
search and of the LASSO, milliseconds.
"""


def printed_of(values: Mapping[str, Any]) -> dict[str, float]:
    """Published values for a part of the recursive experiments; empty if the tables have no such row."""
    return RECURSION.get((values["overlap"], values["factor"], values["tau"]), {})
