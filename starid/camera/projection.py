"""Compiled projection between directions and pixels for all camera models, on plain arrays.

A camera is one array of numbers (`starid.camera.parameter_array`), so that other compiled kernels can call
these functions without a Python object. A model maps a direction (x, y, z) in the sensor frame to the plane:

- pinhole: ``(x/z, y/z)``, z > 0;
- equidistant: ``θ·(x, y)/hypot(x, y)``, θ the angle from the boresight;
- flat: ``(atan2(x, z), asin(y))``, longitude and latitude about the boresight.

Brown–Conrady distortion (``k1, k2, p1, p2, k3``, in OpenCV's order and with its signs; Brown 1971), the focal
lengths and the centre are then applied. Pixel centres are integers, (0, 0) top-left.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from starid.arithmetic.arrays import Array, Mask
from starid.arithmetic.elementary import atan2, cos, hypot, sin
from starid.camera.parameter_array import (
    CX,
    CY,
    EQUIDISTANT,
    FX,
    FY,
    HEIGHT,
    K1,
    K2,
    K3,
    LIMIT2,
    MODEL,
    P1,
    P2,
    PINHOLE,
    WIDTH,
)
from starid.kernels.jit import compiled, inner_checked

_MAX_ITERATIONS: Final = 60
_MAX_HALVINGS: Final = 40
_RESIDUAL: Final = 1e-13
_MAX_RESIDUAL: Final = 1e-10
_SERIES_BELOW: Final = 1e-4
_TINY: Final = 1e-150


@inner_checked
def to_plane(model: float, x: float, y: float, z: float) -> tuple[float, float, bool]:
    """Image plane coordinates of a direction before distortion, and whether the model maps it."""
    if model == PINHOLE:
        if z <= 0.0:
            return math.nan, math.nan, False
        return x / z, y / z, True
    if model == EQUIDISTANT:
        rho = hypot(x, y)
        if rho < _TINY:
            if z <= 0.0:
                return math.nan, math.nan, False
            return 0.0, 0.0, True
        g = atan2(rho, z) / rho
        return g * x, g * y, True
    c = hypot(x, z)
    if c < _TINY and abs(y) < _TINY:
        return math.nan, math.nan, False
    return atan2(x, z), atan2(y, c), True


@inner_checked
def from_plane(model: float, a: float, b: float) -> tuple[float, float, float, bool]:
    """Return the unit vector for undistorted image plane coordinates, and whether there is one."""
    if model == PINHOLE:
        k = 1.0 / math.sqrt(1.0 + a * a + b * b)
        return a * k, b * k, k, True
    if model == EQUIDISTANT:
        theta = hypot(a, b)
        if theta > math.pi:
            return math.nan, math.nan, math.nan, False
        k = 1.0 if theta < _TINY else sin(theta) / theta
        return a * k, b * k, cos(theta), True
    if abs(a) > math.pi or abs(b) > 0.5 * math.pi:
        return math.nan, math.nan, math.nan, False
    c = cos(b)
    return c * sin(a), sin(b), c * cos(a), True


@inner_checked
def distort(params: Array, a: float, b: float) -> tuple[float, float]:
    """Apply Brown–Conrady distortion to image plane coordinates."""
    s = a * a + b * b
    radial = 1.0 + s * (params[K1] + s * (params[K2] + s * params[K3]))
    p1, p2 = params[P1], params[P2]
    return (
        a * radial + 2.0 * p1 * a * b + p2 * (s + 2.0 * a * a),
        b * radial + p1 * (s + 2.0 * b * b) + 2.0 * p2 * a * b,
    )


@inner_checked
def distort_slopes(params: Array, a: float, b: float) -> tuple[float, float, float]:
    """Return the derivatives of `distort`: (∂a'/∂a, ∂a'/∂b = ∂b'/∂a, ∂b'/∂b)."""
    s = a * a + b * b
    k1, k2, k3 = params[K1], params[K2], params[K3]
    p1, p2 = params[P1], params[P2]
    radial = 1.0 + s * (k1 + s * (k2 + s * k3))
    slope = 2.0 * (k1 + s * (2.0 * k2 + s * 3.0 * k3))
    return (
        radial + a * a * slope + 2.0 * p1 * b + 6.0 * p2 * a,
        a * b * slope + 2.0 * p1 * a + 2.0 * p2 * b,
        radial + b * b * slope + 6.0 * p1 * b + 2.0 * p2 * a,
    )


@inner_checked
def undistort(params: Array, a: float, b: float) -> tuple[float, float, bool]:
    """Invert `distort` by damped Newton steps inside the one-to-one disc; False if there is no solution."""
    limit2 = params[LIMIT2]
    u, v = a, b
    s = u * u + v * v
    if s > limit2:
        shrink = 0.999 * math.sqrt(limit2 / s)
        u, v = u * shrink, v * shrink
    da, db = distort(params, u, v)
    ra, rb = a - da, b - db
    residual = hypot(ra, rb)
    scale = 1.0 + hypot(a, b)
    for _ in range(_MAX_ITERATIONS):
        if residual <= _RESIDUAL * scale:
            break
        j11, j12, j22 = distort_slopes(params, u, v)
        determinant = j11 * j22 - j12 * j12
        if determinant <= 0.0:
            break
        step_u = (j22 * ra - j12 * rb) / determinant
        step_v = (j11 * rb - j12 * ra) / determinant
        fraction = 1.0
        better = False
        for _ in range(_MAX_HALVINGS):
            nu, nv = u + fraction * step_u, v + fraction * step_v
            if nu * nu + nv * nv <= limit2:
                da, db = distort(params, nu, nv)
                candidate = hypot(a - da, b - db)
                if candidate < residual:
                    u, v, ra, rb, residual = nu, nv, a - da, b - db, candidate
                    better = True
                    break
            fraction *= 0.5
        if not better:
            break
    return u, v, residual <= _MAX_RESIDUAL * scale


@inner_checked
def project_one(params: Array, x: float, y: float, z: float) -> tuple[float, float, bool]:
    """Project a direction in the sensor frame to pixel (u, v); also return whether it is on the pixel array.

    A direction outside the field but on the one-to-one part of the lens gets its true position, which a
    renderer needs for light that spills into the image; any other gets NaN.
    """
    a, b, mapped = to_plane(params[MODEL], x, y, z)
    if not mapped or a * a + b * b > params[LIMIT2]:
        return math.nan, math.nan, False
    a, b = distort(params, a, b)
    u = params[FX] * a + params[CX]
    v = params[FY] * b + params[CY]
    inside = -0.5 <= u < params[WIDTH] - 0.5 and -0.5 <= v < params[HEIGHT] - 0.5
    return u, v, inside


@inner_checked
def back_project_one(params: Array, u: float, v: float) -> tuple[float, float, float, bool]:
    """Return the unit vector (x, y, z) of a pixel position; NaN if there is none."""
    a, b, solved = undistort(params, (u - params[CX]) / params[FX], (v - params[CY]) / params[FY])
    if not solved:
        return math.nan, math.nan, math.nan, False
    return from_plane(params[MODEL], a, b)


@compiled
def project_kernel(params: Array, vectors: Array) -> tuple[Array, Mask]:
    """`project_one` for vectors (n, 3): positions (n, 2) in pixels, and the mask (n,) of those inside."""
    n = vectors.shape[0]
    xy = np.empty((n, 2))
    inside = np.empty(n, dtype=np.bool_)
    for i in range(n):
        xy[i, 0], xy[i, 1], inside[i] = project_one(params, vectors[i, 0], vectors[i, 1], vectors[i, 2])
    return xy, inside


@compiled
def back_project_kernel(params: Array, xy: Array) -> Array:
    """`back_project_one` for positions (n, 2): unit vectors (n, 3)."""
    n = xy.shape[0]
    vectors = np.empty((n, 3))
    for i in range(n):
        vectors[i, 0], vectors[i, 1], vectors[i, 2], _ = back_project_one(params, xy[i, 0], xy[i, 1])
    return vectors


@inner_checked
def plane_slopes(
    model: float, x: float, y: float, z: float
) -> tuple[float, float, float, float, float, float]:
    """Return the derivatives of `to_plane`: (∂a/∂x, ∂a/∂y, ∂a/∂z, ∂b/∂x, ∂b/∂y, ∂b/∂z)."""
    if model == PINHOLE:
        k = 1.0 / z
        return k, 0.0, -x * k * k, 0.0, k, -y * k * k
    if model == EQUIDISTANT:
        rho2 = x * x + y * y
        r2 = rho2 + z * z
        rho = math.sqrt(rho2)
        if rho < _SERIES_BELOW * z:
            g = (1.0 - rho2 / (3.0 * z * z)) / z
            h = -2.0 / (3.0 * z * z * z)
        else:
            g = atan2(rho, z) / rho
            h = (z / r2 - g) / rho2
        return g + x * x * h, x * y * h, -x / r2, x * y * h, g + y * y * h, -y / r2
    c2 = x * x + z * z
    c = math.sqrt(c2)
    r2 = c2 + y * y
    return z / c2, 0.0, -x / c2, -y * x / (c * r2), c / r2, -y * z / (c * r2)


@compiled
def jacobian_kernel(params: Array, vectors: Array) -> Array:
    """Return the derivative (n, 2, 3) of pixel positions with respect to direction, at vectors (n, 3)."""
    n = vectors.shape[0]
    jacobian = np.empty((n, 2, 3))
    fx, fy = params[FX], params[FY]
    for i in range(n):
        x, y, z = vectors[i, 0], vectors[i, 1], vectors[i, 2]
        a, b, mapped = to_plane(params[MODEL], x, y, z)
        if not mapped:
            jacobian[i] = math.nan
            continue
        j11, j12, j22 = distort_slopes(params, a, b)
        ax, ay, az, bx, by, bz = plane_slopes(params[MODEL], x, y, z)
        jacobian[i, 0, 0] = fx * (j11 * ax + j12 * bx)
        jacobian[i, 0, 1] = fx * (j11 * ay + j12 * by)
        jacobian[i, 0, 2] = fx * (j11 * az + j12 * bz)
        jacobian[i, 1, 0] = fy * (j12 * ax + j22 * bx)
        jacobian[i, 1, 1] = fy * (j12 * ay + j22 * by)
        jacobian[i, 1, 2] = fy * (j12 * az + j22 * bz)
    return jacobian


@compiled
def undistorted_reach(params: Array, xy: Array) -> float:
    """Return the largest radius, in the plane without distortion, of pixel positions (n, 2); NaN if one has none."""
    reach = 0.0
    for row in range(xy.shape[0]):
        u, v = (xy[row, 0] - params[CX]) / params[FX], (xy[row, 1] - params[CY]) / params[FY]
        a, b, solved = undistort(params, u, v)
        if not solved:
            return math.nan
        reach = max(reach, hypot(a, b))
    return reach


@compiled
def is_one_to_one(params: Array, limit: float, radii: int, angles: int) -> bool:
    """Whether the distortion turns nothing over at points of a disc in the image plane."""
    for i in range(radii):
        for j in range(angles):
            radius, angle = limit * i / (radii - 1), 2.0 * math.pi * j / angles
            j11, j12, j22 = distort_slopes(params, radius * cos(angle), radius * sin(angle))
            if j11 * j22 - j12 * j12 <= 0.0 or j11 <= 0.0:
                return False
    return True
