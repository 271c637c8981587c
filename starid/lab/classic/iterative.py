"""IA, the iterative algorithm.

J. Li, X. Wei, G. Zhang, "Iterative algorithm for autonomous star identification", IEEE Transactions on
Aerospace and Electronic Systems 51(1), 536–547, 2015.

The first round is geometric voting: every observed pair votes for the catalogue pairs of its length.
Catalogue stars with enough votes remain candidates of an observed star. In the next round only pairs of
candidates vote, each end for the candidates of its own star, with a higher threshold, and so on until each
star has one candidate or none. At least five stars must be identified with distances that agree.

own choice: a candidate needs 0.4 of the highest votes of its star in the first round, and 0.15 more in each
of four further rounds.
own choice: a tolerance of two standard deviations, for the reason given in
`starid.lab.classic.geometric_voting`; the iteration copes with more chance votes.
"""

from __future__ import annotations

from typing import ClassVar, Final

import numpy as np

from starid.arithmetic.arrays import Array, Indices, Indices32, Mask
from starid.kernels.jit import compiled_ieee
from starid.lab.classic.geometric_voting import votes_of
from starid.lab.classic.pairs import PairTable, chord_between, pair_range, pair_table
from starid.lab.classic.solver import ClassicIdentifier, Database, Observed

FIRST_SHARE: Final = 0.4
RISE: Final = 0.15
ROUNDS: Final = 4


@compiled_ieee
def _vote_of_candidates(table: PairTable, candidate: Mask, directions: Array, tolerance: float) -> Indices32:
    """Votes (n, N) of catalogue pairs whose stars are candidates of an observed pair, in either order."""
    n = directions.shape[0]
    votes = np.zeros(candidate.shape, dtype=np.int32)
    for i in range(n):
        for j in range(i + 1, n):
            distance = chord_between(directions, i, directions, j)
            start, end = pair_range(table, distance - tolerance, distance + tolerance)
            for pair in range(start, end):
                a, b = table.first[pair], table.second[pair]
                if candidate[i, a] and candidate[j, b]:
                    votes[i, a] += 1
                    votes[j, b] += 1
                if candidate[i, b] and candidate[j, a]:
                    votes[i, b] += 1
                    votes[j, a] += 1
    return votes


class IterativeIdentifier(ClassicIdentifier):
    """The iterative algorithm behind the common interface of all identifiers."""

    tolerance_px: ClassVar[float] = 2.0
    sigmas: ClassVar[float] = 2.0
    min_group: ClassVar[int] = 5
    min_stars: ClassVar[int] = 5

    def _build(self) -> Database:
        self.pairs = pair_table(self.guide.vectors, self.longest_chord)
        return tuple(self.pairs)

    def _match(self, observed: Observed) -> Indices:
        directions, tolerance = observed.directions, observed.tolerance
        votes = votes_of(self.pairs, len(self.guide), directions, tolerance)
        share = FIRST_SHARE
        candidate = _above(votes, share)
        for _ in range(ROUNDS):
            share += RISE
            votes = _vote_of_candidates(self.pairs, candidate, directions, tolerance)
            candidate = _above(votes, share)
            if candidate.sum(axis=1).max(initial=0) <= 1:
                break
        return np.argwhere(candidate)


def _above(votes: Indices32, share: float) -> Mask:
    """Candidates (n, N) with at least a given share of the highest votes for their star."""
    return np.asarray((votes > 0) & (votes >= share * votes.max(axis=1, keepdims=True)))
