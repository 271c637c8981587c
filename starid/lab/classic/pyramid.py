"""PA, the pyramid algorithm.

D. Mortari, M. A. Samaan, C. Bruccoleri, J. L. Junkins, "The Pyramid Star Identification Technique",
Navigation 51(3), 171–183, 2004.

Triads of observed stars are tried in an order that spreads their indices, so that one false star spoils few
in succession. The k-vector lists the catalogue pairs for each side. A triad that fits exactly one catalogue
triangle is confirmed by a fourth star, whose three angles to the triad must fit one catalogue star: the
pyramid. The remaining stars are identified by their angles to the pyramid.

own choice: a field of just three stars has no fourth; its triad is accepted if it is unique, as the paper
allows.
own choice: 15 guide stars per field. A wide field of coarse pixels has many similar triangles, the
more the deeper the catalogue; with 15 stars and a tolerance of 4 px in 937 a triad fits 0.2 wrong triangles
on average. For the same reason the tolerance is two standard deviations of a distance, not three: a triad
that falls outside is followed by another.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from starid.arithmetic.arrays import Array, Indices
from starid.kernels.jit import compiled_ieee, inner
from starid.lab.classic.pairs import PairTable, chord_between, pair_range, pair_table
from starid.lab.classic.solver import ClassicIdentifier, Database, Observed


@inner
def _triple_product(ones: Array, i: int, j: int, k: int) -> float:
    """Triple product of three rows; its sign is the orientation of the triangle."""
    x = ones[i, 1] * ones[j, 2] - ones[i, 2] * ones[j, 1]
    y = ones[i, 2] * ones[j, 0] - ones[i, 0] * ones[j, 2]
    z = ones[i, 0] * ones[j, 1] - ones[i, 1] * ones[j, 0]
    return float(x * ones[k, 0] + y * ones[k, 1] + z * ones[k, 2])


@inner
def _link_partners(
    table: PairTable, low: float, high: float, head: Indices, link: Indices
) -> tuple[int, int]:
    """Chain the pairs of a range per star; links 2·e and 2·e + 1 belong to the two stars of pair e."""
    start, end = pair_range(table, low, high)
    for pair in range(start, end):
        a, b = table.first[pair], table.second[pair]
        place = 2 * (pair - start)
        link[place], head[a] = head[a], place
        link[place + 1], head[b] = head[b], place + 1
    return start, end


@inner
def _unique_triangle(
    table: PairTable,
    vectors: Array,
    directions: Array,
    triad: tuple[int, int, int],
    tolerance: float,
    work: tuple[Indices, Indices],
) -> tuple[int, int, int, int]:
    """Catalogue stars of a triad, and the number of triangles that fit it (counted up to two)."""
    i, j, k = triad
    head, link = work
    ij, ik, jk = (
        chord_between(directions, i, directions, j),
        chord_between(directions, i, directions, k),
        chord_between(directions, j, directions, k),
    )
    hand = _triple_product(directions, i, j, k)
    start, end = _link_partners(table, ik - tolerance, ik + tolerance, head, link)
    count, fa, fb, fc = 0, -1, -1, -1
    first, last = pair_range(table, ij - tolerance, ij + tolerance)
    for pair in range(first, last):
        for side in range(2):
            a = int(table.first[pair]) if side == 0 else int(table.second[pair])
            b = int(table.second[pair]) if side == 0 else int(table.first[pair])
            place = head[a]
            while place >= 0:
                other = start + place // 2
                c = int(table.second[other]) if place % 2 == 0 else int(table.first[other])
                if (
                    c != b
                    and abs(chord_between(vectors, b, vectors, c) - jk) <= tolerance
                    and _triple_product(vectors, a, b, c) * hand > 0.0
                ):
                    count, fa, fb, fc = count + 1, a, b, c
                place = link[place]
            if count > 1:
                break
        if count > 1:
            break
    for pair in range(start, end):
        head[table.first[pair]] = -1
        head[table.second[pair]] = -1
    return count, fa, fb, fc


@inner
def _fourth_star(
    vectors: Array,
    directions: Array,
    triad: tuple[int, int, int],
    stars: tuple[int, int, int],
    r: int,
    tolerance: float,
) -> int:
    """Find the catalogue star whose distances to the triangle fit observed star r; −1 unless unique."""
    d0, d1, d2 = (
        chord_between(directions, triad[0], directions, r),
        chord_between(directions, triad[1], directions, r),
        chord_between(directions, triad[2], directions, r),
    )
    match = -1
    for star in range(vectors.shape[0]):
        if (
            abs(chord_between(vectors, stars[0], vectors, star) - d0) <= tolerance
            and abs(chord_between(vectors, stars[1], vectors, star) - d1) <= tolerance
            and abs(chord_between(vectors, stars[2], vectors, star) - d2) <= tolerance
            and star not in stars
        ):
            if match >= 0:
                return -1
            match = star
    return match


@inner
def _complete(
    vectors: Array,
    directions: Array,
    triad: tuple[int, int, int],
    stars: tuple[int, int, int],
    tolerance: float,
    matched: Indices,
) -> int:
    """Match the remaining observed stars by their distances to the triangle; return how many fit."""
    matched[:] = -1
    for corner in range(3):
        matched[triad[corner]] = stars[corner]
    count = 0
    for r in range(directions.shape[0]):
        if r not in triad:
            matched[r] = _fourth_star(vectors, directions, triad, stars, r, tolerance)
            count += 1 if matched[r] >= 0 else 0
    return count


@compiled_ieee
def _pyramid(table: PairTable, vectors: Array, directions: Array, tolerance: float) -> Indices:
    """Guide star of each observed star or −1, from the first triad that is unique and confirmed."""
    n = directions.shape[0]
    matched = np.full(n, -1, dtype=np.int64)
    head = np.full(vectors.shape[0], -1, dtype=np.int64)
    work = (head, np.empty(2 * table.chord.shape[0], dtype=np.int64))
    for dj in range(1, n - 1):
        for dk in range(1, n - dj):
            for i in range(n - dj - dk):
                triad = (i, i + dj, i + dj + dk)
                found, a, b, c = _unique_triangle(table, vectors, directions, triad, tolerance, work)
                if found == 1 and (
                    _complete(vectors, directions, triad, (a, b, c), tolerance, matched) > 0 or n == 3
                ):
                    return matched
    return np.full(n, -1, dtype=np.int64)


class PyramidIdentifier(ClassicIdentifier):
    """The pyramid algorithm behind the common interface of all identifiers."""

    stars_per_field: ClassVar[float] = 15.0
    sigmas: ClassVar[float] = 2.0

    def _build(self) -> Database:
        self.pairs = pair_table(self.guide.vectors, self.longest_chord)
        return tuple(self.pairs)

    def _match(self, observed: Observed) -> Indices:
        matched = _pyramid(self.pairs, self.guide.vectors, observed.directions, observed.tolerance)
        rows = np.flatnonzero(matched >= 0)
        return np.column_stack([rows, matched[rows]])
