"""RC, radial and cyclic features.

G. Zhang, X. Wei, J. Jiang, "Full-sky autonomous star identification based on radial and cyclic features of
star pattern", Image and Vision Computing 26(7), 891–897, 2008.

The radial feature (`starid.lab.classic.rings`) gives the first match: the guide stars that share the most rings
with an observed star. The cyclic feature decides among them: the directions to the neighbours, quantised into
sectors, form a bit string that is compared at its best circular shift.

own choice: 60 sectors of 6°. The ten guide stars with the most votes of the rings, at least six, are compared.
The one whose string has the most bits in common at one shift, to within one sector, is taken if unique.
"""

from __future__ import annotations

import math
from typing import ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from starid.arithmetic.arrays import Array, Indices, Indices32
from starid.kernels.jit import compiled_ieee, inner
from starid.lab.classic.neighbours import neighbours_of, turned
from starid.lab.classic.rings import MAX_NEIGHBOURS, RADIUS_SHARE, radial_votes, ring_of, ring_table
from starid.lab.classic.solver import ClassicIdentifier, Database, Observed

SECTORS: Final = 60
MIN_VOTES: Final = 6
CANDIDATES: Final = 10


@inner
def cyclic_word(polar: Array, count: int, radius: float) -> int:
    """Bits of the sectors that hold a neighbour, counted from azimuth zero."""
    word = 0
    for i in range(count):
        if ring_of(polar[i, 0], radius) >= 0:
            sector = min(int(turned(polar[i, 1], 0.0) / (2.0 * math.pi) * SECTORS), SECTORS - 1)
            word |= 1 << sector
    return word


@inner
def rotated(word: int, shift: int) -> int:
    """Shift a word circularly towards higher sectors."""
    full = (1 << SECTORS) - 1
    return ((word << shift) & full) | (word >> (SECTORS - shift))


@inner
def bits(word: int) -> int:
    """Count the bits that are set."""
    count = 0
    while word:
        word &= word - 1
        count += 1
    return count


@inner
def common_sectors(word: int, other: int) -> int:
    """Number of sectors that two words have in common, to within one sector, at the best shift."""
    wide = other | rotated(other, 1) | rotated(other, SECTORS - 1)
    best = 0
    for shift in range(SECTORS):
        best = max(best, bits(rotated(word, shift) & wide))
    return best


@compiled_ieee
def _cyclic_words(vectors: Array, radius: float) -> Indices:
    """Cyclic words (n,) of all stars."""
    polar, rows = np.empty((MAX_NEIGHBOURS, 2)), np.empty(MAX_NEIGHBOURS, dtype=np.int64)
    words = np.empty(vectors.shape[0], dtype=np.int64)
    for star in range(vectors.shape[0]):
        words[star] = cyclic_word(polar, neighbours_of(vectors, star, radius, polar, rows), radius)
    return words


@compiled_ieee
def _identify(
    table: tuple[Indices32, NDArray[np.uint16]], words: Indices, directions: Array, radius: float
) -> Indices:
    """Find the guide star of each observed star; −1 without a clear winner."""
    polar, rows = np.empty((MAX_NEIGHBOURS, 2)), np.empty(MAX_NEIGHBOURS, dtype=np.int64)
    votes = np.empty(words.shape[0], dtype=np.int32)
    matched = np.full(directions.shape[0], -1, dtype=np.int64)
    for pole in range(directions.shape[0]):
        count = neighbours_of(directions, pole, radius, polar, rows)
        radial_votes(table, polar, count, radius, votes)
        word = cyclic_word(polar, count, radius)
        best, most, second = -1, 0, 0
        for _ in range(CANDIDATES):
            star = int(np.argmax(votes))
            rings = votes[star]
            if rings < MIN_VOTES:
                break
            votes[star] = 0
            likeness = rings + common_sectors(word, words[star])
            if likeness > most:
                best, second, most = star, most, likeness
            elif likeness > second:
                second = likeness
        if most > second:
            matched[pole] = best
    return matched


class RadialCyclicIdentifier(ClassicIdentifier):
    """Radial and cyclic features behind the common interface of all identifiers."""

    stars_per_field: ClassVar[float] = 30.0

    def _build(self) -> Database:
        self._radius = RADIUS_SHARE * self.width_rad
        self.table = ring_table(self.guide.vectors, self._radius)
        self.words = _cyclic_words(self.guide.vectors, self._radius)
        return (*self.table, self.words)

    def _match(self, observed: Observed) -> Indices:
        matched = _identify(self.table, self.words, observed.directions, self._radius)
        rows = np.flatnonzero(matched >= 0)
        return np.column_stack([rows, matched[rows]])
