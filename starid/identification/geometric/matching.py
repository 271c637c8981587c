"""Matching of detections to catalogue stars for a given attitude."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from starid.arithmetic.arrays import Array, Indices, Mask
from starid.arithmetic.elementary import square
from starid.identification.geometric.observation import (
    MAGNITUDE,
    SIGMA_U,
    SIGMA_V,
    U_X,
    U_Y,
    U_Z,
    V_X,
    V_Y,
    V_Z,
    Table,
    X,
    Y,
    Z,
)
from starid.identification.geometric.pattern_index import GRID_CELLS, GRID_MARGIN, STAR_MAGNITUDE, IndexArrays
from starid.identification.geometric.sky_grid import cell_of
from starid.kernels.jit import inner

WINDOW_SIGMAS: Final = 4.0
"""Half-width of a matching window in units of the centroid noise."""

SMALLEST_WINDOW_PX: Final = 0.15
BY_NOISE: Final = 0.0
"""Value of `reach` for windows of `WINDOW_SIGMAS` times the noise of each detection."""


@inner
def to_sky(rotation: Array, seen: Table, i: int) -> tuple[float, float, float]:
    """Direction of detection i in ICRS, given the ICRS→sensor matrix."""
    x, y, z = seen[i, X], seen[i, Y], seen[i, Z]
    return (
        rotation[0, 0] * x + rotation[1, 0] * y + rotation[2, 0] * z,
        rotation[0, 1] * x + rotation[1, 1] * y + rotation[2, 1] * z,
        rotation[0, 2] * x + rotation[1, 2] * y + rotation[2, 2] * z,
    )


@inner
def residual(
    star_table: Array, detections: Table, rotation: Array, i: int, star: int
) -> tuple[float, float, float, float, float]:
    """Residual of detection i along the axes of its error, pixels, and the star's direction in the sensor frame."""
    a, b, c = star_table[star, 0], star_table[star, 1], star_table[star, 2]
    x = rotation[0, 0] * a + rotation[0, 1] * b + rotation[0, 2] * c
    y = rotation[1, 0] * a + rotation[1, 1] * b + rotation[1, 2] * c
    z = rotation[2, 0] * a + rotation[2, 1] * b + rotation[2, 2] * c
    dx, dy, dz = detections[i, X] - x, detections[i, Y] - y, detections[i, Z] - z
    return (
        detections[i, U_X] * dx + detections[i, U_Y] * dy + detections[i, U_Z] * dz,
        detections[i, V_X] * dx + detections[i, V_Y] * dy + detections[i, V_Z] * dz,
        x,
        y,
        z,
    )


@inner
def _best_star(
    index: IndexArrays,
    detections: Table,
    rotation: Array,
    i: int,
    windows: tuple[float, float, float, float],
    zero_point: float,
    scatter: float,
) -> tuple[int, float]:
    """Find the likeliest star for detection i, or −1, and its cost; see `match_detections`."""
    star_table, grid_start, grid_stars = index.stars, index.grid_start, index.grid_stars
    reach, sigma, gate, px_per_rad = windows
    error_u, error_v = reach / WINDOW_SIGMAS, reach / WINDOW_SIGMAS
    if reach == BY_NOISE:
        least = SMALLEST_WINDOW_PX / WINDOW_SIGMAS
        error_u, error_v = (
            max(sigma * detections[i, SIGMA_U], least),
            max(sigma * detections[i, SIGMA_V], least),
        )
        reach = WINDOW_SIGMAS * max(error_u, error_v)
    limit = min(reach / px_per_rad, index.numbers[GRID_MARGIN])
    x, y, z = to_sky(rotation, detections, i)
    expected = detections[i, MAGNITUDE] + zero_point
    cell = cell_of(x, y, z, int(index.numbers[GRID_CELLS]))
    best, best_cost = -1, math.inf
    for entry in range(grid_start[cell], grid_start[cell + 1]):
        star = int(np.int64(grid_stars[entry]))
        deviation = star_table[star, STAR_MAGNITUDE] - expected
        if deviation > gate:
            break
        dx, dy, dz = star_table[star, 0] - x, star_table[star, 1] - y, star_table[star, 2] - z
        if deviation < -gate or dx * dx + dy * dy + dz * dz > limit * limit:
            continue
        r0, r1, _, _, _ = residual(star_table, detections, rotation, i, star)
        distance2 = square(r0 / error_u) + square(r1 / error_v)
        cost = distance2 + square(deviation / scatter)
        if distance2 <= WINDOW_SIGMAS * WINDOW_SIGMAS and cost < best_cost:
            best, best_cost = star, cost
    return best, best_cost


@inner
def match_detections(
    index: IndexArrays,
    detections: Table,
    rotation: Array,
    excluded: Mask,
    windows: tuple[float, float, float, float],
    zero_point: float,
    scatter: float,
    stars: Indices,
    costs: Array,
    owners: Indices,
) -> int:
    """Match each detection to the likeliest star in its window; return the number of matches.

    The likeliest star has the least cost ``(r/σ)² + (Δm/s)²``. A star keeps the detection of lowest cost.

    Parameters
    ----------
    excluded : ndarray (n,) of bool
        Detections that are not matched.
    windows : (reach, sigma, gate, px_per_rad)
        Window for all detections in pixels, or `BY_NOISE`; noise in pixels of a detection of unit error;
        largest deviation from the expected magnitude; lowest scale in the field, pixels per radian.
    zero_point, scatter : float
        Catalogue minus instrumental magnitude, and its scatter s.
    stars, costs : ndarray (n,)
        Filled with the index star, or −1, and its cost.
    owners : ndarray of a power of two, > 2·n
        Workspace: an open-addressing hash of star → detection.
    """
    mask = owners.shape[0] - 1
    for slot in range(owners.shape[0]):
        owners[slot] = -1
    for i in range(stars.shape[0]):
        stars[i] = -1
    matched = 0
    for i in range(stars.shape[0]):
        if excluded[i]:
            continue
        best, best_cost = _best_star(index, detections, rotation, i, windows, zero_point, scatter)
        if best < 0:
            continue
        slot = (best * 40503) & mask
        while owners[slot] >= 0 and stars[owners[slot]] != best:
            slot = (slot + 1) & mask
        rival = owners[slot]
        if rival < 0:
            matched += 1
        elif costs[rival] <= best_cost:
            continue
        else:
            stars[rival] = -1
        owners[slot] = i
        stars[i] = best
        costs[i] = best_cost
    return matched
