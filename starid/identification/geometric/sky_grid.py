"""A cube-map grid of the sky: the catalogue stars near a direction, in one lookup.

The sphere is divided into the six faces of a cube with n × n cells each. A cell lists every star inside it
*or nearer to it than a margin*, so that all stars within the margin of a direction are in the single cell of
that direction. Stars are numbered by decreasing brightness and the lists are sorted, to stop at a magnitude.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from starid.arithmetic.arrays import Array, Indices32
from starid.arithmetic.elementary import acos, cos
from starid.kernels.jit import compiled_ieee, inner

FACES: Final = 6
_SLOPE_MARGIN: Final = 1.25
"""Safety factor on the linear bound of a cube coordinate's change with angle, for margins up to 0.2 rad."""


@inner
def cell_of(x: float, y: float, z: float, n: int) -> int:
    """Cell number of a direction of any length, in a grid of n × n cells per face."""
    ax, ay, az = abs(x), abs(y), abs(z)
    if ax >= ay and ax >= az:
        face, depth, u, v = 0 if x > 0.0 else 1, ax, y, z
    elif ay >= az:
        face, depth, u, v = 2 if y > 0.0 else 3, ay, z, x
    else:
        face, depth, u, v = 4 if z > 0.0 else 5, az, x, y
    half = 0.5 * n / depth
    i = min(int((depth + u) * half), n - 1)
    j = min(int((depth + v) * half), n - 1)
    return (face * n + i) * n + j


@inner
def _reach(vector: Array, face: int, n: int, margin: float) -> tuple[int, int, int, int]:
    """First and last row and column of the cells of a face that are within the margin of a star.

    Without such cells the last ones are −1. The bound is generous: |∇u| on the face is at most 1 + u² + v².
    """
    axis = face // 2
    depth = vector[axis] if face % 2 == 0 else -vector[axis]
    if depth < cos(min(acos(1.0 / math.sqrt(3.0)) + margin, 1.5)):
        return 0, -1, 0, -1
    u = vector[(axis + 1) % 3] / depth
    v = vector[(axis + 2) % 3] / depth
    spread = _SLOPE_MARGIN * margin * (1.0 + u * u + v * v)
    if abs(u) - spread > 1.0 or abs(v) - spread > 1.0:
        return 0, -1, 0, -1
    half = 0.5 * n
    first_i = min(max(math.floor((1.0 + u - spread) * half), 0), n - 1)
    last_i = min(max(math.floor((1.0 + u + spread) * half), 0), n - 1)
    first_j = min(max(math.floor((1.0 + v - spread) * half), 0), n - 1)
    last_j = min(max(math.floor((1.0 + v + spread) * half), 0), n - 1)
    return first_i, last_i, first_j, last_j


@compiled_ieee
def _fill(vectors: Array, n: int, margin: float) -> tuple[Indices32, Indices32]:
    """Count the stars of each cell, then list them; see `build_sky_grid`."""
    start = np.zeros(FACES * n * n + 1, dtype=np.int32)
    for star in range(vectors.shape[0]):
        for face in range(FACES):
            first_i, last_i, first_j, last_j = _reach(vectors[star], face, n, margin)
            for i in range(first_i, last_i + 1):
                for j in range(first_j, last_j + 1):
                    start[(face * n + i) * n + j + 1] += 1
    for cell in range(FACES * n * n):
        start[cell + 1] += start[cell]
    filled = start[:-1].copy()
    stars = np.empty(start[-1], dtype=np.int32)
    for star in range(vectors.shape[0]):
        for face in range(FACES):
            first_i, last_i, first_j, last_j = _reach(vectors[star], face, n, margin)
            for i in range(first_i, last_i + 1):
                for j in range(first_j, last_j + 1):
                    cell = (face * n + i) * n + j
                    stars[filled[cell]] = star
                    filled[cell] += 1
    return start, stars


def build_sky_grid(vectors: Array, cells_per_edge: int, margin_rad: float) -> tuple[Indices32, Indices32]:
    """Build the grid for stars sorted by decreasing brightness.

    Parameters
    ----------
    vectors : ndarray (m, 3)
        Unit vectors.
    cells_per_edge : int
        Cells along the edge of a face, n.
    margin_rad : float
        The cell of a direction lists every star within this angle of it.

    Returns
    -------
    start : ndarray (6·n² + 1,) int32
        Cell c lists ``stars[start[c]:start[c + 1]]``.
    stars : ndarray int32
        Rows of `vectors`, ascending within a cell.
    """
    return _fill(np.ascontiguousarray(vectors, dtype=np.float64), cells_per_edge, margin_rad)
