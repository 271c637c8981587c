"""Pairs of catalogue stars by distance, found through a k-vector.

Distances are chords, 2·sin(angle/2): their order is that of the angles, they keep their precision at small
angles, and need no trigonometry. The k-vector (Mortari 1996, Search-less algorithm) counts the pairs below
each of as many evenly spaced values as there are pairs, so that a range takes two reads instead of a search.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from starid.arithmetic.arrays import Array, Array32, Indices, Indices32
from starid.errors import StaridError
from starid.kernels.jit import compiled_ieee, inner

MAX_STARS: Final = 65_535
"""Largest number of stars: their rows are stored in 16 bits."""


class PairTable(NamedTuple):
    """Pairs of stars in order of distance.

    Attributes
    ----------
    chord : ndarray (m,) float32
        Distances.
    first, second : ndarray (m,) uint16
        Their stars, ``first < second``.
    below : ndarray (m + 1,) int32
        k-vector: number of pairs whose distance is at most ``lowest + j·step``.
    line : ndarray (2,)
        ``lowest`` and ``step``.
    """

    chord: Array32
    first: NDArray[np.uint16]
    second: NDArray[np.uint16]
    below: Indices32
    line: Array

    @property
    def nbytes(self) -> int:
        """Size in bytes."""
        return sum(part.nbytes for part in self)


@inner
def chord_between(ones: Array, i: int, others: Array, j: int) -> float:
    """Distance between row i of one table of unit vectors and row j of another."""
    x, y, z = ones[i, 0] - others[j, 0], ones[i, 1] - others[j, 1], ones[i, 2] - others[j, 2]
    return math.sqrt(x * x + y * y + z * z)


@compiled_ieee
def _close_pairs(vectors: Array, longest: float) -> tuple[Array32, NDArray[np.uint16], NDArray[np.uint16]]:
    """Find all pairs up to a distance; the stars must be sorted by z."""
    n = vectors.shape[0]
    count = 0
    chord = np.empty(0, dtype=np.float32)
    first, second = np.empty(0, dtype=np.uint16), np.empty(0, dtype=np.uint16)
    for fill in range(2):
        if fill == 1:
            chord = np.empty(count, dtype=np.float32)
            first, second = np.empty(count, dtype=np.uint16), np.empty(count, dtype=np.uint16)
        count = 0
        for i in range(n):
            for j in range(i + 1, n):
                if vectors[j, 2] - vectors[i, 2] > longest:
                    break
                distance = chord_between(vectors, i, vectors, j)
                if distance <= longest:
                    if fill == 1:
                        chord[count], first[count], second[count] = distance, i, j
                    count += 1
    return chord, first, second


def pair_table(vectors: Array, longest: float) -> PairTable:
    """Tabulate all pairs of unit vectors (n, 3) that are at most a chord apart.

    Raises
    ------
    StaridError
        More stars than `MAX_STARS`.
    """
    if len(vectors) > MAX_STARS:
        raise StaridError(
            f"pair table: {len(vectors)} stars, at most {MAX_STARS} allowed; use a brighter limit"
        )
    by_z = np.argsort(vectors[:, 2], kind="stable")
    chord, low, high = _close_pairs(np.ascontiguousarray(vectors[by_z]), longest)
    one, other = by_z[low].astype(np.uint16), by_z[high].astype(np.uint16)
    order = np.lexsort((np.maximum(one, other), np.minimum(one, other), chord))
    chord, one, other = chord[order], one[order], other[order]
    lowest, step = 0.0, 1.0
    if chord.size:
        lowest = float(chord[0])
        step = (float(chord[-1]) - lowest) / chord.size or 1.0
    values = lowest + step * np.arange(chord.size + 1)
    below = np.searchsorted(chord.astype(np.float64), values, side="right").astype(np.int32)
    line = np.array([lowest, step])
    return PairTable(chord, np.minimum(one, other), np.maximum(one, other), below, line)


@inner
def pair_range(table: PairTable, low: float, high: float) -> tuple[int, int]:
    """Range of the pairs whose distance is within [low, high]: the first, and one past the last."""
    chord, below = table.chord, table.below
    pairs = chord.shape[0]
    if pairs == 0 or high < chord[0] or low > chord[pairs - 1]:
        return 0, 0
    lowest, step = table.line[0], table.line[1]
    place = math.floor((low - lowest) / step) - 1
    start = int(below[min(place, pairs)]) if place >= 0 else 0
    place = math.ceil((high - lowest) / step) + 1
    end = int(below[place]) if place <= pairs else pairs
    while start < pairs and chord[start] < low:
        start += 1
    while end > start and chord[end - 1] > high:
        end -= 1
    return start, max(start, end)


@inner
def pole_partners(
    table: PairTable,
    directions: Array,
    pole: int,
    tolerance: float,
    partners: list[tuple[int, int, int]],
    explained: Indices,
) -> None:
    """Collect the catalogue pairs that fit the distances from a pole to the other observed stars.

    Parameters
    ----------
    table
        The catalogue pairs.
    directions
        Directions of the observed stars, (n, 3).
    pole
        Row of the pole.
    tolerance
        Largest difference of two chords.
    partners
        Receives an identity of the pole, the row of the other star, and the identity of the latter.
    explained
        Receives, for each catalogue star as the pole, how many of the other stars have a partner.
    """
    partners.clear()
    explained[:] = 0
    last = np.full(explained.shape[0], -1, dtype=np.int64)
    for j in range(directions.shape[0]):
        if j == pole:
            continue
        distance = chord_between(directions, pole, directions, j)
        start, end = pair_range(table, distance - tolerance, distance + tolerance)
        for pair in range(start, end):
            for side in range(2):
                a = int(table.first[pair]) if side == 0 else int(table.second[pair])
                b = int(table.second[pair]) if side == 0 else int(table.first[pair])
                partners.append((a, j, b))
                if last[a] != j:
                    explained[a] += 1
                    last[a] = j


@compiled_ieee
def pairs_within(table: PairTable, low: float, high: float) -> tuple[int, int]:
    """The same as `pair_range`, callable from Python."""
    return pair_range(table, low, high)
