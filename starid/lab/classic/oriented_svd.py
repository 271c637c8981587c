"""OSV, oriented singular values.

X. Wei, D. Wen and others, "Star Identification Algorithm Based on Oriented Singular Value Feature and
Reliability Evaluation Method", Transactions of the Japan Society for Aeronautical and Space Sciences 62(5),
265–274, 2019 (97.0 % at a position noise of 2 px and a magnitude noise of 0.3).

The three directions of a triangle, in a fixed order, form a 3 × 3 matrix. Its singular values do not depend
on the orientation of the sensor; the order identifies the corners. Triangles of the database are sorted by
one singular value and found by binary search; each that fits votes for its corners. The match of an observed
star is kept if it is reliable: if it has enough votes, and clearly more than any other guide star.

own choice: a triangle is a star with two of its five nearest neighbours beyond a buffer (0.05 of the width of
the field). Its corners are ordered by the opposite sides; the sense in which they then run is the
orientation, and must be equal. The search is by the second singular value, and the third is checked: the
squares of all three add up to three.
own choice: a match is reliable with at least three votes and 1.3 times the votes of the next guide star.
"""

from __future__ import annotations

import math
from typing import ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from starid.arithmetic.arrays import Array, Indices, Indices32
from starid.kernels.jit import compiled_ieee
from starid.lab.classic.neighbours import nearest_beyond, neighbours_of
from starid.lab.classic.solver import ClassicIdentifier, Database, Observed

NEIGHBOURS: Final = 5
BUFFER_SHARE: Final = 0.05
RADIUS_SHARE: Final = 0.5
MIN_VOTES: Final = 3
MARGIN: Final = 1.3


@compiled_ieee
def _triangle_rows(vectors: Array, radius: float, buffer: float) -> Indices:
    """Corners (m, 3) of the triangles of each star and two of its neighbours, unordered, with repeats."""
    n = vectors.shape[0]
    polar, rows = np.empty((n, 2)), np.empty(n, dtype=np.int64)
    triangles = np.empty((n * (NEIGHBOURS * (NEIGHBOURS - 1) // 2), 3), dtype=np.int64)
    filled = 0
    for star in range(n):
        count = neighbours_of(vectors, star, radius, polar, rows)
        first = nearest_beyond(polar, count, buffer)
        if first < 0:
            continue
        last = min(first + NEIGHBOURS, count)
        for i in range(first, last):
            for j in range(i + 1, last):
                triangles[filled, 0], triangles[filled, 1], triangles[filled, 2] = star, rows[i], rows[j]
                filled += 1
    return triangles[:filled]


def oriented_triangles(vectors: Array, corners: Indices) -> tuple[Indices, Array, NDArray[np.int8]]:
    """Order triangles: unique corners (m, 3), 2nd and 3rd singular values (m, 2), orientation (m,) of ±1."""
    corners = np.unique(np.sort(corners, axis=1), axis=0).reshape(-1, 3)
    places = vectors[corners]
    opposite = np.linalg.norm(np.roll(places, -1, axis=1) - np.roll(places, -2, axis=1), axis=2)
    order = np.argsort(-opposite, axis=1, kind="stable")
    corners = np.take_along_axis(corners, order, axis=1)
    places = np.take_along_axis(places, order[:, :, None], axis=1)
    values: Array = np.empty((0, 2))
    if len(corners):
        values = np.asarray(np.linalg.svd(places, compute_uv=False)[:, 1:], dtype=np.float64)
    volume = np.einsum("ij,ij->i", np.cross(places[:, 0], places[:, 1]), places[:, 2])
    return corners, values, np.where(volume < 0.0, -1, 1).astype(np.int8)


@compiled_ieee
def _vote(
    database: tuple[NDArray[np.uint16], Array, NDArray[np.int8]],
    triangles: tuple[Indices, Array, NDArray[np.int8]],
    votes: Indices32,
    reach: float,
) -> None:
    """Add a vote for each corner of every guide triangle that fits an observed one; votes (n, N)."""
    corners, values, hand = database
    for t in range(triangles[0].shape[0]):
        second, third = triangles[1][t, 0], triangles[1][t, 1]
        first = np.searchsorted(values[:, 0], second - reach)
        for place in range(first, values.shape[0]):
            if values[place, 0] > second + reach:
                break
            if hand[place] == triangles[2][t] and abs(values[place, 1] - third) <= reach:
                for corner in range(3):
                    votes[triangles[0][t, corner], corners[place, corner]] += 1


class OrientedSvdIdentifier(ClassicIdentifier):
    """Oriented singular values behind the common interface of all identifiers."""

    sigmas: ClassVar[float] = 2.0
    tolerance_px: ClassVar[float] = 2.0

    def _build(self) -> Database:
        self._radius = RADIUS_SHARE * self.width_rad
        self._buffer = BUFFER_SHARE * self.width_rad
        vectors = self.guide.vectors
        corners, values, hand = oriented_triangles(
            vectors, _triangle_rows(vectors, self._radius, self._buffer)
        )
        order = np.argsort(values[:, 0], kind="stable")
        self.triangles = (corners[order].astype(np.uint16), values[order], hand[order])
        return self.triangles

    def _match(self, observed: Observed) -> Indices:
        rows = _triangle_rows(observed.directions, self._radius, self._buffer)
        triangles = oriented_triangles(observed.directions, rows)
        votes = np.zeros((len(observed.row), len(self.guide)), dtype=np.int32)
        _vote(self.triangles, triangles, votes, observed.tolerance / math.sqrt(2.0))
        best = votes.argmax(axis=1)
        ranked = np.sort(votes, axis=1)
        most, second = ranked[:, -1], ranked[:, -2]
        reliable = np.flatnonzero((most >= MIN_VOTES) & (most >= MARGIN * second))
        return np.column_stack([reliable, best[reliable]])
