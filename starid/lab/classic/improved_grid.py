"""IG, the improved grid algorithm.

M. Aghaei, H. A. Moghaddam, "Grid star identification improvement using optimization approaches", IEEE
Transactions on Aerospace and Electronic Systems 52(5), 2080–2090, 2016.

The thesis's IG, its reference [94], may be another: J. Li, X. Wei, G. Wang, S. Zhou, "Improved Grid Algorithm
Based on Star Pair Pattern and Two-dimensional Angular Distances for Full-Sky Star Identification", IEEE
Access 8, 1010–1020, 2020, of which only the abstract was available. That paper compares itself with the grid
and the pyramid algorithms, and the thesis quotes their rates from the same place.

The grid algorithm is changed in three ways. Neighbours are clustered by brightness, and the grid is aligned
with several bright ones in turn, since a bright star is seldom missing or out of order. The two best matches
of every lookup are kept. The threshold on the votes is the Bayesian decision between truth and chance.

own choice: the bright cluster is the brighter half of a pattern; guide patterns are aligned with its nearest
star beyond the buffer, observed ones with its three nearest in turn.
own choice: votes are binomial. An observed cell is in the true pattern with probability 0.5 (noise, the rim
of the field, missing and false stars), and in any other with the mean share of cells that a pattern fills. A
match is accepted when its odds outweigh the prior of one guide star among all.
"""

from __future__ import annotations

import math
from typing import ClassVar, Final

import numpy as np

from starid.arithmetic.arrays import Array, Indices
from starid.kernels.jit import compiled_ieee
from starid.lab.classic.grid import (
    BUFFER_SHARE,
    GRID,
    MAX_NEIGHBOURS,
    RADIUS_SHARE,
    Table,
    count_votes,
    lookup_table,
)
from starid.lab.classic.neighbours import bright_neighbour, neighbours_of
from starid.lab.classic.solver import ClassicIdentifier, Database, Observed

ALIGNMENTS: Final = 3
"""Number of neighbours with which an observed pattern is aligned in turn."""

MATCHES_PER_LOOKUP: Final = 2
"""Number of matches kept of each lookup."""

HIT_RATE: Final = 0.5
"""Probability that an observed cell is in the true pattern."""


@compiled_ieee
def _lookup(
    table: Table, stars: int, seen: tuple[Array, Array], radius: float, buffer: float, fill: float
) -> Indices:
    """Find, for each pivot and alignment, the two best matches (m, 2) above the Bayesian threshold."""
    directions, magnitude = seen
    polar, rows = np.empty((MAX_NEIGHBOURS, 2)), np.empty(MAX_NEIGHBOURS, dtype=np.int64)
    occupied = np.empty(MAX_NEIGHBOURS, dtype=np.int64)
    matches = np.empty((directions.shape[0] * ALIGNMENTS * MATCHES_PER_LOOKUP, 2), dtype=np.int64)
    filled = 0
    hit, miss = math.log(HIT_RATE / fill), math.log((1.0 - HIT_RATE) / (1.0 - fill))
    for pivot in range(directions.shape[0]):
        count = neighbours_of(directions, pivot, radius, polar, rows)
        for rank in range(ALIGNMENTS):
            aligned = bright_neighbour(polar, rows, count, magnitude, buffer, rank)
            if aligned < 0:
                break
            votes = np.zeros(stars, dtype=np.int32)
            cells = count_votes(table, polar, count, aligned, radius, occupied, votes)
            for _ in range(MATCHES_PER_LOOKUP):
                best = np.argmax(votes)
                odds = votes[best] * hit + (cells - votes[best]) * miss
                if odds > math.log(stars):
                    matches[filled, 0], matches[filled, 1] = pivot, best
                    filled += 1
                votes[best] = 0
    return matches[:filled]


class ImprovedGridIdentifier(ClassicIdentifier):
    """The improved grid algorithm behind the common interface of all identifiers."""

    stars_per_field: ClassVar[float] = 30.0

    def _build(self) -> Database:
        self._radius = RADIUS_SHARE * self.width_rad
        self._buffer = BUFFER_SHARE * self._radius
        guide = self.guide
        self.table = lookup_table(guide.vectors, guide.magnitude, self._radius, self._buffer)
        # apart from the cell of the alignment star, cells are filled evenly over the circle
        inside = 0.25 * math.pi * GRID**2
        self._fill = min(self.table[1].size / (len(guide) * inside), HIT_RATE / 2.0)
        return self.table

    def _match(self, observed: Observed) -> Indices:
        seen = (observed.directions, observed.magnitude)
        return _lookup(self.table, len(self.guide), seen, self._radius, self._buffer, self._fill)
