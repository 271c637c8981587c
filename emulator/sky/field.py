"""Which discs in the sky are in the field of view."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Final

import numpy as np

from starid.arrays import Array
from starid.camera import Camera

_BORDER_SAMPLES: Final = 33


def disc_in_field(centre: Array, radius_rad: float, camera: Camera) -> bool:
    """Return whether any part of a disc around a direction (3,) of the sensor frame is in the field."""
    if math.acos(max(min(float(centre[2]), 1.0), -1.0)) > camera.field_radius_rad + radius_rad:
        return False
    if camera.project(centre[None, :])[1][0]:
        return True
    nearest = float(np.max(_border_of(camera) @ centre, initial=-1.0))
    return nearest >= math.cos(min(radius_rad, math.pi))


@lru_cache(maxsize=4)
def _border_of(camera: Camera) -> Array:
    """Directions (n, 3) of the outer edge of the pixel array, where it sees any."""
    border = camera.back_project(camera.border(_BORDER_SAMPLES))
    return border[~np.isnan(border).any(axis=1)]
