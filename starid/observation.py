"""Detections as the identification kernels see them: directions, pixel gradients and magnitudes."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from starid.jit import compiled
from starid.projection import (
    FX,
    FY,
    MODEL,
    back_project_one,
    distort_slopes,
    plane_slopes,
    to_plane,
)

FAINTEST: Final = 99.0
"""Instrumental magnitude of a detection without positive flux."""


class Observations(NamedTuple):
    """Detections sorted by falling flux.

    Attributes
    ----------
    source : ndarray (n,) int64
        Row of the detection as given.
    directions : ndarray (n, 3)
        Unit vectors, sensor frame.
    gradients : ndarray (n, 2, 3)
        Derivative of the pixel position by the direction there, pixels per unit.
    magnitudes : ndarray (n,)
        −2.5·log10(flux).
    sigmas : ndarray (n,)
        One-sigma error of a position per axis, pixels, or in units of an unknown common one.
    """

    source: NDArray[np.int64]
    directions: NDArray[np.float64]
    gradients: NDArray[np.float64]
    magnitudes: NDArray[np.float64]
    sigmas: NDArray[np.float64]


@compiled
def observe(
    params: NDArray[np.float64],
    xy: NDArray[np.float64],
    flux: NDArray[np.float64],
    sigmas: NDArray[np.float64],
) -> Observations:
    """Sort detections by falling flux and look along them; those that see no direction are left out."""
    total = xy.shape[0]
    order = np.argsort(-flux, kind="mergesort")
    source = np.empty(total, dtype=np.int64)
    directions = np.empty((total, 3))
    gradients = np.empty((total, 2, 3))
    magnitudes = np.empty(total)
    ordered_sigmas = np.empty(total)
    n = 0
    fx, fy = params[FX], params[FY]
    for row in order:
        x, y, z, seen = back_project_one(params, xy[row, 0], xy[row, 1])
        if not seen:
            continue
        a, b, mapped = to_plane(params[MODEL], x, y, z)
        if not mapped:
            continue
        source[n] = row
        directions[n, 0], directions[n, 1], directions[n, 2] = x, y, z
        j11, j12, j22 = distort_slopes(params, a, b)
        ax, ay, az, bx, by, bz = plane_slopes(params[MODEL], x, y, z)
        gradients[n, 0, 0] = fx * (j11 * ax + j12 * bx)
        gradients[n, 0, 1] = fx * (j11 * ay + j12 * by)
        gradients[n, 0, 2] = fx * (j11 * az + j12 * bz)
        gradients[n, 1, 0] = fy * (j12 * ax + j22 * bx)
        gradients[n, 1, 1] = fy * (j12 * ay + j22 * by)
        gradients[n, 1, 2] = fy * (j12 * az + j22 * bz)
        magnitudes[n] = -2.5 * math.log10(flux[row]) if flux[row] > 0.0 else FAINTEST
        ordered_sigmas[n] = sigmas[row]
        n += 1
    return Observations(source[:n], directions[:n], gradients[:n], magnitudes[:n], ordered_sigmas[:n])


@compiled
def rescaled(observations: Observations, scale: float) -> Observations:
    """See the same detections with the focal length divided by `scale` (pinhole, narrow fields)."""
    n = observations.directions.shape[0]
    directions = np.empty((n, 3))
    gradients = np.empty((n, 2, 3))
    for i in range(n):
        x = observations.directions[i, 0] * scale
        y = observations.directions[i, 1] * scale
        z = observations.directions[i, 2]
        norm = math.sqrt(x * x + y * y + z * z)
        directions[i, 0], directions[i, 1], directions[i, 2] = x / norm, y / norm, z / norm
        for axis in range(2):
            gradients[i, axis, 0] = observations.gradients[i, axis, 0] * norm / scale
            gradients[i, axis, 1] = observations.gradients[i, axis, 1] * norm / scale
            gradients[i, axis, 2] = observations.gradients[i, axis, 2] * norm
    return Observations(
        observations.source, directions, gradients, observations.magnitudes, observations.sigmas
    )
