"""Selection of pattern stars in order of brightness, with a quota per neighbourhood."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from starid.arithmetic.arrays import Array, Indices, Mask
from starid.arithmetic.elementary import acos, sin
from starid.kernels.jit import compiled_ieee

_FINEST_CELL: Final = 0.01
"""Smallest edge of a cell of the lookup grid, on the unit sphere; bounds its memory."""


@compiled_ieee
def _select(vectors: Array, chord: float, quota: int, finest_cell: float) -> Mask:
    """Select stars in order while fewer than `quota` selected ones lie within a chord of them.

    Selected stars are kept in lists, one for each cell of a cubic grid whose cells are as wide as the chord.
    """
    edge = max(chord, finest_cell)
    cells = int(2.0 / edge) + 1
    head = np.full(cells * cells * cells, -1, dtype=np.int32)
    behind = np.full(vectors.shape[0], -1, dtype=np.int32)
    taken = np.zeros(vectors.shape[0], dtype=np.bool_)
    reach2 = chord * chord
    for star in range(vectors.shape[0]):
        x, y, z = vectors[star, 0], vectors[star, 1], vectors[star, 2]
        i, j, k = int((x + 1.0) / edge), int((y + 1.0) / edge), int((z + 1.0) / edge)
        crowd = 0
        for a in range(max(i - 1, 0), min(i + 2, cells)):
            for b in range(max(j - 1, 0), min(j + 2, cells)):
                for c in range(max(k - 1, 0), min(k + 2, cells)):
                    other = head[(a * cells + b) * cells + c]
                    while other >= 0:
                        dx, dy, dz = vectors[other, 0] - x, vectors[other, 1] - y, vectors[other, 2] - z
                        if dx * dx + dy * dy + dz * dz <= reach2:
                            crowd += 1
                        other = behind[other]
        if crowd < quota:
            taken[star] = True
            cell = (i * cells + j) * cells + k
            behind[star] = head[cell]
            head[cell] = star
    return taken


def select_pattern_stars(vectors: Array, cap_area_sr: float, quota: int) -> Indices:
    """Select the rows of the pattern stars.

    Parameters
    ----------
    vectors : ndarray (m, 3)
        Unit vectors, brightest first.
    cap_area_sr : float
        Solid angle of the cap around a star that counts as its neighbourhood.
    quota : int
        Largest number of selected stars in a neighbourhood.
    """
    radius = acos(max(1.0 - cap_area_sr / (2.0 * math.pi), -1.0))
    return np.flatnonzero(_select(vectors, 2.0 * sin(0.5 * radius), quota, _FINEST_CELL))
