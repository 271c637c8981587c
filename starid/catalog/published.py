"""Bright stars that the Hipparcos new reduction lacks, or whose magnitude it has wrong."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from starid.arithmetic.arrays import Array
from starid.arithmetic.elementary import cos
from starid.catalog.hipparcos import EPOCH
from starid.catalog.photometry import v_from_hp

PUBLISHED_V: Final = {32349: -1.44, 30438: -0.74, 71681: 1.33, 55203: 3.79, 78727: 4.17}
"""Published V: Sirius and Canopus, which are too bright for Hipparcos; alpha Centauri B, whose Hp has light of A; and the missing
stars. From SIMBAD, for Canopus and alpha Centauri by Ducati (2002, CDS II/237)."""

_RAD_PER_MAS: Final = math.pi / (180.0 * 3600.0 * 1000.0)


@dataclass(frozen=True)
class _Star:
    """Position at J2000, ICRS, degrees; the other values as in `read_hip2`."""

    hip: int
    ra_deg: float
    dec_deg: float
    pm_ra_mas_yr: float
    pm_dec_mas_yr: float
    parallax_mas: float
    b_v: float


_MISSING: Final = (
    _Star(
        55203, 15.0 * (11 + 18 / 60 + 10.92 / 3600), 31 + 31 / 60 + 45.3 / 3600, -429.0, -587.0, 113.2, 0.59
    ),
    _Star(
        78727, 15.0 * (16 + 4 / 60 + 22.191 / 3600), -(11 + 22 / 60 + 22.60 / 3600), -63.2, -27.0, 35.9, 0.45
    ),
)
"""Xi Ursae Majoris and xi Scorpii, binaries for which Hipparcos found no solution, as single stars: SIMBAD; xi Scorpii by Roeser &
Bastian (1988), with the parallax of its companion D."""


def with_missing_stars(columns: dict[str, Array]) -> dict[str, Array]:
    """Append the missing stars to the columns of `read_hip2`, at their epoch, unless the file has them."""
    stars = [star for star in _MISSING if star.hip not in columns["hip"]]
    if not stars:
        return columns
    years = (EPOCH - 2000.0) * _RAD_PER_MAS
    added: dict[str, list[float]] = {
        "hip": [star.hip for star in stars],
        "ra_rad": [
            math.radians(s.ra_deg) + years * s.pm_ra_mas_yr / cos(math.radians(s.dec_deg)) for s in stars
        ],
        "dec_rad": [math.radians(star.dec_deg) + years * star.pm_dec_mas_yr for star in stars],
        "parallax_mas": [star.parallax_mas for star in stars],
        "pm_ra_mas_yr": [star.pm_ra_mas_yr for star in stars],
        "pm_dec_mas_yr": [star.pm_dec_mas_yr for star in stars],
        "hp": [PUBLISHED_V[star.hip] - float(v_from_hp(0.0, star.b_v, math.nan)) for star in stars],
        "b_v": [star.b_v for star in stars],
        "v_i": [math.nan for _ in stars],
    }
    return {
        name: np.concatenate([values, np.array(added[name], np.float64)]) for name, values in columns.items()
    }
