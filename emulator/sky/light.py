"""Light and shadow over areas of an image: Sun, Moon, Earth and obstructions."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
import numpy.typing as npt

from starhil.emulator.sky.objects import EarthLimb, Moon, Obstruction, SkyObjects, SunGlare
from starid.attitude import Attitude
from starid.camera import Camera
from starid.jit import compiled_ieee

Image = npt.NDArray[np.float32]

_GLARE_FROM_DEG: Final = 0.3
_GLARE_TO_DEG: Final = 30.0
_SUN_REFERENCE_DEG: Final = 30.0
_SUN_SOFT_DEG: Final = 3.0


@dataclass(frozen=True)
class AreaLight:
    """Light of extended objects, and the fraction of the sky's light that passes them.

    Attributes
    ----------
    electrons_s : ndarray (h, w), float32
        Electrons/s in a pixel of mean sensitivity.
    transmission : ndarray (h, w), float32
        Fraction of the light from behind that is visible, 0…1.
    """

    electrons_s: Image
    transmission: Image

    def seen_at(self, xy_px: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Return the transmission (n,) of the pixels nearest to positions (n, 2)."""
        height, width = self.transmission.shape
        columns = np.clip(np.rint(xy_px[:, 0]), 0, width - 1).astype(np.int64)
        rows = np.clip(np.rint(xy_px[:, 1]), 0, height - 1).astype(np.int64)
        return self.transmission[rows, columns].astype(np.float64)


def icrs_vector(ra_deg: float, dec_deg: float) -> npt.NDArray[np.float64]:
    """Unit vector (3,) of a direction."""
    ra, dec = math.radians(ra_deg), math.radians(dec_deg)
    return np.array([math.cos(dec) * math.cos(ra), math.cos(dec) * math.sin(ra), math.sin(dec)])


@compiled_ieee
def _add_glare(
    image: Image,
    directions: Image,
    source: npt.NDArray[np.float32],
    strength: float,
    soft2: float,
    cube: bool,
) -> None:
    """Add strength/(chord² + soft²), or its power 3/2, over the angle (as chord) between pixels and a source."""
    a, b, c = source[0], source[1], source[2]
    factor, soft = np.float32(strength), np.float32(soft2)
    for y in range(image.shape[0]):
        row = image[y]
        dx, dy, dz = directions[0, y], directions[1, y], directions[2, y]
        for x in range(row.size):
            u, v, w = dx[x] - a, dy[x] - b, dz[x] - c
            chord2 = u * u + v * v + w * w + soft
            row[x] += factor / (chord2 * np.sqrt(chord2) if cube else chord2)


