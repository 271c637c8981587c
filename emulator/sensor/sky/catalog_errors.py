"""Differences between the unit's catalogue and the sky: each star is shown where the sky has it, not where the catalogue does.

Only the difference matters to a star tracker, so the catalogue, which is also that of the truth, stays as it is.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from starhil.emulator.sensor.sky.objects import CatalogError
from starid.arithmetic.arrays import Array, Indices32
from starid.arithmetic.elementary import cos, sin
from starid.arithmetic.matrices import lengths
from starid.attitude import ARCSEC_PER_RAD


def displaced(vectors: Array, east_arcsec: Array, north_arcsec: Array) -> Array:
    """Return directions (n, 3) turned by angles (n,) to the east and north of them, along a great circle."""
    across = lengths(vectors[:, :2])
    safe = np.maximum(across, 1e-12)
    east = np.column_stack([-vectors[:, 1], vectors[:, 0], np.zeros(len(vectors))]) / safe[:, None]
    east[across <= 1e-12] = (0.0, 1.0, 0.0)
    north = np.cross(vectors, east)
    offset = (east_arcsec[:, None] * east + north_arcsec[:, None] * north) / ARCSEC_PER_RAD
    angle = lengths(offset)
    ahead = np.array([cos(each) for each in angle.tolist()])
    share = np.array([sin(each) / each if each > 0.0 else 1.0 for each in angle.tolist()])
    return np.asarray(ahead[:, None] * vectors + share[:, None] * offset)


def as_in_the_sky(
    hip: Indices32,
    vectors: Array,
    position_error_arcsec: float,
    magnitude_error: float,
    single: Sequence[CatalogError],
    rng: np.random.Generator,
) -> tuple[Array, Array]:
    """Return where the sky shows stars (n, 3), and how much fainter (n,), magnitudes.

    `hip` (n,) and `vectors` (n, 3) are those of the catalogue, the errors standard deviations along each axis.
    """
    drawn = rng.normal(size=(len(hip), 3))
    east, north = position_error_arcsec * drawn[:, :2].T
    fainter = magnitude_error * drawn[:, 2]
    for star in single:
        rows = np.flatnonzero(hip == star.hip)
        east[rows] += star.east_arcsec
        north[rows] += star.north_arcsec
        fainter[rows] += star.fainter
    return displaced(vectors, east, north), fainter
