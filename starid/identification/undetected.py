"""Catalogue stars that should be visible in an image but have no detection."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from starid.arithmetic.arrays import Array, Indices32, Mask
from starid.arithmetic.elementary import square
from starid.camera import Camera
from starid.catalog import StarCatalog
from starid.errors import StaridError
from starid.identification.solution import Solution

COMPLETE_TO: Final = 0.8
"""Share of the predicted stars that must be detected for a magnitude bin to count as complete."""

_BIN: Final = 0.5
_EDGE_PX: Final = 3.0


@dataclass(frozen=True, eq=False)
class MissingStars:
    """Stars that should be visible but have no detection.

    Attributes
    ----------
    hip : ndarray (k,) int32
        Hipparcos numbers, brightest first.
    xy_px : ndarray (k, 2)
        Predicted positions, pixels.
    magnitude : ndarray (k,)
        V magnitudes.
    complete_to : float
        Faintest V to which nearly all predicted stars are detected; only brighter stars are reported.
    """

    hip: Indices32
    xy_px: Array
    magnitude: Array
    complete_to: float


def missing_stars(
    solution: Solution, camera: Camera, stars: StarCatalog, xy_px: ArrayLike, *, radius_px: float = 4.0
) -> MissingStars:
    """Find the stars in the field, above the completeness limit, without a detection near them.

    Parameters
    ----------
    solution : Solution
        A valid solution of the detections.
    camera : Camera
        The camera; a refined camera in the solution takes precedence.
    stars : StarCatalog
        Stars as the camera resolves them (`Identifier.stars`).
    xy_px : array (n, 2)
        All detections, pixels.
    radius_px : float
        A star with a detection within this distance, matched or not, is not missing.

    Raises
    ------
    StaridError
        The solution is invalid.
    """
    if not radius_px > 0.0:
        raise StaridError(f"missing stars radius_px: must be a positive number of pixels, not {radius_px}")
    camera = solution.camera or camera
    attitude = solution.attitude
    near = stars.in_cone(attitude.boresight, camera.field_radius_rad)
    xy, inside = camera.project(attitude.to_sensor(stars.vectors[near]))
    border = np.minimum(xy, [camera.width - 1, camera.height - 1] - xy).min(axis=1)
    chosen = inside & (border > _EDGE_PX)
    near, xy = near[chosen], xy[chosen]
    detections = np.asarray(xy_px, dtype=np.float64).reshape(-1, 2)
    is_detected = np.isin(stars.hip[near], solution.hip)
    if len(detections):
        for row in np.flatnonzero(~is_detected):
            gap = detections - xy[row]
            is_detected[row] = bool(np.min(np.sum(square(gap), axis=1)) < radius_px * radius_px)
    magnitude = stars.v[near]
    limit = _complete_to(magnitude, is_detected)
    lost = np.flatnonzero(~is_detected & (magnitude <= limit))
    return MissingStars(stars.hip[near][lost], xy[lost], magnitude[lost], limit)


def _complete_to(magnitude: Array, is_detected: Mask) -> float:
    """Faint end of the last complete half-magnitude bin; −inf if there is none."""
    limit = -math.inf
    if magnitude.size == 0:
        return limit
    bins = np.floor(magnitude / _BIN).astype(np.int64)
    for edge in range(int(bins.min()), int(bins.max()) + 1):
        inside = bins == edge
        if inside.any() and float(is_detected[inside].mean()) >= COMPLETE_TO:
            limit = (edge + 1) * _BIN
    return limit