class AreaPainter:
    """Paints the extended objects of a sky for one camera; caches the directions of its pixels.

    Parameters
    ----------
    camera : Camera
        Directions of the pixels.
    zero_magnitude_e_s : float
        Electrons/s from a source of magnitude 0.
    psf_sigma_px : float
        Standard deviation of the spot that blurs edges, pixels.
    """

    def __init__(self, camera: Camera, zero_magnitude_e_s: float, psf_sigma_px: float) -> None:
        self._camera = camera
        self._zero_magnitude_e_s = zero_magnitude_e_s
        self._psf_sigma_px = psf_sigma_px

    @cached_property
    def _directions(self) -> Image:
        """Unit vectors (3, h, w) of the pixels, sensor frame; −z for pixels without a direction."""
        camera = self._camera
        rows, columns = np.mgrid[0 : camera.height, 0 : camera.width]
        vectors = camera.back_project(np.column_stack([columns.ravel(), rows.ravel()]).astype(np.float64))
        vectors[np.isnan(vectors).any(axis=1)] = (0.0, 0.0, -1.0)
        return np.ascontiguousarray(vectors.T.reshape(3, camera.height, camera.width), dtype=np.float32)

    def paint(self, objects: SkyObjects, attitude: Attitude) -> AreaLight:
        """Return light and transmission of all extended objects at one attitude."""
        shape = (self._camera.height, self._camera.width)
        light = AreaLight(np.zeros(shape, dtype=np.float32), np.ones(shape, dtype=np.float32))
        if objects.sun is not None:
            self._paint_sun(light, objects.sun, attitude)
        if objects.moon is not None:
            self._paint_moon(light, objects.moon, attitude)
        if objects.earth is not None:
            self._paint_earth(light, objects.earth, attitude)
        for obstruction in objects.obstructions:
            transmission = self._obstruction_transmission(obstruction)
            light.electrons_s[:] *= transmission
            light.transmission[:] *= transmission
        if objects.blank:
            light.electrons_s[:] = 0.0
            light.transmission[:] = 0.0
        return light

    def _paint_sun(self, light: AreaLight, sun: SunGlare, attitude: Attitude) -> None:
        """Add stray light of the Sun, which falls with the cube of the angle."""
        source = attitude.to_sensor(icrs_vector(sun.ra_deg, sun.dec_deg)).astype(np.float32)
        reference = 2.0 * math.sin(math.radians(_SUN_REFERENCE_DEG) / 2.0)
        soft = 2.0 * math.sin(math.radians(_SUN_SOFT_DEG) / 2.0)
        _add_glare(light.electrons_s, self._directions, source, sun.electrons_s * reference**3, soft**2, True)  # noqa: FBT003

    def _paint_moon(self, light: AreaLight, moon: Moon, attitude: Attitude) -> None:
        """Add the Moon's glare over the field, and its disc with the terminator."""
        import cv2

        centre = icrs_vector(moon.ra_deg, moon.dec_deg)
        source = attitude.to_sensor(centre)
        radius = math.radians(moon.diameter_deg) / 2.0
        total = self._zero_magnitude_e_s * math.pow(10.0, -0.4 * moon.magnitude)
        pixel = self._camera.pixel_scale_rad**2
        share = moon.glare_share / (2.0 * math.pi * math.log(_GLARE_TO_DEG / _GLARE_FROM_DEG))
        soft2 = math.radians(_GLARE_FROM_DEG) ** 2
        _add_glare(
            light.electrons_s,
            self._directions,
            source.astype(np.float32),
            total * share * pixel,
            soft2,
            False,  # noqa: FBT003
        )
        xy, _ = self._camera.project(source[None, :])
        reach = 2.0 * radius / self._camera.pixel_scale_rad + 8.0
        box = self._box(xy[0], reach)
        if box is None:
            return
        # position on the disc in units of its radius, towards the bright limb and across
        ra, dec, angle = (math.radians(value) for value in (moon.ra_deg, moon.dec_deg, moon.bright_limb_deg))
        north = np.array([-math.sin(dec) * math.cos(ra), -math.sin(dec) * math.sin(ra), math.cos(dec)])
        east = np.array([-math.sin(ra), math.cos(ra), 0.0])
        towards = attitude.to_sensor(math.cos(angle) * north + math.sin(angle) * east) / radius
        across = attitude.to_sensor(math.cos(angle) * east - math.sin(angle) * north) / radius
        directions = self._directions[(slice(None), *box)]
        u = np.tensordot(towards, directions, axes=1)
        v = np.tensordot(across, directions, axes=1)
        before = np.tensordot(source, directions, axes=1) > 0.0
        scale = radius / self._camera.pixel_scale_rad
        inside = np.clip(0.5 + (1.0 - np.hypot(u, v)) * scale, 0.0, 1.0) * before
        edge = (1.0 - 2.0 * moon.illuminated) * np.sqrt(np.clip(1.0 - v * v, 0.0, 1.0))
        lit = inside * np.clip(0.5 + (u - edge) * scale, 0.0, 1.0)
        area = max(math.pi * scale**2 * moon.illuminated, 1.0)
        disc = (lit * (total / area)).astype(np.float32)
        light.electrons_s[box] += cv2.GaussianBlur(disc, (0, 0), self._psf_sigma_px)
        light.transmission[box] *= (1.0 - inside).astype(np.float32)

    def _box(self, xy: npt.NDArray[np.float64], reach: float) -> tuple[slice, slice] | None:
        """Return the slices of the image within `reach` pixels of a position; None if outside."""
        if not np.all(np.isfinite(xy)):
            return None
        left, right = max(math.floor(xy[0] - reach), 0), min(math.ceil(xy[0] + reach) + 1, self._camera.width)
        top, bottom = (
            max(math.floor(xy[1] - reach), 0),
            min(math.ceil(xy[1] + reach) + 1, self._camera.height),
        )
        return (slice(top, bottom), slice(left, right)) if left < right and top < bottom else None

    def _paint_earth(self, light: AreaLight, earth: EarthLimb, attitude: Attitude) -> None:
        """Add the Earth's disc, fading over the atmosphere; it hides everything behind it."""
        import cv2

        source = attitude.to_sensor(icrs_vector(earth.ra_deg, earth.dec_deg)).astype(np.float32)
        cosine = np.clip(np.tensordot(source, self._directions, axes=1), -1.0, 1.0)
        above_deg = np.degrees(np.arccos(cosine)) - np.float32(earth.radius_deg)
        face = np.clip(-above_deg / np.float32(earth.atmosphere_deg) + 1.0, 0.0, 1.0)
        glow = np.exp(-np.maximum(above_deg, 0.0) / np.float32(earth.atmosphere_deg))
        shine = np.float32(earth.electrons_s) * np.where(above_deg < 0.0, np.float32(1.0), glow)
        shine[above_deg > 20.0 * earth.atmosphere_deg] = 0.0
        blurred = cv2.GaussianBlur(shine.astype(np.float32), (0, 0), self._psf_sigma_px)
        light.electrons_s[:] = light.electrons_s * (1.0 - face) + blurred
        light.transmission[:] *= (1.0 - face).astype(np.float32)

    def _obstruction_transmission(self, obstruction: Obstruction) -> Image:
        """Return the transmission (h, w) of an obstruction."""
        import cv2

        height, width = self._camera.height, self._camera.width
        if obstruction.polygon_px:
            cover = np.ones((height, width), dtype=np.float32)
            corners = np.round(np.array(obstruction.polygon_px) * 16.0).astype(np.int32)
            cv2.fillPoly(cover, [corners], 0.0, cv2.LINE_8, 4)
        else:
            angle = math.radians(obstruction.angle_deg)
            x, y = np.arange(width) - 0.5 * (width - 1), np.arange(height) - 0.5 * (height - 1)
            along = (math.cos(angle) * x)[None, :] + (math.sin(angle) * y)[:, None]
            edge = np.quantile(along, 1.0 - obstruction.share)
            cover = (along <= edge if obstruction.share > 0.0 else np.ones_like(along)).astype(np.float32)
        if obstruction.softness_px <= 0.0:
            return cover
        soft = cv2.GaussianBlur(cover, (0, 0), obstruction.softness_px, borderType=cv2.BORDER_REPLICATE)
        return np.asarray(soft, dtype=np.float32)
