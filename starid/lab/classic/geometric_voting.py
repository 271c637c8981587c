"""GV, geometric voting.

M. Kolomenkin, S. Pollak, I. Shimshoni, M. Lindenbaum, "Geometric voting algorithm for star trackers", IEEE
Transactions on Aerospace and Electronic Systems 44(2), 441–456, 2008.

Every pair of observed stars votes: each of its two stars gets a vote for both stars of every catalogue pair
of the same separation, within a tolerance. Each observed star is matched to the catalogue star with the most
votes. In a second vote two matches vote for each other if their catalogue stars are as far apart as the
observed ones, and the matches whose votes are near the highest are kept.

own choice: "near the highest" is at least half of the highest, which a star reaches if it agrees with more
than half of the stars that the best one agrees with.
own choice: a tolerance of 1.5 standard deviations. A
larger one adds many chance votes, most of them in crowded parts of the sky, and hardly any true ones: on
random fields of 42° and 12°, 1.5 identified more than 0.75 and 3 at every noise from 0.5 px upwards.
"""

from __future__ import annotations

from typing import ClassVar, Final

import numpy as np

from starid.arithmetic.arrays import Array, Indices, Indices32
from starid.kernels.jit import compiled_ieee
from starid.lab.classic.pairs import PairTable, chord_between, pair_range, pair_table
from starid.lab.classic.solver import ClassicIdentifier, Database, Observed

KEPT_SHARE: Final = 0.5
"""Votes that a match needs in the second vote, as a share of the highest."""


@compiled_ieee
def votes_of(table: PairTable, stars: int, directions: Array, tolerance: float) -> Indices32:
    """Votes (n, stars) that the pairs of observed stars cast for catalogue stars."""
    n = directions.shape[0]
    votes = np.zeros((n, stars), dtype=np.int32)
    for i in range(n):
        for j in range(i + 1, n):
            distance = chord_between(directions, i, directions, j)
            start, end = pair_range(table, distance - tolerance, distance + tolerance)
            for pair in range(start, end):
                a, b = table.first[pair], table.second[pair]
                votes[i, a] += 1
                votes[i, b] += 1
                votes[j, a] += 1
                votes[j, b] += 1
    return votes


@compiled_ieee
def _second_vote(vectors: Array, directions: Array, matched: Indices, tolerance: float) -> Indices:
    """Count, for each match, the other matches that agree with it in distance."""
    n = directions.shape[0]
    votes = np.zeros(n, dtype=np.int64)
    for i in range(n):
        for j in range(i + 1, n):
            if matched[i] < 0 or matched[j] < 0 or matched[i] == matched[j]:
                continue
            distance = chord_between(vectors, matched[i], vectors, matched[j])
            if abs(distance - chord_between(directions, i, directions, j)) <= tolerance:
                votes[i] += 1
                votes[j] += 1
    return votes


class GeometricVotingIdentifier(ClassicIdentifier):
    """Geometric voting behind the common interface of all identifiers."""

    tolerance_px: ClassVar[float] = 1.5
    sigmas: ClassVar[float] = 1.5

    def _build(self) -> Database:
        self.pairs = pair_table(self.guide.vectors, self.longest_chord)
        return tuple(self.pairs)

    def _match(self, observed: Observed) -> Indices:
        votes = votes_of(self.pairs, len(self.guide), observed.directions, observed.tolerance)
        matched = np.where(votes.max(axis=1) > 0, votes.argmax(axis=1), -1)
        support = _second_vote(self.guide.vectors, observed.directions, matched, observed.tolerance)
        kept = np.flatnonzero((support > 0) & (support >= KEPT_SHARE * support.max()))
        return np.column_stack([kept, matched[kept]])
