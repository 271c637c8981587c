"""Detections as the identification kernels see them: one table of directions, gradients and magnitudes."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from starid.jit_kernels import inner
from starid.projection import (
    CX,
    CY,
    FX,
    FY,
    K1,
    K3,
    MODEL,
    PINHOLE,
    back_project_one,
    distort_slopes,
    plane_slopes,
    to_plane,
)

Table = NDArray[np.float64]

X: Final = 0
Y: Final = 1
Z: Final = 2
"""Direction: unit vector in the sensor frame."""
U_X: Final = 3
U_Y: Final = 4
U_Z: Final = 5
"""Derivative of the column by the direction, pixels per unit."""
V_X: Final = 6
V_Y: Final = 7
V_Z: Final = 8
"""Derivative of the row by the direction, pixels per unit."""
MAGNITUDE: Final = 9
"""−2.5·log10(flux)."""
SIGMA_U: Final = 10
SIGMA_V: Final = 11
"""One-sigma errors of column and row, pixels, or in units of an unknown common one."""
SOURCE: Final = 12
"""Row of the detection as given."""
COLUMNS: Final = 13

FAINTEST: Final = 99.0
"""Instrumental magnitude of a detection without positive flux."""


@inner
def by_falling_flux(flux: NDArray[np.float64]) -> NDArray[np.int64]:
    """Rows by falling flux (Shell sort, gaps of Ciura); equal ones keep no particular order."""
    n = flux.shape[0]
    order = np.empty(n, dtype=np.int64)
    for i in range(n):
        order[i] = i
    for gap in (1750, 701, 301, 132, 57, 23, 10, 4, 1):
        for i in range(gap, n):
            row = order[i]
            j = i
            while j >= gap and flux[order[j - gap]] < flux[row]:
                order[j] = order[j - gap]
                j -= gap
            order[j] = row
    return order


@inner
def _look_plainly(params: NDArray[np.float64], column: float, row: float, table: Table, n: int) -> None:
    """Fill in direction and gradients of a position for a pinhole without distortion."""
    fx, fy = params[FX], params[FY]
    a, b = (column - params[CX]) / fx, (row - params[CY]) / fy
    norm = math.sqrt(1.0 + a * a + b * b)
    z = 1.0 / norm
    table[n, X], table[n, Y], table[n, Z] = a * z, b * z, z
    table[n, U_X], table[n, U_Y], table[n, U_Z] = fx * norm, 0.0, -fx * a * norm
    table[n, V_X], table[n, V_Y], table[n, V_Z] = 0.0, fy * norm, -fy * b * norm


@inner
def _describe(row: int, flux: float, sigmas: NDArray[np.float64], table: Table, n: int) -> None:
    """Fill in what is not geometry."""
    table[n, MAGNITUDE] = -2.5 * math.log10(flux) if flux > 0.0 else FAINTEST
    table[n, SIGMA_U], table[n, SIGMA_V] = sigmas[row, 0], sigmas[row, 1]
    table[n, SOURCE] = row


@inner
def observe(
    params: NDArray[np.float64],
    xy: NDArray[np.float64],
    flux: NDArray[np.float64],
    sigmas: NDArray[np.float64],
) -> Table:
    """Sort detections by falling flux and look along them; those that see no direction are left out."""
    order = by_falling_flux(flux)
    table = np.empty((flux.shape[0], COLUMNS))
    n = 0
    fx, fy, model = params[FX], params[FY], params[MODEL]
    plain = model == PINHOLE
    for term in range(K1, K3 + 1):
        plain = plain and params[term] == 0.0
    for row in order:
        if plain:
            _look_plainly(params, xy[row, 0], xy[row, 1], table, n)
            _describe(row, flux[row], sigmas, table, n)
            n += 1
            continue
        x, y, z, seen = back_project_one(params, xy[row, 0], xy[row, 1])
        a, b, mapped = to_plane(model, x, y, z)
        if not (seen and mapped):
            continue
        j11, j12, j22 = distort_slopes(params, a, b)
        ax, ay, az, bx, by, bz = plane_slopes(model, x, y, z)
        table[n, X], table[n, Y], table[n, Z] = x, y, z
        table[n, U_X] = fx * (j11 * ax + j12 * bx)
        table[n, U_Y] = fx * (j11 * ay + j12 * by)
        table[n, U_Z] = fx * (j11 * az + j12 * bz)
        table[n, V_X] = fy * (j12 * ax + j22 * bx)
        table[n, V_Y] = fy * (j12 * ay + j22 * by)
        table[n, V_Z] = fy * (j12 * az + j22 * bz)
        _describe(row, flux[row], sigmas, table, n)
        n += 1
    return table[:n]


@inner
def rescale(given: Table, scale: float, seen: Table) -> None:
    """Fill `seen` with the same detections under a focal length divided by `scale` (pinhole, narrow fields)."""
    for i in range(given.shape[0]):
        x, y, z = given[i, X] * scale, given[i, Y] * scale, given[i, Z]
        norm = math.sqrt(x * x + y * y + z * z)
        lateral = norm / scale
        seen[i, X], seen[i, Y], seen[i, Z] = x / norm, y / norm, z / norm
        seen[i, U_X], seen[i, U_Y], seen[i, U_Z] = (
            given[i, U_X] * lateral,
            given[i, U_Y] * lateral,
            given[i, U_Z] * norm,
        )
        seen[i, V_X], seen[i, V_Y], seen[i, V_Z] = (
            given[i, V_X] * lateral,
            given[i, V_Y] * lateral,
            given[i, V_Z] * norm,
        )
        for column in range(MAGNITUDE, COLUMNS):
            seen[i, column] = given[i, column]
