"""Light and shadow over areas of an image: Sun, Moon, Earth and obstructions."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
import numpy.typing as npt

from starhil.emulator.sky.directions import icrs_vector
from starhil.emulator.sky.objects import EarthLimb, Moon, Obstruction, SkyObjects, SunGlare
from starid.attitude import Attitude
from starid.camera import Camera
from starid.jit import compiled_ieee

Image = npt.NDArray[np.float32]

_GLARE_FROM_DEG: Final = 0.3
_GLARE_TO_DEG: Final = 30.0
_SUN_REFERENCE_DEG: Final = 30.0
_SUN_SOFT_DEG: Final = 3.0

_FLOOD_E_S: Final = 1e9
"""Electrons/s in every pixel when light passes the baffle: saturates any exposure of a millisecond."""

_GLOW_HEIGHTS: Final = 20.0
"""Heights of the atmosphere above the limb up to which it glows."""


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


def baffle_passed(objects: SkyObjects, attitude: Attitude) -> bool:
    """Whether the Sun or the lit Earth is within its exclusion angle, so that its light saturates the image."""
    sun, earth = objects.sun, objects.earth
    if sun is not None and _off_axis_deg(attitude, sun) < sun.exclusion_deg:
        return True
    if earth is None or earth.exclusion_deg == 0.0:
        return False
    off_axis = _off_axis_deg(attitude, earth)
    near_deg = min(off_axis, earth.radius_deg)
    return off_axis - near_deg < earth.exclusion_deg and _is_lit(earth, attitude.boresight, near_deg)


def _is_lit(earth: EarthLimb, towards: npt.NDArray[np.float64], off_nadir_deg: float) -> bool:
    """Whether the Sun shines on the point of the Earth seen at an angle from its centre towards a direction."""
    sun = _sun_of(earth)
    if sun is None:
        return True
    nadir = icrs_vector(earth.ra_deg, earth.dec_deg)
    sideways = towards - float(towards @ nadir) * nadir
    sideways /= max(float(np.linalg.norm(sideways)), 1e-12)
    angle, distance = math.radians(off_nadir_deg), 1.0 / math.sin(math.radians(earth.radius_deg))
    line = math.cos(angle) * nadir + math.sin(angle) * sideways
    under = max(1.0 - (distance * math.sin(angle)) ** 2, 0.0)
    normal = (distance * math.cos(angle) - math.sqrt(under)) * line - distance * nadir
    return float(normal @ sun) > 0.0


def _sun_of(earth: EarthLimb) -> npt.NDArray[np.float64] | None:
    """Return the direction (3,) of the Sun that lights the Earth; None if all of the disc is lit."""
    if earth.sun_ra_deg is None or earth.sun_dec_deg is None:
        return None
    return icrs_vector(earth.sun_ra_deg, earth.sun_dec_deg)


def _off_axis_deg(attitude: Attitude, body: SunGlare | Moon | EarthLimb) -> float:
    """Angle of a body's centre from the boresight, degrees."""
    place, boresight = icrs_vector(body.ra_deg, body.dec_deg), attitude.boresight
    chord = float(np.linalg.norm(place - boresight))
    return math.degrees(2.0 * math.asin(min(0.5 * chord, 1.0)))


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


@compiled_ieee
def _earth_face(
    shine: Image,
    clear: Image,
    directions: Image,
    nadir: npt.NDArray[np.float64],
    sun: npt.NDArray[np.float64],
    radius: float,
    atmosphere: float,
) -> None:
    """Fill in the Earth's brightness, 1 where the Sun is in the zenith, and the transmission of its edge.

    Parameters
    ----------
    shine, clear : ndarray (h, w), float32
        Filled: brightness, and fraction of the sky's light that passes.
    directions : ndarray (3, h, w), float32
        Of the pixels, sensor frame.
    nadir, sun : ndarray (3,)
        To the Earth's centre and to the Sun, sensor frame; zeros instead of the Sun light all of the disc.
    radius, atmosphere : float
        Angular radius of the disc and height over which its limb fades, radians.
    """
    n0, n1, n2 = nadir[0], nadir[1], nadir[2]
    s0, s1, s2 = sun[0], sun[1], sun[2]
    all_lit = s0 == 0.0 and s1 == 0.0 and s2 == 0.0
    distance = 1.0 / math.sin(radius)
    behind = -distance * (n0 * s0 + n1 * s1 + n2 * s2)
    inner, outer = math.cos(radius), math.cos(min(radius + _GLOW_HEIGHTS * atmosphere, math.pi))
    for y in range(shine.shape[0]):
        dx, dy, dz = directions[0, y], directions[1, y], directions[2, y]
        for x in range(shine.shape[1]):
            u, v, w = float(dx[x]), float(dy[x]), float(dz[x])
            cosine = n0 * u + n1 * v + n2 * w
            if cosine < outer:
                shine[y, x], clear[y, x] = 0.0, 1.0
                continue
            light, passed = 1.0, 0.0
            if cosine < inner:
                height = (math.acos(max(cosine, -1.0)) - radius) / atmosphere
                light, passed = math.exp(-height), min(height, 1.0)
            if not all_lit:
                # cosine of the Sun's zenith distance where the line of sight meets a sphere of radius 1
                under = max(1.0 - distance * distance * (1.0 - cosine * cosine), 0.0)
                along = distance * cosine - math.sqrt(under)
                light *= min(max(behind + along * (s0 * u + s1 * v + s2 * w), 0.0), 1.0)
            shine[y, x], clear[y, x] = light, passed


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
        sun, moon, earth = objects.sun, objects.moon, objects.earth
        if sun is not None and _off_axis_deg(attitude, sun) <= sun.reach_deg:
            self._paint_sun(light, sun, attitude)
        if moon is not None and _off_axis_deg(attitude, moon) <= moon.reach_deg:
            self._paint_moon(light, moon, attitude)
        if earth is not None and self._earth_in_field(earth, attitude):
            self._paint_earth(light, earth, attitude)
        if baffle_passed(objects, attitude):
            light.electrons_s[:] += np.float32(_FLOOD_E_S)
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

        shape = light.electrons_s.shape
        shine, clear = np.empty(shape, dtype=np.float32), np.empty(shape, dtype=np.float32)
        sun = _sun_of(earth)
        _earth_face(
            shine,
            clear,
            self._directions,
            attitude.to_sensor(icrs_vector(earth.ra_deg, earth.dec_deg)),
            np.zeros(3) if sun is None else attitude.to_sensor(sun),
            math.radians(earth.radius_deg),
            math.radians(earth.atmosphere_deg),
        )
        shine *= np.float32(earth.electrons_s)
        blurred = cv2.GaussianBlur(shine, (0, 0), self._psf_sigma_px)
        np.multiply(light.electrons_s, clear, out=light.electrons_s)
        light.electrons_s[:] += blurred
        light.transmission[:] *= clear

    def _earth_in_field(self, earth: EarthLimb, attitude: Attitude) -> bool:
        """Whether the Earth or the glow of its limb reaches into the field."""
        reach_deg = earth.radius_deg + _GLOW_HEIGHTS * earth.atmosphere_deg
        return _off_axis_deg(attitude, earth) <= reach_deg + math.degrees(self._camera.field_radius_rad) + 1.0

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
