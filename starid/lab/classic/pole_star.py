"""PS, the pole star algorithm.

E. Silani, M. Lovera, "Star identification algorithms: novel approach & comparison study", IEEE Transactions
on Aerospace and Electronic Systems 42(4), 1275–1288, 2006.

The radial pattern of a pole star (`starid.lab.classic.rings`) selects its candidates: guide stars that share
enough rings with it. From the candidates of several pole stars, pairs, triangles and polygons with sides of
the observed lengths are built until one set is left.

own choice: every observed star is a pole, and its candidates are the eight best guide stars with at least
eight votes of the rings. The polygon is the largest set that agrees in all its sides, which the shared last step
finds. It must have five corners: among so many candidates, quadrilaterals occur by chance.
"""

from __future__ import annotations

from typing import ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from starid.arithmetic.arrays import Array, Indices, Indices32
from starid.kernels.jit import compiled_ieee
from starid.lab.classic.neighbours import neighbours_of
from starid.lab.classic.rings import MAX_NEIGHBOURS, RADIUS_SHARE, radial_votes, ring_table
from starid.lab.classic.solver import ClassicIdentifier, Database, Observed

MIN_VOTES: Final = 8
CANDIDATES: Final = 8


@compiled_ieee
def _candidates(
    table: tuple[Indices32, NDArray[np.uint16]], stars: int, directions: Array, radius: float
) -> Indices:
    """Candidates (m, 2): row of an observed star, and a guide star with enough rings in common."""
    polar, rows = np.empty((MAX_NEIGHBOURS, 2)), np.empty(MAX_NEIGHBOURS, dtype=np.int64)
    votes = np.empty(stars, dtype=np.int32)
    candidates = np.empty((directions.shape[0] * CANDIDATES, 2), dtype=np.int64)
    filled = 0
    for pole in range(directions.shape[0]):
        radial_votes(table, polar, neighbours_of(directions, pole, radius, polar, rows), radius, votes)
        for _ in range(CANDIDATES):
            best = np.argmax(votes)
            if votes[best] < MIN_VOTES:
                break
            votes[best] = 0
            candidates[filled, 0], candidates[filled, 1] = pole, best
            filled += 1
    return candidates[:filled]


class PoleStarIdentifier(ClassicIdentifier):
    """The pole star algorithm behind the common interface of all identifiers."""

    stars_per_field: ClassVar[float] = 30.0
    min_group: ClassVar[int] = 5

    def _build(self) -> Database:
        self._radius = RADIUS_SHARE * self.width_rad
        self.table = ring_table(self.guide.vectors, self._radius)
        return self.table

    def _match(self, observed: Observed) -> Indices:
        return _candidates(self.table, len(self.guide), observed.directions, self._radius)
