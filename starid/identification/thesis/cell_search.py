"""Exact nearest neighbours among the stored feature vectors of a database, in microseconds.

The 8-bit vectors are sorted into the buckets of an implicit binary tree: each level halves the rank of one
feature, so that a bucket is a prefix of interleaved bits and the tree needs no nodes. A search descends depth
first and prunes every branch whose box is farther than the best vector found. Full-precision results use the
same tree. A stored code determines a feature to within half a step, so a cell is skipped unless its box is
nearer than the best exact distance; only the remaining cells are computed from the stars.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from starid.arithmetic.arrays import Array, Indices, Indices32
from starid.identification.thesis.database import CODE_MAX, FeatureDatabase
from starid.identification.thesis.features import FEATURE_COUNT
from starid.identification.thesis.frame_grid import GridArrays, cell_centre
from starid.identification.thesis.frame_sky import SkyArrays, cell_features
from starid.kernels.jit import compiled, inner_checked
from starid.kernels.small_arrays import nth_smallest

MAX_DEPTH: Final = 22
"""Largest number of levels of the tree: four million buckets."""

BINS_PER_FEATURE: Final = 32
"""Largest number of ranks per feature."""

_CELLS_PER_BUCKET: Final = 4
_SCAN: Final = 24
_STACK: Final = 64
_LEAST_ROOM: Final = 8
_HALF_STEP: Final = 0.5 + 1e-9


class CellIndex(NamedTuple):
    """Stored vectors in tree order; made by `make_cell_index`.

    Attributes
    ----------
    codes
        Stored vectors, (m, 5) uint8, in tree order; without cells that hold no star.
    cells
        Cell of each vector, (m,) int32.
    start
        First vector of each bucket, (2^depth + 1,) int32.
    low, high
        Smallest code at or above, and largest code at or below, each rank of each feature, (5, 32).
    depth
        Number of levels of the tree.
    """

    codes: NDArray[np.uint8]
    cells: Indices32
    start: Indices32
    low: Array
    high: Array
    depth: int


class CellArrays(NamedTuple):
    """Plain arrays of a database for compiled code: stars and frame, grid, and normalisation."""

    sky: SkyArrays
    grid: GridArrays
    minimum: Array
    scale: Array


def cell_arrays(database: FeatureDatabase) -> CellArrays:
    return CellArrays(database.sky.arrays, database.grid.arrays, database.minimum, database.scale)


@compiled
def _bucket_numbers(
    codes: NDArray[np.uint8], theta: NDArray[np.uint8], rank: Indices, depth: int, count: Indices32
) -> None:
    for cell in range(codes.shape[0]):
        if theta[cell] != 255:
            count[_bucket(codes, cell, rank, depth) + 1] += 1


@inner_checked
def _bucket(codes: NDArray[np.uint8], cell: int, rank: Indices, depth: int) -> int:
    bucket = 0
    for level in range(depth):
        feature = level % 5
        bucket = 2 * bucket + ((rank[feature, codes[cell, feature]] >> (4 - level // 5)) & 1)
    return bucket


@compiled
def _fill_buckets(
    codes: NDArray[np.uint8],
    theta: NDArray[np.uint8],
    rank: Indices,
    depth: int,
    place: Indices32,
    sorted_codes: NDArray[np.uint8],
    cells: Indices32,
) -> None:
    for cell in range(codes.shape[0]):
        if theta[cell] != 255:
            bucket = _bucket(codes, cell, rank, depth)
            where = place[bucket]
            place[bucket] = where + 1
            cells[where] = cell
            for f in range(5):
                sorted_codes[where, f] = codes[cell, f]


def make_cell_index(database: FeatureDatabase) -> CellIndex:
    """Sort the stored vectors of a database into the buckets of the tree (0.1 s for five million)."""
    codes, theta = database.features, database.theta
    filled = int(np.count_nonzero(theta != CODE_MAX))
    levels = (math.ceil(max(filled / _CELLS_PER_BUCKET, 2.0)) - 1).bit_length()
    depth = min(max(levels, FEATURE_COUNT), MAX_DEPTH)
    rank = np.zeros((FEATURE_COUNT, CODE_MAX + 1), dtype=np.int64)
    low = np.zeros((FEATURE_COUNT, BINS_PER_FEATURE))
    high = np.zeros((FEATURE_COUNT, BINS_PER_FEATURE))
    for feature in range(FEATURE_COUNT):
        share = np.cumsum(np.bincount(codes[:, feature], minlength=CODE_MAX + 1)) / codes.shape[0]
        before = np.concatenate([[0.0], share[:-1]])
        middle = 0.5 * (before + share)
        rank[feature] = np.minimum((middle * BINS_PER_FEATURE).astype(np.int64), BINS_PER_FEATURE - 1)
        members = [np.flatnonzero(rank[feature] == b) for b in range(BINS_PER_FEATURE)]
        first = np.array([m[0] if m.size else np.inf for m in members])
        last = np.array([m[-1] if m.size else -np.inf for m in members])
        low[feature] = np.minimum.accumulate(first[::-1])[::-1]
        high[feature] = np.maximum.accumulate(last)
    start = np.zeros((1 << depth) + 1, dtype=np.int32)
    _bucket_numbers(codes, theta, rank, depth, start)
    np.cumsum(start, out=start)
    sorted_codes = np.empty((filled, FEATURE_COUNT), dtype=np.uint8)
    cells = np.empty(filled, dtype=np.int32)
    _fill_buckets(codes, theta, rank, depth, start[:-1].copy(), sorted_codes, cells)
    return CellIndex(sorted_codes, cells, start, low, high, depth)


@inner_checked
def _box_distance(index: CellIndex, prefix: int, level: int, query: Array, slack: float) -> float:
    """Squared distance, in code steps, from the query to the box of a branch, minus the slack per side."""
    total = 0.0
    for feature in range(5):
        bits = (level - feature + 4) // 5
        rank = 0
        for i in range(bits):
            rank = 2 * rank + ((prefix >> (level - 1 - feature - 5 * i)) & 1)
        first = rank << (5 - bits)
        below = index.low[feature, first]
        above = index.high[feature, first + (1 << (5 - bits)) - 1]
        if below > above:
            return math.inf
        gap = max(below - query[feature], query[feature] - above) - slack
        if gap > 0.0:
            total += gap * gap
    return total


@inner_checked
def _push_children(
    index: CellIndex,
    level: int,
    prefix: int,
    query: Array,
    slack: float,
    limit: float,
    stack: Array,
    top: int,
) -> int:
    """Push the halves of a branch that are within the limit, the nearer one last; return the new top."""
    rest = index.depth - level - 1
    left = 2 * prefix
    distances = (math.inf, math.inf)
    if index.start[(left + 1) << rest] > index.start[left << rest]:
        distances = (_box_distance(index, left, level + 1, query, slack), math.inf)
    if index.start[(left + 2) << rest] > index.start[(left + 1) << rest]:
        distances = (distances[0], _box_distance(index, left + 1, level + 1, query, slack))
    far = 1 if distances[1] >= distances[0] else 0
    for turn in range(2):
        side = far if turn == 0 else 1 - far
        distance = distances[side]
        if distance <= limit:
            stack[top, 0] = level + 1
            stack[top, 1] = left + side
            stack[top, 2] = distance
            top += 1
    return top


@inner_checked
def _keep_nearest(distances: Array, cells: Indices, count: int, size: int, work: Array) -> int:
    """Move the nearest `size` of the first `count` to the front, in no particular order; return how many there are."""
    if count <= size:
        return count
    for i in range(count):
        work[i] = distances[i]
    limit = nth_smallest(work, count, size - 1)
    nearer = tied = 0
    for i in range(count):
        if distances[i] < limit:
            nearer += 1
        elif distances[i] == limit:
            work[tied] = cells[i]
            tied += 1
    last = nth_smallest(work, tied, size - nearer - 1)
    kept = 0
    for i in range(count):
        if distances[i] < limit or (distances[i] == limit and cells[i] <= last):
            distances[kept] = distances[i]
            cells[kept] = cells[i]
            kept += 1
    return kept


@compiled
def stored_neighbours(index: CellIndex, query: Array, distances: Array, cells: Indices) -> None:
    """Find the k stored vectors nearest to the query, in no particular order.

    At equal distances the lower cell is taken. Unfilled entries have an infinite distance and cell −1.

    Parameters
    ----------
    index
        Index of the database.
    query
        Observation in code steps (normalised value / 100 · 255), (5,).
    distances, cells
        Output (k,): squared distance in code steps, and cell.
    """
    size = cells.size
    room = size + max(size, _LEAST_ROOM)
    near = np.empty(room)
    near_cells = np.empty(room, dtype=np.int64)
    work = np.empty(room)
    count = 0
    limit = math.inf
    stack = np.zeros((_STACK, 3))
    top = 1
    while top > 0:
        top -= 1
        if stack[top, 2] > limit:
            continue
        level = int(stack[top, 0])
        prefix = int(stack[top, 1])
        rest = index.depth - level
        first = index.start[prefix << rest]
        last = index.start[(prefix + 1) << rest]
        if rest > 0 and last - first > _SCAN:
            top = _push_children(index, level, prefix, query, 0.0, limit, stack, top)
            continue
        for i in range(first, last):
            d = 0.0
            for f in range(5):
                gap = index.codes[i, f] - query[f]
                d += gap * gap
            if d > limit:
                continue
            near[count] = d
            near_cells[count] = index.cells[i]
            count += 1
            if count == room:
                count = _keep_nearest(near, near_cells, count, size, work)
                limit = near[:count].max()
    count = _keep_nearest(near, near_cells, count, size, work)
    for i in range(size):
        distances[i] = near[i] if i < count else math.inf
        cells[i] = near_cells[i] if i < count else -1


@compiled
def exact_vector(arrays: CellArrays, cell: int, sums: Array, out: Array) -> float:
    """Write the normalised full-precision features of a cell to `out`; return its polar angle in radians."""
    ra, dec = cell_centre(arrays.grid, cell)
    theta = cell_features(arrays.sky, ra % 360.0, dec, sums, out)
    for f in range(5):
        out[f] = (out[f] - arrays.minimum[f]) * arrays.scale[f]
    return theta


@compiled
def exact_nearest(index: CellIndex, arrays: CellArrays, observation: Array, outcome: Array) -> int:
    """Find the cell whose full-precision features are nearest to the observation; −1 in an empty database.

    Parameters
    ----------
    index, arrays
        Index and arrays of the same database.
    observation
        Normalised observation, (5,).
    outcome
        Output (2,): the distance on the normalised scale, and the number of cells computed from the stars.
    """
    query = observation * 2.55
    distances = np.empty(1)
    cells = np.empty(1, dtype=np.int64)
    stored_neighbours(index, query, distances, cells)
    best_cell = int(cells[0])
    outcome[0] = math.inf
    outcome[1] = 0.0
    if best_cell < 0:
        return -1
    sums = np.empty(8)
    vector = np.empty(5)
    best = _exact_distance(arrays, best_cell, observation, sums, vector)
    computed = 1
    stack = np.zeros((_STACK, 3))
    top = 1
    while top > 0:
        top -= 1
        if stack[top, 2] > best:
            continue
        level = int(stack[top, 0])
        prefix = int(stack[top, 1])
        rest = index.depth - level
        first = index.start[prefix << rest]
        last = index.start[(prefix + 1) << rest]
        if rest > 0 and last - first > _SCAN:
            top = _push_children(index, level, prefix, query, _HALF_STEP, best, stack, top)
            continue
        for i in range(first, last):
            d = 0.0
            for f in range(5):
                gap = abs(index.codes[i, f] - query[f]) - _HALF_STEP
                if gap > 0.0:
                    d += gap * gap
            cell = int(np.int64(index.cells[i]))
            if d <= best and cell != cells[0]:
                computed += 1
                exact = _exact_distance(arrays, cell, observation, sums, vector)
                if exact < best or (exact == best and cell < best_cell):
                    best = exact
                    best_cell = cell
    outcome[0] = math.sqrt(best) / 2.55
    outcome[1] = computed
    return best_cell


@inner_checked
def _exact_distance(arrays: CellArrays, cell: int, observation: Array, sums: Array, vector: Array) -> float:
    """Squared distance, in code steps, between the observation and the full-precision features of a cell."""
    exact_vector(arrays, cell, sums, vector)
    total = 0.0
    for f in range(5):
        gap = (vector[f] - observation[f]) * 2.55
        total += gap * gap
    return total
