"""The frames of the thesis as input of a star identifier, on a flat or a spherical sky.

On the flat sky distances are those in the (α, δ) plane, which no rotation of a sphere preserves. The
published algorithms use unit vectors, so the plane is mapped to a tiny patch of the sphere and imaged by a
lens of such long focal length that a frame fills the same pixels. Curvature is then negligible.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, Literal

import numpy as np

from starid.arithmetic.arrays import Array
from starid.attitude import Attitude
from starid.camera import Camera
from starid.catalog import StarCatalog
from starid.identification.thesis.database import THESIS_KAPPA, DatabaseParameters, sky_of
from starid.identification.thesis.frame_sky import FrameSky
from starid.lab.experiments.experiment import planar_sky, star_catalog
from starid.lab.simulation import PIXEL_DEG, NoiseModel, add_noise

SkyName = Literal["flat", "sphere"]

STAMP: Final = 2e-5
"""Scale of the patch: radians on the sphere per degree of the flat plane."""

_SIDE_PX: Final = 937


@dataclass(frozen=True, eq=False)
class ThesisSky:
    """A sky with the stars of the thesis, and the camera and catalogue for it.

    Attributes
    ----------
    frames
        The stars from which frames are taken.
    camera, catalog
        Camera and catalogue for identifiers; magnitudes are Hp in both bands.
    """

    name: SkyName
    frames: FrameSky
    camera: Camera
    catalog: StarCatalog

    def limit_for(self, per_field: float) -> float:
        """Magnitude limit for a mean number of stars per frame; the faintest star's if there are fewer."""
        row = math.ceil(len(self.catalog) * per_field / self.stars_per_field)
        return float(self.catalog.v[min(row, len(self.catalog)) - 1])

    @property
    def stars_per_field(self) -> float:
        """Mean number of catalogue stars per frame."""
        share = (
            0.5 * (1.0 - math.cos(math.radians(20.0)))
            if self.name == "sphere"
            else math.pi * 400.0 / 64_800.0
        )
        return len(self.frames.stars) * share

    def observe(
        self, rng: np.random.Generator, ra_deg: float, dec_deg: float, noise: NoiseModel
    ) -> tuple[Array, Array]:
        """Positions (n, 2), pixels, and fluxes (n,), 1 at magnitude 0, of a frame with north up."""
        brightness, positions, _ = self.frames.stars_in_frame(ra_deg % 360.0, dec_deg)
        to_deg = PIXEL_DEG if self.name == "sphere" else 1.0
        magnitudes, positions, _ = add_noise(
            rng, brightness, positions * to_deg, noise, self.frames.half_width * to_deg
        )
        return positions / PIXEL_DEG + np.asarray(self.camera.centre_px), 10.0 ** (-0.4 * magnitudes)

    def boresight_deg(self, attitude: Attitude) -> tuple[float, float]:
        """Right ascension and declination, degrees, for an attitude on this sky."""
        if self.name == "sphere":
            return attitude.ra_deg, attitude.dec_deg
        x, y, z = attitude.boresight
        return float(x / z) / STAMP + 180.0, float(y / z) / STAMP


@lru_cache(maxsize=2)
def thesis_sky(name: SkyName) -> ThesisSky:
    """Make the sky of the published figures, flat as in the thesis, or with the same stars on the sphere."""
    catalog = star_catalog()
    faint = catalog.subset(catalog.hp >= THESIS_KAPPA)
    faint = dataclasses.replace(faint, v=faint.hp)
    faint = faint.subset(np.argsort(faint.v, kind="stable"))
    if name == "sphere":
        camera = Camera.from_fov(_SIDE_PX * PIXEL_DEG, _SIDE_PX, _SIDE_PX)
        parameters = DatabaseParameters.for_camera(
            camera, overlap=0.995, kappa=THESIS_KAPPA, direction="faintest", band="hp"
        )
        return ThesisSky(name, sky_of(catalog, parameters), camera, faint)
    focal = 1.0 / (PIXEL_DEG * STAMP)
    centre = 0.5 * (_SIDE_PX - 1)
    camera = Camera(_SIDE_PX, _SIDE_PX, (focal, focal), (centre, centre))
    return ThesisSky(name, planar_sky(), camera, _stamp(faint))


def _stamp(stars: StarCatalog) -> StarCatalog:
    """Map the flat plane to a small patch of the sphere; it does not wrap, as no frame crosses α = 0°."""
    ra, dec = np.degrees(stars.ra_rad), np.degrees(stars.dec_rad)
    vectors = np.column_stack([STAMP * (ra - 180.0), STAMP * dec, np.ones(len(stars))])
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    return dataclasses.replace(
        stars,
        vectors=vectors,
        ra_rad=np.arctan2(vectors[:, 1], vectors[:, 0]) % (2.0 * math.pi),
        dec_rad=np.arcsin(vectors[:, 2]),
    )
