"""The table of detections in the identification kernels: directions, gradients and magnitudes."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np

from starid.arithmetic.arrays import Array, Indices
from starid.arithmetic.elementary import atan2, cos, log10, sin
from starid.camera.parameter_array import CX, CY, FX, FY, K1, K2, K3, MODEL, P1, P2, PINHOLE
from starid.camera.projection import distort_slopes, from_plane, plane_slopes, undistort
from starid.kernels.jit import inner
from starid.kernels.small_arrays import zero

Table = Array

X: Final = 0
Y: Final = 1
Z: Final = 2
"""Direction: unit vector in the sensor frame."""
U_X: Final = 3
U_Y: Final = 4
U_Z: Final = 5
"""Derivative of the position along the first axis of its error with respect to direction, pixels per unit."""
V_X: Final = 6
V_Y: Final = 7
V_Z: Final = 8
"""The same along the second axis. The axes are column and row, or those of an elongated error ellipse."""
MAGNITUDE: Final = 9
"""−2.5·log10(flux)."""
SIGMA_U: Final = 10
SIGMA_V: Final = 11
"""One-sigma errors along these axes, in pixels or, if only relative errors are known, in arbitrary units."""
SOURCE: Final = 12
"""Row of the detection in the caller's arrays."""
OFFSET_U: Final = 13
OFFSET_V: Final = 14
"""Position relative to the centre of the camera along the same axes, pixels."""
COLUMNS: Final = 15

NOWHERE: Final = 1e-9
"""Length of the direction vector of a detection outside the image circle."""

FAINTEST: Final = 99.0
"""Instrumental magnitude of a detection without positive flux."""


class Raw(NamedTuple):
    """Input from the caller: camera (`starid.camera.Camera.params`), positions, flux, errors.

    The errors (n, 3) are standard deviations along two perpendicular axes, and the slope of the first, rows over columns.
    """

    params: Array
    xy: Array
    flux: Array
    sigmas: Array


@inner
def by_decreasing_flux(flux: Array) -> Indices:
    """Rows sorted by decreasing flux (Shell sort, Ciura's gaps); the order of equal fluxes is undefined."""
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
def fill_direction(params: Array, scale: float, column: float, row: float, table: Table, n: int) -> bool:
    """Fill in direction and gradients for a focal length over `scale`; False outside the image circle."""
    fx, fy, model = params[FX] / scale, params[FY] / scale, params[MODEL]
    a, b = (column - params[CX]) / fx, (row - params[CY]) / fy
    j11, j12, j22 = 1.0, 0.0, 1.0
    if not (
        params[K1] == 0.0
        and params[K2] == 0.0
        and params[P1] == 0.0
        and params[P2] == 0.0
        and params[K3] == 0.0
    ):
        a, b, solved = undistort(params, a, b)
        if not solved:
            return False
        j11, j12, j22 = distort_slopes(params, a, b)
    x, y, z, seen = from_plane(model, a, b)
    if not seen:
        return False
    ax, ay, az, bx, by, bz = plane_slopes(model, x, y, z)
    table[n, X], table[n, Y], table[n, Z] = x, y, z
    table[n, U_X] = fx * (j11 * ax + j12 * bx)
    table[n, U_Y] = fx * (j11 * ay + j12 * by)
    table[n, U_Z] = fx * (j11 * az + j12 * bz)
    table[n, V_X] = fy * (j12 * ax + j22 * bx)
    table[n, V_Y] = fy * (j12 * ay + j22 * by)
    table[n, V_Z] = fy * (j12 * az + j22 * bz)
    return True


@inner
def _to_error_axes(slope: float, first: int, second: int, count: int, table: Table, n: int) -> None:
    """Turn `count` pairs of columns of a row from the image's axes to those of the error."""
    if slope == 0.0:
        return
    c = 1.0 / math.sqrt(1.0 + slope * slope)
    s = slope * c
    for k in range(count):
        u, v = table[n, first + k], table[n, second + k]
        table[n, first + k], table[n, second + k] = c * u + s * v, c * v - s * u


