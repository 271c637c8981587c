"""Validation of the input of star identifiers."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from starid.arrays import Array
from starid.errors import StaridError

FARTHEST_PX: Final = 1e9
"""Largest coordinate accepted: no image is that large, and squares of positions must not overflow."""


def _numbers(values: ArrayLike, name: str) -> Array:
    """Make a contiguous copy of an array of numbers."""
    try:
        return np.array(values, dtype=np.float64, order="C")
    except (TypeError, ValueError) as error:
        raise StaridError(f"detections: {name} must be an array of numbers ({error})") from error


def _magnitudes(xy: Array, brightness: Array) -> tuple[float, float]:
    """Return the root of the sum of squares of each array: infinite or NaN if a value is, or if squares overflow."""
    positions = xy.ravel()
    with np.errstate(over="ignore"):
        return math.sqrt(positions @ positions), math.sqrt(brightness @ brightness)


def _is_finite(array: Array, magnitude: float) -> bool:
    """Whether all values are finite; fast unless their squares overflow."""
    return math.isfinite(magnitude) or bool(np.isfinite(array).all())


def checked_detections(
    xy_px: ArrayLike, flux: ArrayLike, xy_sigma_px: ArrayLike | None = None
) -> tuple[Array, Array, Array]:
    """Check detections; return contiguous positions (n, 2), flux (n,) and errors (n, 2), by default ones.

    Raises
    ------
    StaridError
        The shapes of the arrays disagree, a value is not finite, or a position is beyond `FARTHEST_PX`.
    """
    xy, brightness = _numbers(xy_px, "positions"), _numbers(flux, "flux")
    if xy.shape == (0,):
        xy = xy.reshape(0, 2)
    if xy.ndim != 2 or xy.shape[1] != 2 or brightness.shape != (len(xy),):
        raise StaridError(
            f"detections: shapes of positions and flux must be (n, 2) and (n,), not {xy.shape} and {brightness.shape}"
        )
    extent, light = _magnitudes(xy, brightness)
    if not (_is_finite(xy, extent) and _is_finite(brightness, light)):
        raise StaridError("detections: positions and flux must be finite numbers")
    if extent > FARTHEST_PX and float(np.abs(xy).max()) > FARTHEST_PX:
        raise StaridError(f"detections: every position must lie within ±{FARTHEST_PX:g} pixels")
    sigmas = np.ones(xy.shape)
    if xy_sigma_px is not None:
        given = _numbers(xy_sigma_px, "position errors")
        if given.shape not in {(len(xy),), xy.shape}:
            raise StaridError(
                f"detections: shape of the errors of {len(xy)} positions must be (n,) or (n, 2), not {given.shape}"
            )
        sigmas[:] = given if given.ndim == 2 else given[:, None]
        if not (np.isfinite(sigmas).all() and (sigmas > 0.0).all()):
            raise StaridError("detections: every position error must be finite and positive")
    return xy, brightness, sigmas
