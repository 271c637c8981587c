"""VP, the one-dimensional vector pattern.

L. Luo, L. Xu, H. Zhang, "An Autonomous Star Identification Algorithm Based on One-Dimensional Vector Pattern
for Star Sensors", Sensors 15(7), 16412–16429, 2015.

The neighbours of a star are rotated until its alignment star lies on the x' axis. The pattern is their
positions along x', sorted into the elements of one vector, and the plane angle between each and the alignment
star. It does not change as the image rotates, so no circular shift is needed. Patterns are found by an index
over the elements.

own choice: 200 elements over the diameter; pattern radius and buffer as in `starid.lab.classic.grid`. An observed
neighbour votes for a guide star with a neighbour in the same or an adjacent element whose angle differs by at
most 4°. (The sign of the angle separates the two mirror images at equal x'.)
own choice: the angle of a near neighbour is uncertain, so the allowed difference
grows inversely with its distance from the pivot.
"""

from __future__ import annotations

import math
from typing import ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from starid.arithmetic.arrays import Array, Array32, Indices, Indices32
from starid.kernels.jit import compiled_ieee, inner
from starid.lab.classic.grid import BUFFER_SHARE, MAX_NEIGHBOURS, RADIUS_SHARE, place_on_grid
from starid.lab.classic.neighbours import (
    MAX_TIED,
    add_winners,
    aligned_neighbours,
    grouped,
    turned,
)
from starid.lab.classic.solver import ClassicIdentifier, Database, Observed

ELEMENTS: Final = 200
ANGLE_TOLERANCE: Final = math.radians(4.0)
"""Largest difference in angle for a neighbour at half the pattern radius."""

MIN_VOTES: Final = 4


@inner
def _element(polar: Array, i: int, reference: float, radius: float) -> int:
    """Element of the vector for the x' of a neighbour."""
    return int(place_on_grid(polar, i, reference, radius, ELEMENTS)[0])


@compiled_ieee
def _patterns(vectors: Array, radius: float, buffer: float) -> tuple[Indices32, NDArray[np.uint16], Array32]:
    """Index: first entry of each element, the stars with a neighbour there, and its angle."""
    polar, rows = np.empty((MAX_NEIGHBOURS, 2)), np.empty(MAX_NEIGHBOURS, dtype=np.int64)
    elements, stars = [np.int64(0) for _ in range(0)], [np.int64(0) for _ in range(0)]
    angles = [0.0 for _ in range(0)]
    for star in range(vectors.shape[0]):
        count, aligned = aligned_neighbours(vectors, star, radius, buffer, polar, rows)
        if aligned < 0:
            continue
        for i in range(count):
            if i != aligned:
                elements.append(np.int64(_element(polar, i, polar[aligned, 1], radius)))
                stars.append(np.int64(star))
                angles.append(turned(polar[i, 1], polar[aligned, 1]))
    keys, owners, values = np.array(elements), np.array(stars), np.array(angles)
    start, order = grouped(keys, ELEMENTS)
    return start, owners[order].astype(np.uint16), values[order].astype(np.float32)


@compiled_ieee
def _vote(
    index: tuple[Indices32, NDArray[np.uint16], Array32],
    stars: int,
    directions: Array,
    radius: float,
    buffer: float,
) -> Indices:
    """Match (m, 2) each observed star, as the pivot, with the guide stars that have the most votes."""
    start, owner, angles = index
    polar, rows = np.empty((MAX_NEIGHBOURS, 2)), np.empty(MAX_NEIGHBOURS, dtype=np.int64)
    matches = np.empty((directions.shape[0] * MAX_TIED, 2), dtype=np.int64)
    filled = 0
    for pivot in range(directions.shape[0]):
        count, aligned = aligned_neighbours(directions, pivot, radius, buffer, polar, rows)
        if aligned < 0:
            continue
        votes, voter = np.zeros(stars, dtype=np.int32), np.full(stars, -1, dtype=np.int64)
        for i in range(count):
            if i == aligned:
                continue
            angle = turned(polar[i, 1], polar[aligned, 1])
            allowed = ANGLE_TOLERANCE * min(0.5 * radius / polar[i, 0], 4.0)
            middle = _element(polar, i, polar[aligned, 1], radius)
            for element in range(max(middle - 1, 0), min(middle + 2, ELEMENTS)):
                for place in range(start[element], start[element + 1]):
                    star = owner[place]
                    gap = abs(angles[place] - angle)
                    if voter[star] != i and min(gap, 2.0 * math.pi - gap) <= allowed:
                        votes[star] += 1
                        voter[star] = i
        filled = add_winners(votes, MIN_VOTES, pivot, matches, filled)
    return matches[:filled]


class VectorPatternIdentifier(ClassicIdentifier):
    """The one-dimensional vector pattern behind the common interface of all identifiers."""

    stars_per_field: ClassVar[float] = 30.0

    def _build(self) -> Database:
        self._radius = RADIUS_SHARE * self.width_rad
        self._buffer = BUFFER_SHARE * self._radius
        self.index = _patterns(self.guide.vectors, self._radius, self._buffer)
        return self.index

    def _match(self, observed: Observed) -> Indices:
        return _vote(self.index, len(self.guide), observed.directions, self._radius, self._buffer)
