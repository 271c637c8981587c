"""The neighbours of a star in polar coordinates, from which the patterns of a pivot star are made.

The published patterns shift the image until the pivot is at its centre, which is valid in narrow fields only.

own choice: the sphere is rotated instead, so that a pattern does not depend on where its pivot is in the
field, at any width of field. The radius is the chord; the azimuth is measured in the tangent plane of the
pivot from an arbitrary axis, which each call chooses. It has the same sense for sensor and sky.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from starid.arithmetic.arrays import Array, Array32, Indices, Indices32
from starid.kernels.jit import compiled_ieee, inner
from starid.kernels.small_arrays import copy_values, median

MAX_TIED: Final = 4
"""Most guide stars with equal votes that a pivot may pass to the last step; more are not significant."""


@inner
def neighbours_of(vectors: Array, pivot: int, radius: float, polar: Array, rows: Indices) -> int:
    """List the neighbours of a star in order of distance.

    Parameters
    ----------
    vectors : ndarray (n, 3)
        Unit vectors.
    pivot : int
        Row of the star.
    radius : float
        Largest chord.
    polar : ndarray (m, 2)
        Receives chord and azimuth, radians in [−π, π].
    rows : ndarray (m,)
        Receives the neighbours' rows.

    Returns
    -------
    int
        Number of neighbours; if there are more than m, the later rows are left out.
    """
    px, py, pz = vectors[pivot, 0], vectors[pivot, 1], vectors[pivot, 2]
    # a perpendicular axis, from the coordinate axis of the smallest component
    ax, ay, az = 0.0, 0.0, 1.0
    if abs(px) <= abs(py) and abs(px) <= abs(pz):
        ax, az = 1.0, 0.0
    elif abs(py) <= abs(pz):
        ay, az = 1.0, 0.0
    along = ax * px + ay * py + az * pz
    ax, ay, az = ax - along * px, ay - along * py, az - along * pz
    norm = 1.0 / math.sqrt(ax * ax + ay * ay + az * az)
    ax, ay, az = ax * norm, ay * norm, az * norm
    bx, by, bz = py * az - pz * ay, pz * ax - px * az, px * ay - py * ax
    count = 0
    for i in range(vectors.shape[0]):
        x, y, z = vectors[i, 0] - px, vectors[i, 1] - py, vectors[i, 2] - pz
        square = x * x + y * y + z * z
        if i == pivot or square > radius * radius or square == 0.0 or count == rows.shape[0]:
            continue
        distance = math.sqrt(square)
        place = count
        while place > 0 and polar[place - 1, 0] > distance:
            polar[place, 0], polar[place, 1] = polar[place - 1, 0], polar[place - 1, 1]
            rows[place] = rows[place - 1]
            place -= 1
        polar[place, 0] = distance
        polar[place, 1] = math.atan2(bx * x + by * y + bz * z, ax * x + ay * y + az * z)
        rows[place] = i
        count += 1
    return count


@inner
def turned(azimuth: float, reference: float) -> float:
    """Azimuth relative to a reference, in [0, 2π)."""
    angle = azimuth - reference
    if angle < 0.0:
        angle += 2.0 * math.pi
    return angle if angle < 2.0 * math.pi else 0.0


@inner
def nearest_beyond(polar: Array | Array32, count: int, buffer: float) -> int:
    """Find the nearest neighbour beyond a buffer; −1 if there is none."""
    for i in range(count):
        if polar[i, 0] > buffer:
            return i
    return -1


@inner
def aligned_neighbours(
    vectors: Array, pivot: int, radius: float, buffer: float, polar: Array, rows: Indices
) -> tuple[int, int]:
    """List the neighbours of a pivot as `neighbours_of` does; their number, and the nearest beyond a buffer or −1."""
    count = neighbours_of(vectors, pivot, radius, polar, rows)
    return count, nearest_beyond(polar, count, buffer)


@inner
def bright_neighbour(
    polar: Array, rows: Indices, count: int, magnitude: Array, buffer: float, rank: int
) -> int:
    """Find the bright neighbour beyond a buffer that is `rank`-th in distance; −1 if there is none.

    Bright means in the brighter half; if all magnitudes are equal, every neighbour is.
    """
    values = np.empty(count)
    for i in range(count):
        values[i] = magnitude[rows[i]]
    middle = median(values, count) if count > 0 else 0.0
    for i in range(count):
        if polar[i, 0] > buffer and magnitude[rows[i]] <= middle:
            if rank == 0:
                return i
            rank -= 1
    return -1


@compiled_ieee
def neighbour_table(vectors: Array, radius: float) -> tuple[Indices32, Array32, NDArray[np.uint16]]:
    """List the neighbours of all stars.

    Parameters
    ----------
    vectors : ndarray (n, 3)
        Unit vectors.
    radius : float
        Largest chord.

    Returns
    -------
    start : ndarray (n + 1,)
        First neighbour of each star in the other two arrays.
    polar : ndarray (m, 2)
        Chords, ascending for each star, and azimuths.
    rows : ndarray (m,)
        The neighbours.
    """
    n = vectors.shape[0]
    polar, rows = np.empty((n, 2)), np.empty(n, dtype=np.int64)
    start = np.zeros(n + 1, dtype=np.int32)
    for star in range(n):
        start[star + 1] = start[star] + neighbours_of(vectors, star, radius, polar, rows)
    every, whose = np.empty((start[n], 2), dtype=np.float32), np.empty(start[n], dtype=np.uint16)
    for star in range(n):
        neighbours_of(vectors, star, radius, polar, rows)
        for i in range(start[star + 1] - start[star]):
            copy_values(polar[i], every[start[star] + i])
            whose[start[star] + i] = rows[i]
    return start, every, whose


@inner
def grouped(keys: Indices, groups: int) -> tuple[Indices32, Indices]:
    """Sort rows by key: start of each group (groups + 1,), and the sorted rows (n,)."""
    start = np.zeros(groups + 1, dtype=np.int32)
    for key in keys:
        start[key + 1] += 1
    for group in range(groups):
        start[group + 1] += start[group]
    fill = start.copy()
    order = np.empty(keys.shape[0], dtype=np.int64)
    for row in range(keys.shape[0]):
        order[fill[keys[row]]] = row
        fill[keys[row]] += 1
    return start, order


@inner
def add_winners(votes: Indices32, least: int, pivot: int, matches: Indices, filled: int) -> int:
    """Append the guide stars with the most votes, if significant; return the new number of matches.

    They need at least `least` votes, and no more than `MAX_TIED` may be tied. `matches` (n·`MAX_TIED`, 2)
    receives the pivot and the guide star.
    """
    most = votes[0]
    for number in votes:
        most = max(most, number)
    if most < least:
        return filled
    count = 0
    for star in range(votes.shape[0]):
        if votes[star] == most:
            if count == MAX_TIED:
                return filled
            matches[filled + count, 0], matches[filled + count, 1] = pivot, star
            count += 1
    return filled + count
