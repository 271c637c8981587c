"""AAC, the adaptive ant colony algorithm.

W. Quan, J. Fang, "A Star Recognition Method Based on the Adaptive Ant Colony Algorithm for Star Sensors", Sensors
10(3), 1955–1966, 2010. Abstract: 98 % at a position error of 50″.

A circle of fixed angular radius is drawn around a star. A colony of ants finds the shortest path through the stars
in the circle: an ant goes to the next star with a probability that grows with the pheromone on the way and falls with
its length, and leaves more pheromone the shorter its path is. The paths of all guide stars' circles are stored in
order of length; a binary search finds those as long as the observed one, and the lengths of the single steps decide.

own choice: the path begins at the centre of the circle, so that it has one sense, and 2 to 13 other stars are in the
circle, whose radius is 0.3 of the width of the field. As many ants as stars make 12 rounds; exponents 1 for
pheromone and 5 for 1/length; the share that evaporates begins at a half and falls by a twentieth in each round
without a shorter path. The random numbers are the same for all circles.
own choice: a path fits if every step does, within the tolerance of all algorithms here. Each star of a path that fits
is a match.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from starid.arithmetic.arrays import Array, Array32, Indices
from starid.kernels.jit import compiled_ieee, inner
from starid.lab.classic.neighbours import neighbours_of
from starid.lab.classic.pairs import chord_between
from starid.lab.classic.solver import ClassicIdentifier, Database, Observed

RADIUS_SHARE: Final = 0.3
"""Radius of a circle as a share of the width of the field."""

MIN_STARS: Final = 3
MAX_STARS: Final = 14
"""Least and largest number of stars in a circle, with its centre."""

ROUNDS: Final = 12
SLOWER_EVAPORATION: Final = 0.95

Paths = tuple[Array32, NDArray[np.int8], NDArray[np.uint16], Array32]


@inner
def shortest_path(chord: Array, count: int, path: Indices) -> float:
    """Find a path from star 0 through all stars, given their distances (count, count); return its length."""
    trail = np.ones((count, count))
    taken, weight = np.empty(count, dtype=np.int64), np.empty(count)
    best, evaporated, state = np.inf, 0.5, 1
    for _ in range(ROUNDS):
        added = np.zeros((count, count))
        improved = False
        for _ in range(count):
            left = np.ones(count, dtype=np.bool_)
            left[0], taken[0], length = False, 0, 0.0
            for step in range(1, count):
                here = taken[step - 1]
                for star in range(count):
                    weight[star] = trail[here, star] / chord[here, star] ** 5 if left[star] else 0.0
                state = (state * 1103515245 + 12345) % 2147483648
                drawn, there = weight.sum() * state / 2147483648.0, -1
                for star in range(count):
                    if left[star] and (there < 0 or drawn > 0.0):
                        there = star
                    drawn -= weight[star]
                taken[step], left[there] = there, False
                length += chord[here, there]
            for step in range(1, count):
                added[taken[step - 1], taken[step]] += 1.0 / length
            if length < best:
                best, improved = length, True
                path[:count] = taken
        trail = (1.0 - evaporated) * trail + added
        if not improved:
            evaporated *= SLOWER_EVAPORATION
    return best


@compiled_ieee
def _paths(vectors: Array, radius: float) -> Paths:
    """Lengths (m,), numbers of stars (m,), stars (m, `MAX_STARS`) and steps (m, `MAX_STARS` − 1) of the paths of all circles."""
    n = vectors.shape[0]
    polar, rows = np.empty((n, 2)), np.empty(n, dtype=np.int64)
    length, size = np.empty(n, dtype=np.float32), np.empty(n, dtype=np.int8)
    stars = np.zeros((n, MAX_STARS), dtype=np.uint16)
    steps = np.zeros((n, MAX_STARS - 1), dtype=np.float32)
    path, chord, inside = (
        np.empty(MAX_STARS, dtype=np.int64),
        np.empty((MAX_STARS, MAX_STARS)),
        np.empty(MAX_STARS, dtype=np.int64),
    )
    filled = 0
    for centre in range(n):
        count = 1 + neighbours_of(vectors, centre, radius, polar, rows)
        if count < MIN_STARS or count > MAX_STARS:
            continue
        inside[0], inside[1:count] = centre, rows[: count - 1]
        for i in range(count):
            for j in range(count):
                chord[i, j] = chord_between(vectors, inside[i], vectors, inside[j])
        length[filled], size[filled] = shortest_path(chord[:count, :count], count, path), count
        for i in range(count):
            stars[filled, i] = inside[path[i]]
            if i > 0:
                steps[filled, i - 1] = chord[path[i - 1], path[i]]
        filled += 1
    return length[:filled], size[:filled], stars[:filled], steps[:filled]


@compiled_ieee
def _search(guide: Paths, observed: Paths, tolerance: float) -> Indices:
    """Matches (m, 2) of the stars of each observed path with those of the guide paths that fit."""
    ones, others = [np.int64(0) for _ in range(0)], [np.int64(0) for _ in range(0)]
    for i in range(observed[0].shape[0]):
        count = observed[1][i]
        reach = tolerance * np.sqrt(count)
        for j in range(np.searchsorted(guide[0], observed[0][i] - reach), guide[0].shape[0]):
            if guide[0][j] > observed[0][i] + reach:
                break
            if guide[1][j] == count and np.abs(guide[3][j] - observed[3][i]).max() <= tolerance:
                for k in range(count):
                    ones.append(np.int64(observed[2][i, k]))
                    others.append(np.int64(guide[2][j, k]))
    return np.column_stack((np.array(ones), np.array(others)))


class AntColonyIdentifier(ClassicIdentifier):
    """The adaptive ant colony algorithm behind the common interface of all identifiers."""

    def _build(self) -> Database:
        self._radius = RADIUS_SHARE * self.width_rad
        paths = _paths(self.guide.vectors, self._radius)
        order = np.argsort(paths[0], kind="stable")
        self.paths = (paths[0][order], paths[1][order], paths[2][order], paths[3][order])
        return self.paths

    def _match(self, observed: Observed) -> Indices:
        return _search(self.paths, _paths(observed.directions, self._radius), observed.tolerance)