@inner
def observe(raw: Raw) -> Table:
    """Sort detections by decreasing flux, compute directions, drop those outside the image circle."""
    order = by_decreasing_flux(raw.flux)
    params, xy, flux, sigmas = raw.params, raw.xy, raw.flux, raw.sigmas
    table = np.empty((flux.shape[0], COLUMNS))
    n = zero()
    for row in order:
        if not fill_direction(params, 1.0, xy[row, 0], xy[row, 1], table, n):
            continue
        table[n, MAGNITUDE] = -2.5 * log10(flux[row]) if flux[row] > 0.0 else FAINTEST
        table[n, SIGMA_U], table[n, SIGMA_V] = sigmas[row, 0], sigmas[row, 1]
        table[n, OFFSET_U], table[n, OFFSET_V] = xy[row, 0] - params[CX], xy[row, 1] - params[CY]
        _to_error_axes(sigmas[row, 2], U_X, V_X, 3, table, n)
        _to_error_axes(sigmas[row, 2], OFFSET_U, OFFSET_V, 1, table, n)
        table[n, SOURCE] = row
        n += 1
    return table[:n]


@inner
def observe_scaled(raw: Raw, observed: Table, scale: float, detections: Table) -> None:
    """Fill `detections` with the same detections for a focal length divided by `scale`.

    A detection outside the image circle gets a direction of length `NOWHERE`, far from any star.
    """
    for i in range(observed.shape[0]):
        for column in range(COLUMNS):
            detections[i, column] = observed[i, column]
        row = int(np.int64(observed[i, SOURCE]))
        if not fill_direction(raw.params, scale, raw.xy[row, 0], raw.xy[row, 1], detections, i):
            detections[i, X], detections[i, Y], detections[i, Z] = 0.0, 0.0, NOWHERE
            continue
        _to_error_axes(raw.sigmas[row, 2], U_X, V_X, 3, detections, i)


@inner
def without_aberration(
    x: float, y: float, z: float, beta_x: float, beta_y: float, beta_z: float
) -> tuple[float, float, float]:
    """Remove the aberration for velocity β from a direction; the inverse of `starid.catalog.aberration.aberrated`."""
    inverse_gamma = math.sqrt(1.0 - beta_x * beta_x - beta_y * beta_y - beta_z * beta_z)
    along = beta_x * x + beta_y * y + beta_z * z
    share = 1.0 - along / (1.0 + inverse_gamma)
    x, y, z = (
        inverse_gamma * x - share * beta_x,
        inverse_gamma * y - share * beta_y,
        inverse_gamma * z - share * beta_z,
    )
    norm = 1.0 / math.sqrt(x * x + y * y + z * z)
    return x * norm, y * norm, z * norm


@inner
def remove_aberration(
    observed: Table, beta: tuple[float, float, float], rotation: Array, detections: Table
) -> None:
    """Fill `detections` with the directions of `observed`, corrected for aberration at an ICRS→sensor matrix."""
    bx = rotation[0, 0] * beta[0] + rotation[0, 1] * beta[1] + rotation[0, 2] * beta[2]
    by = rotation[1, 0] * beta[0] + rotation[1, 1] * beta[1] + rotation[1, 2] * beta[2]
    bz = rotation[2, 0] * beta[0] + rotation[2, 1] * beta[1] + rotation[2, 2] * beta[2]
    for i in range(detections.shape[0]):
        x, y, z = observed[i, X], observed[i, Y], observed[i, Z]
        if x * x + y * y + z * z > NOWHERE:
            detections[i, X], detections[i, Y], detections[i, Z] = without_aberration(x, y, z, bx, by, bz)


@inner
def scaled(model: float, x: float, y: float, z: float, scale: float) -> tuple[float, float, float]:
    """Unit direction for a focal length divided by `scale` (ignoring distortion)."""
    if scale == 1.0:
        return x, y, z
    if model == PINHOLE:
        x, y = x * scale, y * scale
        norm = 1.0 / math.sqrt(x * x + y * y + z * z)
        return x * norm, y * norm, z * norm
    lateral = math.sqrt(x * x + y * y)
    if lateral == 0.0:
        return x, y, z
    angle = scale * atan2(lateral, z)
    factor = sin(angle) / lateral
    return x * factor, y * factor, cos(angle)
