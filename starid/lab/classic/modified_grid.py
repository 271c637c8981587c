"""MGA, the modified grid algorithm.

M. Na, D. Zheng, P. Jia, "Modified Grid Algorithm for Noisy All-Sky Autonomous Star Identification", IEEE
Transactions on Aerospace and Electronic Systems 45(2), 516–522, 2009; a cost instead of bit matches also in
H. Lee, H. Bang, "Star Pattern Identification Technique by Modified Grid Algorithm", IEEE TAES 43(3),
1112–1116, 2007.

As in the grid algorithm a pivot is centred and its nearest neighbour beyond a buffer turned onto +x. A star
of a guide pattern shades not only its own cell but, more lightly, the cells around it, so that a star that
noise carries across the border of a cell costs a little instead of everything. The cost of a guide pattern is
the shading that the observed stars miss, weighted by their brightness. The pattern of least cost wins.

own choice: the shading is a Gaussian of the distance from the star to the centre of the cell, 0.7 cells wide
and cut off beyond the eight surrounding cells. It is stored in 8 bits (40 × 40 bytes per star; for 4 612
stars these are the published 7 380 kB).
own choice: the weight falls from 2 for the brightest neighbour to 1
for the faintest, linearly in magnitude, because bright stars are seldom false or missing. The best pattern
must cost less than 0.65 of the total weight, and less than any other.
"""

from __future__ import annotations

import math
from typing import ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from starid.arithmetic.arrays import Array, Indices
from starid.kernels.jit import compiled_ieee
from starid.lab.classic.grid import BUFFER_SHARE, GRID, MAX_NEIGHBOURS, RADIUS_SHARE, place_on_grid
from starid.lab.classic.neighbours import aligned_neighbours
from starid.lab.classic.solver import ClassicIdentifier, Database, Observed

SHADING_WIDTH: Final = 0.7
"""Standard deviation of the shading around a star, cells."""

MAX_COST: Final = 0.65
MIN_NEIGHBOURS: Final = 4


@compiled_ieee
def _shaded_patterns(vectors: Array, radius: float, buffer: float) -> NDArray[np.uint8]:
    """Shaded grids (n, `GRID`²) of all stars; empty for a star without a neighbour to align with."""
    polar, rows = np.empty((MAX_NEIGHBOURS, 2)), np.empty(MAX_NEIGHBOURS, dtype=np.int64)
    grey = np.zeros((vectors.shape[0], GRID * GRID), dtype=np.uint8)
    for star in range(vectors.shape[0]):
        count, aligned = aligned_neighbours(vectors, star, radius, buffer, polar, rows)
        if aligned < 0:
            continue
        for i in range(count):
            x, y = place_on_grid(polar, i, polar[aligned, 1], radius, GRID)
            for row in range(max(int(y) - 1, 0), min(int(y) + 2, GRID)):
                for column in range(max(int(x) - 1, 0), min(int(x) + 2, GRID)):
                    dx, dy = column + 0.5 - x, row + 0.5 - y
                    value = 255.0 * math.exp(-0.5 * (dx * dx + dy * dy) / SHADING_WIDTH**2)
                    cell = row * GRID + column
                    grey[star, cell] = max(grey[star, cell], np.uint8(value))
    return grey


@compiled_ieee
def _least_cost(
    grey: NDArray[np.uint8], directions: Array, magnitude: Array, radius: float, buffer: float
) -> Indices:
    """Find the guide star of each observed star; −1 without a clear winner."""
    polar, rows = np.empty((MAX_NEIGHBOURS, 2)), np.empty(MAX_NEIGHBOURS, dtype=np.int64)
    cells, weights = np.empty(MAX_NEIGHBOURS, dtype=np.int64), np.empty(MAX_NEIGHBOURS)
    matched = np.full(directions.shape[0], -1, dtype=np.int64)
    brightest, range_of = magnitude[0], max(magnitude[-1] - magnitude[0], 1e-9)
    for pivot in range(directions.shape[0]):
        count, aligned = aligned_neighbours(directions, pivot, radius, buffer, polar, rows)
        if aligned < 0 or count < MIN_NEIGHBOURS:
            continue
        whole = 0.0
        for i in range(count):
            x, y = place_on_grid(polar, i, polar[aligned, 1], radius, GRID)
            cells[i] = int(y) * GRID + int(x)
            weights[i] = 2.0 - (magnitude[rows[i]] - brightest) / range_of
            whole += weights[i]
        best, least, second = -1, math.inf, math.inf
        for star in range(grey.shape[0]):
            cost = whole
            for i in range(count):
                cost -= weights[i] * grey[star, cells[i]] / 255.0
            if cost < least:
                best, second, least = star, least, cost
            elif cost < second:
                second = cost
        if least <= MAX_COST * whole and least < second:
            matched[pivot] = best
    return matched


class ModifiedGridIdentifier(ClassicIdentifier):
    """The modified grid algorithm behind the common interface of all identifiers."""

    stars_per_field: ClassVar[float] = 30.0

    def _build(self) -> Database:
        self._radius = RADIUS_SHARE * self.width_rad
        self._buffer = BUFFER_SHARE * self._radius
        self.grey = _shaded_patterns(self.guide.vectors, self._radius, self._buffer)
        return (self.grey,)

    def _match(self, observed: Observed) -> Indices:
        matched = _least_cost(self.grey, observed.directions, observed.magnitude, self._radius, self._buffer)
        rows = np.flatnonzero(matched >= 0)
        return np.column_stack([rows, matched[rows]])
