"""GA, the grid algorithm.

C. Padgett, K. Kreutz-Delgado, "A grid algorithm for autonomous star identification", IEEE Transactions on
Aerospace and Electronic Systems 33(1), 202–213, 1997.

A pivot star is put at the origin, its nearest neighbour beyond a buffer radius is turned onto the +x axis,
and a g × g grid is laid over the pattern radius: the cells that hold a star are the pattern. A lookup table
leads from each cell to the guide stars whose pattern has that cell. The guide star that collects the most
votes is the pivot, if it has enough and no other has as many. Every observed star is tried as the pivot, and
the largest group of matches that fits into one field is the result.

own choice: pattern radius 0.65 of the width of the field, buffer 0.15 of the pattern radius (a nearer
neighbour turns the grid by more than a cell at its rim), g = 40 as in the paper, and at least 4 votes. Up to
four guide stars with equal votes are all passed to the last step.
own choice: "fits into one field" is tested as agreement of all distances, as for all algorithms here.
"""

from __future__ import annotations

from typing import ClassVar, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from starid.arithmetic.arrays import Array, Indices, Indices32
from starid.kernels.jit import compiled_ieee, inner
from starid.lab.classic.neighbours import (
    MAX_TIED,
    add_winners,
    aligned_neighbours,
    bright_neighbour,
    grouped,
    neighbours_of,
    turned,
)
from starid.lab.classic.solver import ClassicIdentifier, Database, Observed

Table: TypeAlias = tuple[Indices32, NDArray[np.uint16]]
"""First entry of each cell in the second array; the guide stars whose pattern has the cell."""

GRID: Final = 40
"""Cells along each side of the grid."""

RADIUS_SHARE: Final = 0.65
"""Pattern radius as a share of the width of the field."""

BUFFER_SHARE: Final = 0.15
"""Buffer radius as a share of the pattern radius."""

MIN_VOTES: Final = 4
MAX_NEIGHBOURS: Final = 400


@inner
def place_on_grid(polar: Array, i: int, reference: float, radius: float, cells: int) -> tuple[float, float]:
    """Position of a neighbour, in cells, on a grid turned to a reference azimuth."""
    angle = turned(polar[i, 1], reference)
    half = 0.5 * cells
    x = half + half * polar[i, 0] / radius * np.cos(angle)
    y = half + half * polar[i, 0] / radius * np.sin(angle)
    return min(max(x, 0.0), cells - 1e-9), min(max(y, 0.0), cells - 1e-9)


@inner
def occupied_cells(polar: Array, count: int, aligned: int, radius: float, cells: int, out: Indices) -> int:
    """Collect the occupied cells of a grid turned to a neighbour; return their number."""
    filled = 0
    for i in range(count):
        x, y = place_on_grid(polar, i, polar[aligned, 1], radius, cells)
        cell = int(y) * cells + int(x)
        known = False
        for k in range(filled):
            known = known or out[k] == cell
        if not known:
            out[filled] = cell
            filled += 1
    return filled


@compiled_ieee
def lookup_table(vectors: Array, magnitude: Array, radius: float, buffer: float) -> Table:
    """Build the table from cells to guide stars.

    Each pattern is aligned with its nearest star beyond the buffer in the brighter half (`bright_neighbour`).
    """
    polar, rows = np.empty((MAX_NEIGHBOURS, 2)), np.empty(MAX_NEIGHBOURS, dtype=np.int64)
    occupied = np.empty(MAX_NEIGHBOURS, dtype=np.int64)
    cells, stars = [np.int64(0) for _ in range(0)], [np.int64(0) for _ in range(0)]
    for star in range(vectors.shape[0]):
        count = neighbours_of(vectors, star, radius, polar, rows)
        aligned = bright_neighbour(polar, rows, count, magnitude, buffer, 0)
        if aligned < 0:
            continue
        for k in range(occupied_cells(polar, count, aligned, radius, GRID, occupied)):
            cells.append(occupied[k])
            stars.append(np.int64(star))
    keys, owners = np.array(cells), np.array(stars)
    start, order = grouped(keys, GRID * GRID)
    return start, owners[order].astype(np.uint16)


@inner
def count_votes(
    table: Table, polar: Array, count: int, aligned: int, radius: float, occupied: Indices, votes: Indices32
) -> int:
    """Vote for the stars whose patterns share cells with the observed one; return its number of cells."""
    start, owner = table
    cells = occupied_cells(polar, count, aligned, radius, GRID, occupied)
    for k in range(cells):
        for place in range(start[occupied[k]], start[occupied[k] + 1]):
            votes[owner[place]] += 1
    return cells


@compiled_ieee
def _vote(table: Table, stars: int, directions: Array, radius: float, buffer: float) -> Indices:
    """Match (m, 2) each observed star, as the pivot, with the guide stars that have the most votes."""
    polar, rows = np.empty((MAX_NEIGHBOURS, 2)), np.empty(MAX_NEIGHBOURS, dtype=np.int64)
    occupied = np.empty(MAX_NEIGHBOURS, dtype=np.int64)
    matches = np.empty((directions.shape[0] * MAX_TIED, 2), dtype=np.int64)
    filled = 0
    for pivot in range(directions.shape[0]):
        count, aligned = aligned_neighbours(directions, pivot, radius, buffer, polar, rows)
        if aligned < 0:
            continue
        votes = np.zeros(stars, dtype=np.int32)
        count_votes(table, polar, count, aligned, radius, occupied, votes)
        filled = add_winners(votes, MIN_VOTES, pivot, matches, filled)
    return matches[:filled]


class GridIdentifier(ClassicIdentifier):
    """The grid algorithm behind the common interface of all identifiers."""

    stars_per_field: ClassVar[float] = 30.0

    def _build(self) -> Database:
        self._radius = RADIUS_SHARE * self.width_rad
        self._buffer = BUFFER_SHARE * self._radius
        # equal magnitudes, so that the nearest neighbour counts, bright or faint
        alike = np.zeros(len(self.guide))
        self.table = lookup_table(self.guide.vectors, alike, self._radius, self._buffer)
        return self.table

    def _match(self, observed: Observed) -> Indices:
        return _vote(self.table, len(self.guide), observed.directions, self._radius, self._buffer)
