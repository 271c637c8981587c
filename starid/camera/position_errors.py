"""How errors of star positions and of the camera's parameters become errors of an attitude."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from starid.arithmetic.arrays import Array
from starid.arithmetic.elementary import square
from starid.arithmetic.matrices import dot, inverse, product, root, sum_of_products
from starid.camera.camera import Camera
from starid.camera.parameter_array import CX, CY, FX, FY, K1, K2, K3, P1, P2
from starid.camera.projection import jacobian_kernel, project_kernel

SLOTS: Final = (FX, FY, CX, CY, K1, K2, P1, P2, K3)
"""Places in `Camera.params` of the parameters `starid.camera.calibration.NAMES`."""


def attitude_covariance(
    camera: Camera,
    covariance: Array,
    xy_px: Array,
    errors_px: Array,
    offset_px: Array,
    known_freedom: float,
) -> tuple[Array, float]:
    """Covariance (3, 3) of a least-squares attitude, rad², sensor frame, and noise of a star's position, pixels.

    An error p of the camera displaces the stars by Kᵢ p, which turns the attitude that fits them best by
    ``G p = (Σ RᵢᵀWᵢRᵢ)⁻¹ Σ RᵢᵀWᵢKᵢ p`` to first order; R and K are the derivatives of a star's position with respect to
    rotation and camera, and Wᵢ is the inverse covariance of its noise. The covariance of the attitude is
    ``s² (Σ RᵢᵀWᵢRᵢ)⁻¹ + G C Gᵀ``.

    The factor s² comes from the stars' distances from their predicted positions, without what errors of the camera
    explain: the mean square of the distances after subtracting the likeliest p, plus pᵀC⁻¹p. Distances that the camera
    causes would otherwise count as noise of the stars, which turns an image more easily than an error of its focal length.
    With ν degrees of freedom s² is multiplied by ν/(ν − 2), as the posterior of the attitude is Student's.

    Parameters
    ----------
    camera : Camera
        The calibrated camera.
    covariance : ndarray (9, 9)
        Covariance C of its parameters, as in `starid.camera.calibration.Calibration`.
    xy_px : ndarray (n, 2)
        Positions of the stars from which the attitude was computed; n ≥ 2.
    errors_px : ndarray (n,), (n, 2) or (n, 2, 2)
        Standard deviation of each position, per star or per axis, pixels, or its covariance, pixels².
    offset_px : ndarray (n, 2)
        Positions minus those predicted by the attitude.
    known_freedom : float
        Weight of these errors in s², as a number of degrees of freedom for s² = 1.
    """
    count = len(xy_px)
    vectors = camera.back_project(xy_px)
    errors = error_matrices(errors_px)
    whiten = inverse(root(errors))
    rotation = product(whiten, rotation_jacobian(camera.params, vectors)).reshape(2 * count, 3)
    by_camera = product(camera_jacobian(camera.params, vectors), root(covariance))
    displaced = product(whiten, by_camera).reshape(2 * count, 9)
    offset = product(whiten, offset_px[:, :, None]).reshape(2 * count)
    smallest = inverse(sum_of_products(rotation, rotation))
    turn = product(smallest, sum_of_products(rotation, displaced))
    left = offset - product(rotation, product(smallest, _weighted_sum(rotation, offset)))
    displaced = displaced - product(rotation, turn)
    by_left = _weighted_sum(displaced, left)
    shift = product(inverse(np.eye(9) + sum_of_products(displaced, displaced)), by_left)
    freedom = 2.0 * count - 3.0 + known_freedom
    unit = (known_freedom + dot(left, left) - dot(by_left, shift)) / freedom
    student = freedom / (freedom - 2.0) if freedom > 2.0 else 1.0
    noise_px = math.sqrt(unit * float(np.mean(errors[:, 0, 0] + errors[:, 1, 1])) / 2.0)
    return unit * student * smallest + product(turn, turn.T), noise_px


def _weighted_sum(rows: Array, weights: Array) -> Array:
    """Return Σ wᵢ rᵢ (k,) of the rows of a table (n, k)."""
    return np.asarray(np.sum(rows * weights[:, None], axis=0), dtype=np.float64)


def error_matrices(errors_px: Array) -> Array:
    """Return covariances (n, 2, 2) of positions; see `attitude_covariance`."""
    if errors_px.ndim == 3:
        return errors_px
    sigmas = np.broadcast_to(errors_px.reshape(len(errors_px), -1), (len(errors_px), 2))
    return np.asarray(square(sigmas[:, :, None]) * np.eye(2))


def rotation_jacobian(params: Array, vectors: Array) -> Array:
    """Derivative (n, 2, 3) of the positions with respect to a sensor rotation e, px/rad: J (v × e)."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    cross = np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]]).transpose(2, 0, 1)
    return product(jacobian_kernel(params, np.ascontiguousarray(vectors)), cross)


def camera_jacobian(params: Array, vectors: Array) -> Array:
    """Derivative (n, 2, 9) of the positions with respect to the camera parameters `SLOTS`."""
    bare = params.copy()
    bare[list(SLOTS)] = (1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    bare.flags.writeable = False
    a, b = project_kernel(bare, vectors)[0].T
    fx, fy, cx, cy = params[[FX, FY, CX, CY]]
    u, v = project_kernel(params, vectors)[0].T
    s = a * a + b * b
    slopes = np.zeros((len(vectors), 2, 9))
    slopes[:, 0, 0], slopes[:, 1, 1] = (u - cx) / fx, (v - cy) / fy
    slopes[:, 0, 2] = slopes[:, 1, 3] = 1.0
    for column, term in ((4, s), (5, s * s), (8, s * s * s)):
        slopes[:, 0, column], slopes[:, 1, column] = fx * a * term, fy * b * term
    slopes[:, 0, 6], slopes[:, 1, 6] = fx * 2.0 * a * b, fy * (s + 2.0 * b * b)
    slopes[:, 0, 7], slopes[:, 1, 7] = fx * (s + 2.0 * a * a), fy * 2.0 * a * b
    return slopes
