"""SVD, the singular value method.

J.-N. Juang, H. Y. Kim, J. L. Junkins, "An Efficient and Robust Singular Value Method for Star Pattern
Recognition and Attitude Determination", NASA/TM-2003-212142, 2003.

The directions of a star and of four others form a 3 × 5 matrix. If the sensor has attitude A, the observed
matrix is W = A·V: the singular values of both are the same whatever A is, and serve as the key. With W =
U·S·Qᵀ and V = P·S·Qᵀ the attitude is A = U·Pᵀ, where the signs of the columns follow from the two Q. The
brightest star is tried first as the reference; if nothing in the database has its key, another is tried.

own choice: the four are the nearest beyond a buffer (0.05 of the width of the field), in order of distance, a
choice that does not depend on where in the field the reference is. The first singular value follows from the
other two (their squares add up to the number of stars), so the keys are sorted by the second and compared in
the second and third.
own choice: a key is confirmed by its attitude, which must bring all five stars within the tolerance.
References are tried until `CONFIRMED` of them agree, and the attitude is computed from all their stars.
"""

from __future__ import annotations

import math
from typing import ClassVar, Final

import numpy as np

from starid.arithmetic.arrays import Array, Indices
from starid.kernels.jit import compiled_ieee
from starid.lab.classic.neighbours import nearest_beyond, neighbours_of
from starid.lab.classic.solver import ClassicIdentifier, Database, Observed

PATTERN: Final = 5
"""Number of stars in a pattern, including the reference."""

BUFFER_SHARE: Final = 0.05
RADIUS_SHARE: Final = 0.5
CONFIRMED: Final = 4
"""Number of confirmed references after which the search stops."""


@compiled_ieee
def _pattern_rows(vectors: Array, radius: float, buffer: float) -> Indices:
    """Rows (n, `PATTERN`) of each star and its nearest neighbours beyond a buffer; −1 if too few."""
    n = vectors.shape[0]
    polar, rows = np.empty((n, 2)), np.empty(n, dtype=np.int64)
    patterns = np.full((n, PATTERN), -1, dtype=np.int64)
    for star in range(n):
        count = neighbours_of(vectors, star, radius, polar, rows)
        first = nearest_beyond(polar, count, buffer)
        if first >= 0 and count - first >= PATTERN - 1:
            patterns[star, 0] = star
            patterns[star, 1:] = rows[first : first + PATTERN - 1]
    return patterns


def singular_attitude(seen: Array, stars: Array) -> Array:
    """Matrix (3, 3) ICRS→sensor from the singular vectors of observed and catalogue directions (3, m)."""
    u, _, q_seen = np.linalg.svd(seen, full_matrices=False)
    p, _, q_star = np.linalg.svd(stars, full_matrices=False)
    signs = np.where(np.sum(q_seen * q_star, axis=1) < 0.0, -1.0, 1.0)
    attitude: Array = (u * signs) @ p.T
    return attitude


class SvdIdentifier(ClassicIdentifier):
    """The singular value method behind the common interface of all identifiers."""

    stars_per_field: ClassVar[float] = 20.0
    min_stars: ClassVar[int] = PATTERN

    def _build(self) -> Database:
        self._radius = RADIUS_SHARE * self.width_rad
        self._buffer = BUFFER_SHARE * self.width_rad
        rows = _pattern_rows(self.guide.vectors, self._radius, self._buffer)
        rows = rows[rows[:, 0] >= 0]
        values = np.linalg.svd(self.guide.vectors[rows], compute_uv=False)[:, 1:]
        order = np.argsort(values[:, 0], kind="stable")
        self.rows, self.keys = rows[order].astype(np.uint16), values[order]
        return self.rows, self.keys

    def _match(self, observed: Observed) -> Indices:
        patterns = _pattern_rows(observed.directions, self._radius, self._buffer)
        matches: list[Indices] = []
        for pattern in patterns[patterns[:, 0] >= 0]:
            stars = self._confirmed(observed, pattern)
            if stars is not None:
                matches.append(np.column_stack([pattern, stars]))
            if len(matches) == CONFIRMED:
                break
        return np.concatenate(matches) if matches else np.empty((0, 2), dtype=np.int64)

    def _confirmed(self, observed: Observed, pattern: Indices) -> Indices | None:
        """Guide stars of an observed pattern, from the one key whose attitude fits all its stars."""
        directions = observed.directions[pattern].T
        key = np.linalg.svd(directions, compute_uv=False)[1:]
        # a singular value moves by at most the norm of the errors (Weyl): five stars, one sigma of the
        # tolerance each
        reach = observed.tolerance / math.sqrt(2.0) * math.sqrt(PATTERN) / 2.0
        first, last = np.searchsorted(self.keys[:, 0], [key[0] - reach, key[0] + reach])
        near = first + np.flatnonzero(np.abs(self.keys[first:last, 1] - key[1]) <= reach)
        best, least = None, observed.tolerance
        for row in near:
            rows = self.rows[row].astype(np.int64)
            stars = self.guide.vectors[rows].T
            error = directions - singular_attitude(directions, stars) @ stars
            largest = float(np.max(np.linalg.norm(error, axis=0)))
            if largest <= least:
                best, least = rows, largest
        return best
