"""The stars of the rendered sky, where it differs from the unit's catalogue.

The catalogue stays as it is: it is also that of the truth, and only the difference matters to a star tracker. What the sky
shows differs by the errors of the catalogue (the same in all images), by variable stars (at a date), and by the observer
(parallax and aberration). Stars without light are among them: variable ones that come within the limit only at their maximum.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from starhil.emulator.sensor.model import SOLAR_COLOUR_B_V, SensorModel
from starhil.emulator.sensor.sky.ephemeris import Observer
from starhil.emulator.sensor.sky.objects import CatalogError, SkyObjects
from starid.arithmetic.arrays import Array, Indices, Indices32
from starid.arithmetic.elementary import cos, sin
from starid.arithmetic.matrices import lengths
from starid.attitude import ARCSEC_PER_RAD
from starid.catalog import StarCatalog
from starid.catalog.catalog import companions
from starid.catalog.photometry import flux_ratio
from starid.catalog.variable_stars import BRIGHTEST, HIP, variable_magnitudes

_COMPANION_RAD: Final = math.radians(1.0)
"""Largest distance of a companion: with coarser pixels it would take minutes to find them all."""
_COMPANION_PX: Final = 2.0
_CATALOG_STREAM: Final = 3
_STARS_PER_STREAM: Final = 1 << 17
"""HIP numbers whose errors one generator draws in order: all of Hipparcos."""


class SkyStars:
    """The stars of a catalogue that a sensor shows, brightest first.

    Stars fainter than the sensor's limiting magnitude are left out, except unresolved companions of brighter ones.
    """

    def __init__(self, catalog: StarCatalog, sensor: SensorModel, pixel_scale_rad: float, seed: int) -> None:
        colour = np.nan_to_num(catalog.b_v - SOLAR_COLOUR_B_V, nan=0.0)
        brightness = np.asarray(catalog.v - sensor.colour_term * colour, dtype=np.float64)
        limit = sensor.limiting_magnitude
        varying = np.flatnonzero(np.isin(catalog.hip, HIP[limit >= BRIGHTEST]))
        near = companions(catalog, limit, min(_COMPANION_PX * pixel_scale_rad, _COMPANION_RAD))
        rows = np.unique(np.concatenate([np.flatnonzero(catalog.v <= limit), near, varying]))
        self.rows: Indices = rows[np.argsort(brightness[rows], kind="stable")]
        """Their rows in the catalogue, (n,)."""
        self._hip = catalog.hip[self.rows]
        self._vectors = np.ascontiguousarray(catalog.vectors[self.rows])
        parallax_mas = np.maximum(np.nan_to_num(catalog.parallax_mas[self.rows]), 0.0)
        self._parallax_rad = np.radians(parallax_mas / 3.6e6)
        self._flux_e_s = sensor.zero_magnitude_e_s * flux_ratio(brightness[self.rows])
        self._seed = seed
        self._number = np.flatnonzero(np.isin(HIP, self._hip))
        """Numbers in `VARIABLE_STARS` of the variable stars (m,)."""
        self._varying = np.array(
            [np.flatnonzero(self._hip == each)[0] for each in HIP[self._number]], dtype=np.int64
        )
        """Which of the stars (m,) they are."""
        in_catalog = catalog.v[self.rows[self._varying]].astype(np.float64)
        self._in_catalog = in_catalog
        """Their V in the catalogue (m,)."""
        self._only_at_maximum = self._varying[(in_catalog > limit) & ~np.isin(self.rows[self._varying], near)]
        self._wrong: tuple[tuple[object, ...], Array, Array] = ((), self._vectors, np.ones(0))
        """Errors of the catalogue for which directions and relative light have been drawn."""

    def __len__(self) -> int:
        return len(self.rows)

    def shown(self, objects: SkyObjects | None, observer: Observer | None) -> tuple[Array, Array]:
        """Return directions (n, 3) as from the barycentre, and electrons/s (n,), of the stars in a sky, at a date."""
        vectors, flux_e_s = self._against_catalog(objects)
        if not self._varying.size:
            return vectors, flux_e_s
        flux_e_s = flux_e_s.copy()
        if observer is None:
            flux_e_s[self._only_at_maximum] = 0.0
        else:
            fainter = variable_magnitudes(observer.unix_s)[self._number] - self._in_catalog
            flux_e_s[self._varying] *= flux_ratio(fainter)
        return vectors, flux_e_s

    def apparent(self, vectors: Array, near: Indices, observer: Observer | None) -> Array:
        """Return where an observer sees the stars `near` (k,), which are in directions (n, 3) as from the barycentre."""
        seen = vectors[near]
        return seen if observer is None else observer.apparent_stars(seen, self._parallax_rad[near])

    def _against_catalog(self, objects: SkyObjects | None) -> tuple[Array, Array]:
        """Return directions (n, 3) and electrons/s (n,) that differ from the catalogue's by its errors."""
        if objects is None:
            return self._vectors, self._flux_e_s
        errors = (
            objects.catalog_position_error_arcsec,
            objects.catalog_magnitude_error,
            objects.catalog_errors,
        )
        if not any(errors):
            return self._vectors, self._flux_e_s
        if self._wrong[0] != errors:
            drawn = _drawn(self._hip, self._seed)
            vectors, fainter = _with_errors(self._hip, self._vectors, *errors, drawn)
            self._wrong = errors, vectors, flux_ratio(fainter)
        return self._wrong[1], self._flux_e_s * self._wrong[2]


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


def _drawn(hip: Indices32, seed: int) -> Array:
    """Normal numbers (n, 3) of stars, which depend on their own HIP numbers alone: another star changes nothing for the others."""
    drawn = np.empty((len(hip), 3))
    block, row = np.divmod(hip, _STARS_PER_STREAM)
    for each in np.unique(block).tolist():
        rng = np.random.default_rng((seed, _CATALOG_STREAM, each))
        drawn[block == each] = rng.normal(size=(_STARS_PER_STREAM, 3))[row[block == each]]
    return drawn


def _with_errors(
    hip: Indices32,
    vectors: Array,
    position_error_arcsec: float,
    magnitude_error: float,
    single: Sequence[CatalogError],
    drawn: Array,
) -> tuple[Array, Array]:
    """Return where the sky shows stars (n, 3), and how much fainter (n,), magnitudes.

    `hip` (n,) and `vectors` (n, 3) are those of the catalogue, the errors standard deviations along each axis, by which the normal
    numbers in `drawn` (n, 3) are multiplied.
    """
    east, north = position_error_arcsec * drawn[:, :2].T
    fainter = magnitude_error * drawn[:, 2]
    for star in single:
        rows = np.flatnonzero(hip == star.hip)
        east[rows] += star.east_arcsec
        north[rows] += star.north_arcsec
        fainter[rows] += star.fainter
    return displaced(vectors, east, north), fainter
