"""SGS, the simplest general subgraph.

H. Liu, X. Wei, J. Li, G. Wang, "A star identification algorithm based on simplest general subgraph", Acta
Astronautica 183, 11–22, 2021.

A star is first identified by voting: the match groups of its pairs with all neighbours. Within a group the
simplest subgraph is built. It has as few stars as make a chance match unlikely, by a model of how many sets
of catalogue stars have given distances, and its stars must agree in all distances. A reprojection of the
catalogue with the attitude of the subgraph verifies it.

own choice: a set of v stars has N·λ₂·λ₃·λ₄…λᵥ chance matches. λ₂ is the number of stars in a ring about the
first, λ₃ in two crossings of rings, λ₄ and further in one crossing, at the mean density of guide stars; the
typical distance is a quarter of the width of the field. v is the least number, at least 3, with fewer than
0.01 expected matches.
own choice: the reprojection must put a guide star on at least half of the observed
stars. Poles and groups are tried as in `starid.lab.classic.match_group`, but without magnitudes.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from starid.arithmetic.arrays import Array, Indices
from starid.attitude.wahba import solve_wahba
from starid.errors import StaridError
from starid.kernels.jit import compiled_ieee
from starid.lab.classic.agreement import group_around
from starid.lab.classic.pairs import PairTable, pair_table, pole_partners
from starid.lab.classic.solver import ClassicIdentifier, Database, Observed

POLES: Final = 10
GROUPS: Final = 8
CHANCE: Final = 0.01
"""Largest number of chance matches expected of a subgraph."""

REPROJECTED_SHARE: Final = 0.5


def simplest_size(stars: int, width_rad: float, tolerance: float) -> int:
    """Number of stars, at least 3, of the smallest subgraph that is unlikely to match by chance.

    Parameters
    ----------
    stars : int
        Guide stars of the whole sky.
    width_rad : float
        Width of the field.
    tolerance : float
        Largest difference of two chords.
    """
    density = stars / (4.0 * math.pi)
    ring = density * 2.0 * math.pi * (0.25 * width_rad) * 2.0 * tolerance
    crossing = density * (2.0 * tolerance) ** 2
    expected, size = stars * ring * 2.0 * crossing, 3
    while expected > CHANCE and crossing < 1.0 and size < stars:
        expected, size = expected * crossing, size + 1
    return size


@compiled_ieee
def _subgraphs(
    table: PairTable, vectors: Array, directions: Array, tolerance: float, least: int
) -> list[Indices]:
    """List the subgraphs (m, 2), of at least `least` stars, that agree in all distances."""
    groups = [np.empty((0, 2), dtype=np.int64)]
    partners = [(0, 0, 0)]
    size = np.empty(vectors.shape[0], dtype=np.int64)
    for pole in range(min(directions.shape[0], POLES)):
        pole_partners(table, directions, pole, tolerance, partners, size)
        for _ in range(GROUPS):
            candidate = np.argmax(size)
            if size[candidate] + 1 < least:
                break
            pairs = np.empty((1 + len(partners), 2), dtype=np.int64)
            pairs[0, 0], pairs[0, 1] = pole, candidate
            count = 1
            for a, j, b in partners:
                if a == candidate:
                    pairs[count, 0], pairs[count, 1] = j, b
                    count += 1
            size[candidate] = 0
            members = np.empty(count, dtype=np.int64)
            size_of_group = group_around(directions, vectors, pairs[:count], 0, tolerance, members)
            if size_of_group >= least:
                groups.append(pairs[members[:size_of_group]])
    return groups


class SubgraphIdentifier(ClassicIdentifier):
    """The simplest general subgraph behind the common interface of all identifiers."""

    def _build(self) -> Database:
        self.pairs = pair_table(self.guide.vectors, self.longest_chord)
        return tuple(self.pairs)

    def _match(self, observed: Observed) -> Indices:
        least = simplest_size(len(self.guide), self.width_rad, observed.tolerance)
        subgraphs = _subgraphs(self.pairs, self.guide.vectors, observed.directions, observed.tolerance, least)
        for subgraph in sorted(subgraphs, key=len, reverse=True):
            pairs = self._reprojected(observed, subgraph)
            if len(pairs):
                return pairs
        return subgraphs[0]

    def _reprojected(self, observed: Observed, subgraph: Indices) -> Indices:
        """Match stars with the attitude of a subgraph; none if too few fit."""
        none = np.empty((0, 2), dtype=np.int64)
        if len(subgraph) == 0:
            return none
        try:
            attitude = solve_wahba(observed.directions[subgraph[:, 0]], self.guide.vectors[subgraph[:, 1]])
        except StaridError:  # collinear stars
            return none
        cosines = attitude.to_icrs(observed.directions) @ self.guide.vectors.T
        nearest = cosines.argmax(axis=1)
        gap = attitude.to_sensor(self.guide.vectors[nearest]) - observed.directions
        hit = np.flatnonzero(np.linalg.norm(gap, axis=1) <= observed.tolerance)
        if hit.size < REPROJECTED_SHARE * len(observed.row):
            return none
        return np.column_stack([hit, nearest[hit]])
