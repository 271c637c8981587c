"""LPT, the log-polar transform.

X. Wei, G. Zhang, J. Jiang, "Star Identification Algorithm Based on Log-Polar Transform", Journal of Aerospace
Computing, Information, and Communication 6(8), 483–490, 2009 (98 % at a position noise of 2 px, field 12° ×
12°, stars to V 6).

The neighbours of a guide star are mapped to (ln r, θ) and binned. Projected onto the angle they form a string
with the radial bin of the star in each sector. Rotating the image shifts the string circularly, so two
patterns are compared at every shift; their similarity is the number of sectors that agree at the best one.

own choice: 120 sectors of 3° and 48 radial bins between 0.1 and 1 times the pattern radius, which is 0.65 of
the width of the field: for 937 pixels a bin is 29 px wide at the rim and 3 px at the inner end. Neighbouring
bins count as equal.
own choice: the paper finds the shift by a string search (Knuth, Morris, Pratt) that
tolerates mismatches. Here an index of the strings by radial bin finds equal codes, and a histogram of the
shifts that align them counts the agreements at all shifts at once.
"""

from __future__ import annotations

import math
from typing import ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from starid.arithmetic.arrays import Array, Indices, Indices32
from starid.kernels.jit import compiled_ieee, inner
from starid.lab.classic.neighbours import MAX_TIED, add_winners, grouped, neighbours_of, turned
from starid.lab.classic.solver import ClassicIdentifier, Database, Observed

SECTORS: Final = 120
RINGS: Final = 48
INNER: Final = 0.1
"""Inner end of the radial bins as a share of the pattern radius."""

RADIUS_SHARE: Final = 0.65
"""Pattern radius as a share of the width of the field."""

MIN_AGREEING: Final = 5
MAX_NEIGHBOURS: Final = SECTORS


@inner
def log_polar_string(
    vectors: Array, star: int, radius: float, polar: Array, rows: Indices, code: NDArray[np.uint8]
) -> None:
    """Fill in the string of a star: 1 + radial bin of the nearest neighbour in each sector, 0 if empty."""
    code[:] = 0
    for i in range(neighbours_of(vectors, star, radius, polar, rows)):
        ratio = polar[i, 0] / radius
        if ratio < INNER:
            continue
        ring = min(int(RINGS * (1.0 - math.log(ratio) / math.log(INNER))), RINGS - 1)
        sector = min(int(turned(polar[i, 1], 0.0) / (2.0 * math.pi) * SECTORS), SECTORS - 1)
        if code[sector] == 0:
            code[sector] = 1 + ring


@compiled_ieee
def _strings(vectors: Array, radius: float) -> NDArray[np.uint8]:
    """Strings (n, `SECTORS`) of all stars."""
    polar, rows = np.empty((MAX_NEIGHBOURS, 2)), np.empty(MAX_NEIGHBOURS, dtype=np.int64)
    codes = np.empty((vectors.shape[0], SECTORS), dtype=np.uint8)
    for star in range(vectors.shape[0]):
        log_polar_string(vectors, star, radius, polar, rows, codes[star])
    return codes


@compiled_ieee
def _ring_index(codes: NDArray[np.uint8]) -> tuple[Indices32, NDArray[np.uint16], NDArray[np.uint8]]:
    """Index of the strings by ring: first entry of each ring; star and sector of each entry."""
    count = np.count_nonzero(codes)
    rings, stars = np.empty(count, dtype=np.int64), np.empty(count, dtype=np.uint16)
    sectors = np.empty(count, dtype=np.uint8)
    filled = 0
    for star in range(codes.shape[0]):
        for sector in range(SECTORS):
            if codes[star, sector] > 0:
                rings[filled], stars[filled], sectors[filled] = codes[star, sector] - 1, star, sector
                filled += 1
    start, order = grouped(rings, RINGS)
    return start, stars[order], sectors[order]


@inner
def _most_agreeing(shifts: NDArray[np.int16], agreeing: Indices32) -> None:
    """Fill in the number of sectors that agree, to within one, at the best shift of each star."""
    for star in range(shifts.shape[0]):
        agreeing[star] = 0
        for shift in range(SECTORS):
            total = shifts[star, shift - 1] + shifts[star, shift] + shifts[star, (shift + 1) % SECTORS]
            agreeing[star] = max(agreeing[star], total)


@compiled_ieee
def _compare(
    index: tuple[Indices32, NDArray[np.uint16], NDArray[np.uint8]],
    stars: int,
    directions: Array,
    radius: float,
) -> Indices:
    """Match (m, 2) each observed star with the guide stars most similar to it."""
    start, owner, sectors = index
    polar, rows = np.empty((MAX_NEIGHBOURS, 2)), np.empty(MAX_NEIGHBOURS, dtype=np.int64)
    code, shifts = np.empty(SECTORS, dtype=np.uint8), np.empty((stars, SECTORS), dtype=np.int16)
    matches = np.empty((directions.shape[0] * MAX_TIED, 2), dtype=np.int64)
    agreeing = np.empty(stars, dtype=np.int32)
    filled = 0
    for pivot in range(directions.shape[0]):
        log_polar_string(directions, pivot, radius, polar, rows, code)
        shifts[:] = 0
        for place in range(SECTORS):
            ring = int(code[place]) - 1
            if ring < 0:
                continue
            for entry_row in range(start[max(ring - 1, 0)], start[min(ring + 2, RINGS)]):
                shifts[owner[entry_row], (sectors[entry_row] + SECTORS - place) % SECTORS] += 1
        _most_agreeing(shifts, agreeing)
        filled = add_winners(agreeing, MIN_AGREEING, pivot, matches, filled)
    return matches[:filled]


class LogPolarIdentifier(ClassicIdentifier):
    """The log-polar transform behind the common interface of all identifiers."""

    stars_per_field: ClassVar[float] = 30.0

    def _build(self) -> Database:
        self._radius = RADIUS_SHARE * self.width_rad
        self.index = _ring_index(_strings(self.guide.vectors, self._radius))
        return self.index

    def _match(self, observed: Observed) -> Indices:
        return _compare(self.index, len(self.guide), observed.directions, self._radius)
