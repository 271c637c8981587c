"""Skies that are hard to identify: bright bodies, glare, planets, and more false stars than true ones."""

from __future__ import annotations

from typing import Final

import numpy as np

from starhil.emulator.sensor.model import SensorModel
from starhil.emulator.sensor.sky.objects import Moon, PointSource, SkyObjects, SunGlare
from starid.arithmetic.arrays import Array
from starid.attitude import Attitude

HARD_SENSOR: Final = SensorModel(limiting_magnitude=4.8, hot_pixels=500)
"""A sensor that sees about 50 stars in 42°, with many hot pixels."""

FASTEST_DEG_S: Final = 2.0
"""Largest body rate in a hard sky; rates are uniformly distributed."""

_FALSE_STARS: Final = 100
_FALSE_STAR_MAGNITUDES: Final = (1.0, 4.8)
_PLANETS: Final = 3
_PLANET_MAGNITUDES: Final = (-4.0, 1.5)
_RADIUS_DEG: Final = 20.0
_SUN_AWAY_DEG: Final = (30.0, 80.0)
_SUN_STRAY_SHARE: Final = (1e-6, 3e-5)
_COSMIC_RAYS_S: Final = 50.0


def hard_sky(attitude: Attitude, rng: np.random.Generator) -> SkyObjects:
    """Make a hard sky around an attitude: 100 false stars, 3 planets, particles, and the Moon in the field or glare of the Sun."""
    planets = tuple(
        PointSource(
            *direction_around(attitude, (0.0, _RADIUS_DEG), rng), float(rng.uniform(*_PLANET_MAGNITUDES))
        )
        for _ in range(_PLANETS)
    )
    moon, sun = None, None
    if rng.random() < 0.5:
        moon = Moon(
            *direction_around(attitude, (0.0, _RADIUS_DEG), rng),
            illuminated=float(rng.uniform()),
            bright_limb_deg=float(rng.uniform(0.0, 360.0)),
        )
    else:
        sun = SunGlare(*direction_around(attitude, _SUN_AWAY_DEG, rng), float(rng.uniform(*_SUN_STRAY_SHARE)))
    return SkyObjects(
        moon=moon,
        sun=sun,
        planets=planets,
        false_stars=_FALSE_STARS,
        false_star_magnitudes=_FALSE_STAR_MAGNITUDES,
        cosmic_rays_s=_COSMIC_RAYS_S,
    )


def direction_around(
    attitude: Attitude, away_deg: tuple[float, float], rng: np.random.Generator
) -> tuple[float, float]:
    """Draw a direction (RA, Dec in degrees) uniformly from a ring around the boresight."""
    low, high = np.cos(np.deg2rad(away_deg))
    cosine, angle = rng.uniform(high, low), rng.uniform(0.0, 2.0 * np.pi)
    sine = np.sqrt(1.0 - cosine * cosine)
    seen: Array = np.array([sine * np.cos(angle), sine * np.sin(angle), cosine])
    x, y, z = attitude.matrix.T @ seen
    return float(np.rad2deg(np.arctan2(y, x)) % 360.0), float(np.rad2deg(np.arcsin(np.clip(z, -1.0, 1.0))))
