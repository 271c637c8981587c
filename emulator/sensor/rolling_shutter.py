"""A rolling shutter: each row of the image is exposed at a different time."""

from __future__ import annotations

from typing import Final

import numpy as np

from starid.arithmetic.arrays import Array, elementwise
from starid.arithmetic.elementary import cos, sin
from starid.arithmetic.matrices import length, product
from starid.camera import Camera

_ROUNDS: Final = 3
"""Number of iterations for the row of a star and the time of this row."""


def at_row_times(
    vectors: Array,
    camera: Camera,
    rate_rad_s: Array,
    row_time_s: float,
) -> Array:
    """Return directions (n, 3) in the sensor frame at the times of the rows on which they fall.

    They are given at the time of the middle row; the body rate (3,) is in the sensor frame, and rows are `row_time_s`
    seconds apart.
    """
    if row_time_s == 0.0 or not np.any(rate_rad_s):
        return vectors
    middle = 0.5 * (camera.height - 1)
    turned_vectors = vectors
    for _ in range(_ROUNDS):
        xy, _ = camera.project(turned_vectors)
        rows = np.clip(np.nan_to_num(xy[:, 1], nan=middle), -camera.height, 2.0 * camera.height)
        turned_vectors = turned(vectors, rate_rad_s, (rows - middle) * row_time_s)
    return turned_vectors


def turned(vectors: Array, rate_rad_s: Array, times_s: Array) -> Array:
    """Return directions (n, 3) in the frame of a rotating sensor, each at its own time (n,), seconds, from those at time 0.

    They are rotated as by ``Attitude.rotated(rate * time)``; the body rate (3,) is in the sensor frame.
    """
    speed = length(rate_rad_s)
    axis = rate_rad_s / speed
    angles = -speed * times_s  # the sky turns in the opposite direction to the sensor
    along = product(vectors, axis)[:, None] * axis
    across = vectors - along
    cosine, sine = (elementwise(function, angles)[:, None] for function in (cos, sin))
    result: Array = along + cosine * across + sine * np.cross(axis, vectors)
    return result
