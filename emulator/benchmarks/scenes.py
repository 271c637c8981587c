"""Benchmark scenes: what a sensor's detector would hand over, without the detour by pixels.

A scene is a random attitude, the catalogue stars in the field with noisy positions and magnitudes, false
stars and missing ones. The recipe is that of the published comparison of identification programs: magnitude
noise 0.1, false stars at uniform positions with magnitudes drawn from the 20 brightest in the field, missing
ones drawn from the same, doubles within 2 px seen as one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from starid.attitude import Attitude, random_attitude
from starid.camera import Camera
from starid.catalog import StarCatalog


@dataclass(frozen=True)
class SceneSettings:
    """Recipe of a scene.

    Attributes
    ----------
    limiting_magnitude : float
        Faintest V that the sensor sees.
    sigma_px : float
        Noise of a position per axis, pixels.
    false_stars, missing_stars : int
        How many are added, and taken away.
    magnitude_noise : float
        One sigma, magnitudes.
    brightest : int
        Rank down to which magnitudes of false stars and victims are drawn.
    random_points : tuple (least, most) or None
        Instead of stars, that many points at uniform positions with magnitudes of the field's stars.
    covered : float
        Share of the field behind a straight edge of random direction, in which no star is seen.
    cluttered : float
        Share of the field behind such an edge to which the false stars keep.
    kept : int or None
        Only so many of the brightest stars are seen.
    """

    limiting_magnitude: float = 5.5
    sigma_px: float = 0.5
    false_stars: int = 0
    missing_stars: int = 0
    magnitude_noise: float = 0.1
    brightest: int = 20
    random_points: tuple[int, int] | None = None
    covered: float = 0.0
    cluttered: float = 1.0
    kept: int | None = None


@dataclass(frozen=True)
class Scene:
    """Detections with their truth, in random order.

    Attributes
    ----------
    attitude : Attitude
        True attitude.
    xy_px : ndarray (n, 2)
        Positions.
    flux : ndarray (n,)
        Brightness, 1 at magnitude 0.
    star : ndarray (n,) int64
        Row of the star in the catalogue that the scene was made from, −1 for false ones.
    """

    attitude: Attitude
    xy_px: NDArray[np.float64]
    flux: NDArray[np.float64]
    star: NDArray[np.int64]


class SceneMaker:
    """Makes scenes of one camera under one sky.

    Parameters
    ----------
    camera : Camera
        The camera.
    stars : StarCatalog
        Stars as seen, doubles merged, brightest first.
    """

    def __init__(self, camera: Camera, stars: StarCatalog) -> None:
        self.camera = camera
        self.stars = stars

    def scene(self, settings: SceneSettings, rng: np.random.Generator) -> Scene:
        """One scene; the generator is the only source of chance."""
        attitude = random_attitude(rng)
        visible = np.flatnonzero(self.stars.v <= settings.limiting_magnitude)
        near = visible[
            self.stars.vectors[visible] @ attitude.boresight > math.cos(self.camera.field_radius_rad)
        ]
        xy, inside = self.camera.project(attitude.to_sensor(self.stars.vectors[near]))
        rows, xy = near[inside][: settings.kept], xy[inside][: settings.kept]
        magnitudes = self.stars.v[rows]
        if settings.random_points is not None:
            count = int(rng.integers(settings.random_points[0], settings.random_points[1] + 1))
            drawn = rng.choice(magnitudes, count) if magnitudes.size else np.zeros(count)
            return self._shuffled(
                attitude, self._uniform(count, rng), drawn, np.full(count, -1), settings, rng
            )
        if settings.covered > 0.0:
            seen = self._uncovered(xy, settings.covered, rng)
            rows, xy, magnitudes = rows[seen], xy[seen], magnitudes[seen]
        pool = magnitudes[: settings.brightest]
        false = rng.choice(pool, settings.false_stars) if pool.size else np.empty(0)
        victims = rng.choice(pool.size, min(settings.missing_stars, pool.size), replace=False)
        rows, xy = np.delete(rows, victims), np.delete(xy, victims, axis=0)
        magnitudes = np.delete(magnitudes, victims)
        xy = xy + settings.sigma_px * rng.standard_normal(xy.shape)
        xy = np.concatenate([xy, self._clutter(false.size, settings.cluttered, rng)])
        star = np.concatenate([rows, np.full(false.size, -1)])
        return self._shuffled(attitude, xy, np.concatenate([magnitudes, false]), star, settings, rng)

    def _uniform(self, count: int, rng: np.random.Generator) -> NDArray[np.float64]:
        return rng.random((count, 2)) * [self.camera.width, self.camera.height] - 0.5

    def _clutter(self, count: int, share: float, rng: np.random.Generator) -> NDArray[np.float64]:
        """Uniform positions in a share of the field behind a straight edge of random direction."""
        if share >= 1.0:
            return self._uniform(count, rng)
        places = self._uniform(int(2.0 * count / share) + 64, rng)
        return places[~self._uncovered(places, share, rng)][:count]

    def _uncovered(
        self, xy: NDArray[np.float64], share: float, rng: np.random.Generator
    ) -> NDArray[np.bool_]:
        """Mask of the positions on the open side of an edge that covers a share of the field."""
        angle = rng.random() * 2.0 * math.pi
        normal = np.array([math.cos(angle), math.sin(angle)])
        border = np.quantile(self._uniform(4096, rng) @ normal, share)
        mask: NDArray[np.bool_] = xy @ normal > border
        return mask

    @staticmethod
    def _shuffled(
        attitude: Attitude,
        xy: NDArray[np.float64],
        magnitudes: NDArray[np.float64],
        star: NDArray[np.int64],
        settings: SceneSettings,
        rng: np.random.Generator,
    ) -> Scene:
        order = rng.permutation(magnitudes.size)
        noisy = magnitudes[order] + settings.magnitude_noise * rng.standard_normal(magnitudes.size)
        return Scene(attitude, xy[order], 10.0 ** (-0.4 * noisy), star[order].astype(np.int64))
