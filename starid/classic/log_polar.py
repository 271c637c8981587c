"""LPT, the log-polar transform.

X. Wei, G. Zhang, J. Jiang, "Star Identification Algorithm Based on Log-Polar Transform", Journal of Aerospace Computing,
Information, and Communication 6(8), 483–490, 2009 (98 % at a position noise of 2 px, field 12° × 12°, stars to V 6).

The neighbours of a guide star are mapped to (ln r, θ) and binned; projected on the angle they give a string with the radial bin
of the star in each sector. A turn of the image shifts the string circularly, so two patterns are compared at every shift, and
the number of sectors that agree at the best one is their likeness.

own choice: 120 sectors of 3° and 48 radial bins between 0.1 and 1 times the pattern radius, which is 0.65 of the width of the
field: at the rim a bin is 29 px wide of 937, at the inner end 3 px. A bin more or less counts as agreement.
own choice: the paper finds the shift by a string search (Knuth, Morris, Pratt) that bears with misses. Here a histogram
of the shifts that bring equal codes together gives the number of agreements of all shifts at once.
"""

from __future__ import annotations

import math
from typing import ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from starid.classic.neighbours import MOST_TIED, add_winners, neighbours_of, turned
from starid.classic.solver import ClassicIdentifier, Database, Observed
from starid.jit import compiled_ieee, inner

SECTORS: Final = 120
RINGS: Final = 48
INNER: Final = 0.1
"""Inner end of the radial bins over the pattern radius."""

RADIUS_SHARE: Final = 0.65
"""Pattern radius over the width of the field."""

LEAST_AGREEING: Final = 5
MOST_NEIGHBOURS: Final = SECTORS


@inner
def log_polar_string(
    vectors: NDArray[np.float64],
    star: int,
    radius: float,
    polar: NDArray[np.float64],
    rows: NDArray[np.int64],
    code: NDArray[np.uint8],
) -> None:
    """Fill in the string of a star: 1 + radial bin of the nearest neighbour in each sector, 0 where there is none."""
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
def _strings(vectors: NDArray[np.float64], radius: float) -> NDArray[np.uint8]:
    """Strings (n, `SECTORS`) of all stars."""
    polar, rows = np.empty((MOST_NEIGHBOURS, 2)), np.empty(MOST_NEIGHBOURS, dtype=np.int64)
    codes = np.empty((vectors.shape[0], SECTORS), dtype=np.uint8)
    for star in range(vectors.shape[0]):
        log_polar_string(vectors, star, radius, polar, rows, codes[star])
    return codes


@inner
def _likeness(
    seen: NDArray[np.uint8], places: NDArray[np.int64], other: NDArray[np.uint8], shifts: NDArray[np.int32]
) -> int:
    """Most sectors that agree at any shift, a sector and a ring more or less allowed."""
    shifts[:] = 0
    for sector in range(SECTORS):
        if other[sector] == 0:
            continue
        for place in places:
            if abs(int(seen[place]) - int(other[sector])) <= 1:
                shifts[(sector - place) % SECTORS] += 1
    best = 0
    for shift in range(SECTORS):
        total = shifts[shift - 1] + shifts[shift] + shifts[(shift + 1) % SECTORS]
        best = max(best, total)
    return best


@compiled_ieee
def _compare(codes: NDArray[np.uint8], seen: NDArray[np.float64], radius: float) -> NDArray[np.int64]:
    """Matches (m, 2) of each observed star with the guide stars most like it."""
    polar, rows = np.empty((MOST_NEIGHBOURS, 2)), np.empty(MOST_NEIGHBOURS, dtype=np.int64)
    code, shifts = np.empty(SECTORS, dtype=np.uint8), np.empty(SECTORS, dtype=np.int32)
    matches = np.empty((seen.shape[0] * MOST_TIED, 2), dtype=np.int64)
    agreeing = np.empty(codes.shape[0], dtype=np.int32)
    filled = 0
    for pivot in range(seen.shape[0]):
        log_polar_string(seen, pivot, radius, polar, rows, code)
        places = np.flatnonzero(code)
        for star in range(codes.shape[0]):
            agreeing[star] = _likeness(code, places, codes[star], shifts)
        filled = add_winners(agreeing, LEAST_AGREEING, pivot, matches, filled)
    return matches[:filled]


class LogPolarIdentifier(ClassicIdentifier):
    """The log-polar transform behind the interface of all identifiers."""

    stars_per_field: ClassVar[float] = 30.0

    def _build(self) -> Database:
        self._radius = RADIUS_SHARE * self.width_rad
        self.codes = _strings(self.guide.vectors, self._radius)
        return (self.codes,)

    def _match(self, observed: Observed) -> NDArray[np.int64]:
        return _compare(self.codes, observed.directions, self._radius)
