"""MG, the match group algorithm.

R. W. H. van Bezooijen, "Automated star pattern recognition", Ph.D. thesis, Stanford University, 1989.

Each pair of a pole star and a neighbour is looked up in the catalogue by distance and magnitudes. Catalogue
pairs that share a star form a match group: that star is the candidate for the pole, the others for the
neighbours. The largest group whose members also agree in their mutual distances identifies the field.

own choice: magnitudes are compared as differences within the pair, which need no calibration, with a gate of
0.6 mag.
own choice: each of the ten brightest stars is tried as a pole, and the mutual distances are tested
for its five largest groups; where several neighbours fit one star, the nearest in distance is taken.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from starid.arithmetic.arrays import Array, Indices, Indices32
from starid.kernels.jit import compiled_ieee, inner
from starid.lab.classic.agreement import group_around
from starid.lab.classic.pairs import PairTable, chord_between, pair_range, pair_table
from starid.lab.classic.solver import ClassicIdentifier, Database, Observed

MAGNITUDE_GATE: Final = 0.6
"""Largest error of a difference of two magnitudes."""

POLES: Final = 10
"""Number of observed stars, brightest first, that are tried as poles."""

GROUPS: Final = 5
"""Number of groups tested per pole, largest first."""


@inner
def match_groups(
    table: PairTable,
    guide: tuple[Array, Array],
    observed: tuple[Array, Array],
    pole: int,
    tolerance: float,
    partner: Indices32,
    size: Indices,
) -> None:
    """Fill in a pole's match groups: partner (N, n) of each candidate for each neighbour or −1; size (N,)."""
    vectors, magnitudes = guide
    directions, instrumental = observed
    partner[:] = -1
    size[:] = 0
    for j in range(directions.shape[0]):
        if j == pole:
            continue
        distance = chord_between(directions, pole, directions, j)
        difference = instrumental[j] - instrumental[pole]
        start, end = pair_range(table, distance - tolerance, distance + tolerance)
        for pair in range(start, end):
            for side in range(2):
                a = int(table.first[pair]) if side == 0 else int(table.second[pair])
                b = int(table.second[pair]) if side == 0 else int(table.first[pair])
                if abs(magnitudes[b] - magnitudes[a] - difference) > MAGNITUDE_GATE:
                    continue
                earlier = int(partner[a, j])
                if earlier < 0:
                    size[a] += 1
                    partner[a, j] = b
                elif abs(table.chord[pair] - distance) < abs(
                    chord_between(vectors, a, vectors, earlier) - distance
                ):
                    partner[a, j] = b


@inner
def group_pairs(partner: Indices32, pole: int, candidate: int) -> Indices:
    """Matches (m, 2) of a match group, the pole first."""
    n = partner.shape[1]
    pairs = np.empty((n, 2), dtype=np.int64)
    pairs[0, 0], pairs[0, 1] = pole, candidate
    count = 1
    for j in range(n):
        if partner[candidate, j] >= 0:
            pairs[count, 0], pairs[count, 1] = j, partner[candidate, j]
            count += 1
    return pairs[:count]


@compiled_ieee
def _largest_match_group(
    table: PairTable, guide: tuple[Array, Array], observed: tuple[Array, Array], tolerance: float
) -> Indices:
    """Find the matches (m, 2) of the largest group that agrees in all distances."""
    vectors, directions = guide[0], observed[0]
    n = directions.shape[0]
    partner, size = (
        np.empty((vectors.shape[0], n), dtype=np.int32),
        np.empty(vectors.shape[0], dtype=np.int64),
    )
    members = np.empty(n + 1, dtype=np.int64)
    best = np.empty((0, 2), dtype=np.int64)
    for pole in range(min(n, POLES)):
        match_groups(table, guide, observed, pole, tolerance, partner, size)
        for _ in range(GROUPS):
            candidate = int(np.argmax(size))
            if size[candidate] < best.shape[0]:
                break
            size[candidate] = 0
            pairs = group_pairs(partner, pole, candidate)
            count = group_around(directions, vectors, pairs, 0, tolerance, members)
            if count > best.shape[0]:
                best = pairs[members[:count]]
    return best


class MatchGroupIdentifier(ClassicIdentifier):
    """The match group algorithm behind the common interface of all identifiers."""

    def _build(self) -> Database:
        self.pairs = pair_table(self.guide.vectors, self.longest_chord)
        return (*self.pairs, self.guide.magnitude)

    def _match(self, observed: Observed) -> Indices:
        guide = (self.guide.vectors, self.guide.magnitude)
        seen = (observed.directions, observed.magnitude)
        return _largest_match_group(self.pairs, guide, seen, observed.tolerance)
