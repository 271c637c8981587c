"""Detections of a known sky for the tests of the identifier."""

from __future__ import annotations

import functools

import numpy as np

from starid.attitude import Attitude
from starid.camera import DEFAULT_CAMERA, Camera
from starid.catalog import load_catalog
from starid.identification.geometric.identifier import Identifier
from starid.identification.geometric.pattern_index import resolved_stars
from starid.identification.options import UNLIMITED_DEG
from starid.lab.leaderboard.scenes import Scene, SceneMaker, SceneSettings

WRONG_ARCSEC = 360.0


@functools.cache
def identifier() -> Identifier:
    """One without a limit on the error: the tests judge which stars these are, however well they give an attitude."""
    return Identifier(largest_error_deg=UNLIMITED_DEG)


@functools.cache
def maker() -> SceneMaker:
    camera = DEFAULT_CAMERA
    return SceneMaker(camera, resolved_stars(load_catalog(), 6.0, 2.0 * camera.pixel_scale_rad))


def scenes(settings: SceneSettings, count: int, seed: int) -> list[Scene]:
    rng = np.random.default_rng(seed)
    return [maker().scene(settings, rng) for _ in range(count)]


def sky(
    attitude: Attitude,
    seed: int = 1,
    *,
    camera: Camera = DEFAULT_CAMERA,
    limit: float = 5.5,
    sigma_px: float = 0.3,
    identified: Identifier | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions, flux and Hipparcos numbers of the stars in the field, brightest first."""
    rng = np.random.default_rng(seed)
    stars = (identified or identifier()).stars.brighter_than(limit)
    xy, inside = camera.project(attitude.to_sensor(stars.vectors))
    xy = xy[inside] + sigma_px * rng.standard_normal((int(inside.sum()), 2))
    magnitude = stars.v[inside] + 0.1 * rng.standard_normal(len(xy))
    return xy, 10.0 ** (-0.4 * (magnitude - 15.0)), stars.hip[inside]
