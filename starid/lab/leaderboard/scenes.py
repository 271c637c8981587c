"""Benchmark scenes: simulated detections, without rendering images.

A scene is a random attitude with the catalogue stars in the field, whose positions and magnitudes are noisy,
false stars and missing stars. As in the published comparison of solvers, magnitude noise is 0.1, false stars
have uniform positions and magnitudes drawn from the 20 brightest stars in the field, missing stars are drawn from
these 20, and double stars within 2 px are merged.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from starid.attitude import Attitude, random_attitude
from starid.camera import Camera
from starid.catalog import StarCatalog

BRIGHTEST: Final = 20
"""Number of brightest stars from which false magnitudes and missing stars are drawn."""

MAX_DRAWS: Final = 1000
"""Maximum number of attitudes drawn for one scene."""


@dataclass(frozen=True)
class SceneSettings:
    """Parameters of a scene.

    Attributes
    ----------
    limiting_magnitude : float
        V of the faintest visible stars.
    sigma_px : float
        Position noise per axis, pixels.
    false_stars, missing_stars : int
        Number of stars added and removed.
    magnitude_noise : float
        One sigma, magnitudes.
    random_points : (least, most) or None
        Instead of stars, this many points at uniform positions with magnitudes of the field's stars.
    covered : float
        Fraction of the field without stars, behind a straight edge of random direction.
    cluttered : float
        Fraction of the field, behind such an edge, that contains all false stars.
    kept : int or None
        Number of brightest stars that are visible; None: all.
    least_stars : int
        Minimum number of stars in the field; attitudes are drawn until it is reached (at most `MAX_DRAWS`).
    mirrored : bool
        Whether the image is mirrored: as dense and clustered as the sky, but different everywhere.
    field_deg, side_px
        Width of the field and side of the image, if they differ from the given camera's.
    predicted_px : float
        Error of the predicted attitude passed to a tracking solver, one sigma about each axis, in pixels at
        the centre of the field; 0: no prediction.
    """

    limiting_magnitude: float = 5.5
    sigma_px: float = 0.5
    false_stars: int = 0
    missing_stars: int = 0
    magnitude_noise: float = 0.1
    random_points: Sequence[int] | None = None
    covered: float = 0.0
    cluttered: float = 1.0
    kept: int | None = None
    least_stars: int = 0
    mirrored: bool = False
    field_deg: float | None = None
    side_px: int | None = None
    predicted_px: float = 0.0

    @property
    def sky(self) -> bool:
        """Whether there is an attitude to find: at least two true stars, and not mirrored."""
        few = self.kept is not None and self.kept < 2
        return self.random_points is None and not self.mirrored and not few


def read_scenes() -> dict[str, dict[str, SceneSettings]]:
    """Read `scenes.toml`: group → name → settings."""
    text = Path(__file__).with_name("scenes.toml").read_text(encoding="utf-8")
    return {
        group: {name: SceneSettings(**values) for name, values in members.items()}
        for group, members in tomllib.loads(text).items()
    }


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
        Catalogue row of the star, −1 for false stars.
    sigma_px : float
        Position noise of the stars per axis, pixels.
    """

    attitude: Attitude
    xy_px: NDArray[np.float64]
    flux: NDArray[np.float64]
    star: NDArray[np.int64]
    sigma_px: float


class SceneMaker:
    """Makes scenes for a camera and a catalogue.

    Parameters
    ----------
    camera : Camera
        The camera.
    stars : StarCatalog
        Visible stars with doubles merged, brightest first.
    """

    def __init__(self, camera: Camera, stars: StarCatalog) -> None:
        self.camera = camera
        self.stars = stars

    def scene(self, settings: SceneSettings, rng: np.random.Generator) -> Scene:
        """Make one scene; the generator is the only source of randomness."""
        visible = np.flatnonzero(self.stars.v <= settings.limiting_magnitude)
        for _ in range(MAX_DRAWS):
            attitude = random_attitude(rng)
            rows, xy = self._field(visible, attitude)
            if len(rows) >= settings.least_stars:
                break
        rows, xy = rows[: settings.kept], xy[: settings.kept]
        if settings.mirrored:
            xy[:, 0] = self.camera.width - 1.0 - xy[:, 0]
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
        pool = magnitudes[:BRIGHTEST]
        false = rng.choice(pool, settings.false_stars) if pool.size else np.empty(0)
        victims = rng.choice(pool.size, min(settings.missing_stars, pool.size), replace=False)
        rows, xy = np.delete(rows, victims), np.delete(xy, victims, axis=0)
        magnitudes = np.delete(magnitudes, victims)
        xy = xy + settings.sigma_px * rng.standard_normal(xy.shape)
        xy = np.concatenate([xy, self._clutter(false.size, settings.cluttered, rng)])
        star = np.concatenate([rows, np.full(false.size, -1)])
        return self._shuffled(attitude, xy, np.concatenate([magnitudes, false]), star, settings, rng)

    def _field(
        self, visible: NDArray[np.int64], attitude: Attitude
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return the rows of the catalogue in the field, and their positions."""
        boresight, radius = attitude.boresight, self.camera.field_radius_rad
        near = visible[self.stars.vectors[visible] @ boresight > math.cos(radius)]
        xy, inside = self.camera.project(attitude.to_sensor(self.stars.vectors[near]))
        return near[inside], xy[inside]

    def _uniform(self, count: int, rng: np.random.Generator) -> NDArray[np.float64]:
        return rng.random((count, 2)) * [self.camera.width, self.camera.height] - 0.5

    def _clutter(self, count: int, share: float, rng: np.random.Generator) -> NDArray[np.float64]:
        """Return uniform positions in a fraction of the field behind a straight edge of random direction."""
        if share >= 1.0:
            return self._uniform(count, rng)
        xy = self._uniform(int(2.0 * count / share) + 64, rng)
        return xy[~self._uncovered(xy, share, rng)][:count]

    def _uncovered(
        self, xy: NDArray[np.float64], share: float, rng: np.random.Generator
    ) -> NDArray[np.bool_]:
        """Return a mask of the positions not covered by an edge over a fraction of the field."""
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
        flux = 10.0 ** (-0.4 * noisy)
        return Scene(attitude, xy[order], flux, star[order].astype(np.int64), settings.sigma_px)
