"""Lookup of triangles in the index by their sides."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from starid.arithmetic.arrays import Indices
from starid.identification.geometric.pattern_index import (
    SIDE_BINS,
    SIDE_STEP,
    SIDE_STEPS,
    IndexArrays,
    pattern_row,
)
from starid.kernels.jit import inner


@inner
def _first_at_least(sides: NDArray[np.uint16], begin: int, end: int, shortest: int) -> int:
    """First triangle in a range whose shortest side reaches a length; `end` if there is none."""
    while begin < end:
        middle = (begin + end) >> 1
        if int(np.int64(sides[middle, 2])) < shortest:
            begin = middle + 1
        else:
            end = middle
    return begin


@inner
def find_triangles(
    index: IndexArrays,
    triangle: tuple[float, float, float],
    hand: int,
    tolerance: float,
    spread: float,
    patterns: Indices,
) -> int:
    """Find index triangles with given sides (longest first) within a tolerance; return their number.

    A non-zero `spread` also allows a common scale factor of the sides, within 1 ± spread.
    """
    sides, row_start = index.sides, index.row_start
    bins, steps = int(index.numbers[SIDE_BINS]), 1.0 / index.numbers[SIDE_STEP]
    s0, s1, s2, error = triangle[0] * steps, triangle[1] * steps, triangle[2] * steps, tolerance * steps
    per_step = bins / SIDE_STEPS
    low0, high0 = s0 * (1.0 - spread) - error, min(s0 * (1.0 + spread) + error, float(SIDE_STEPS))
    least0, most0 = math.ceil(low0), math.floor(high0)
    least1, most1 = math.ceil(s1 - error), math.floor(s1 + error)
    ratio_low, ratio_high = 1.0, 1.0
    count = 0
    for bin0 in range(max(int(low0 * per_step), 0), min(int(high0 * per_step), bins - 1) + 1):
        if spread > 0.0:
            ratio_low = max(bin0 / per_step - error, low0) / s0
            ratio_high = min((bin0 + 1) / per_step + error, high0) / s0
        low1 = max(int((s1 * ratio_low - error) * per_step), 0)
        high1 = min(int((s1 * ratio_high + error) * per_step), bin0)
        least2, most2 = math.ceil(s2 * ratio_low - error), math.floor(s2 * ratio_high + error)
        for bin1 in range(low1, high1 + 1):
            row = pattern_row(hand, bin0, bin1, bins)
            end = int(np.int64(row_start[row + 1]))
            for pattern in range(_first_at_least(sides, row_start[row], end, least2), end):
                if int(np.int64(sides[pattern, 2])) > most2:
                    break
                p0, p1 = int(np.int64(sides[pattern, 0])), int(np.int64(sides[pattern, 1]))
                if p0 < least0 or p0 > most0:
                    continue
                if spread > 0.0:
                    scale = p0 / s0
                    if abs(p1 - s1 * scale) > error or abs(sides[pattern, 2] - s2 * scale) > error:
                        continue
                elif p1 < least1 or p1 > most1:
                    continue
                patterns[count] = pattern
                count += 1
                if count == patterns.shape[0]:
                    return count
    return count
