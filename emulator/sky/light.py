"""Light and shadow over areas of an image: Sun, Moon, Earth and obstructions."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Final, TypeAlias

import numpy as np
import numpy.typing as npt

from starhil.emulator.sky.directions import icrs_vector
from starhil.emulator.sky.light_grid import GLARE_STEP, Image
from starhil.emulator.sky.objects import EarthLimb, Moon, Obstruction, SkyObjects, SunGlare
from starhil.emulator.sky.wide_earth import GLOW_HEIGHTS, WideEarth
from starid.attitude import Attitude
from starid.camera import Camera
from starid.jit import compiled_ieee

Glare: TypeAlias = tuple[npt.NDArray[np.float32], float, float, bool]
"""Direction of a source in the sensor frame, strength, square of the softness, and whether it falls with the cube."""

_GLARE_FROM_DEG: Final = 0.3
_GLARE_TO_DEG: Final = 30.0
_SUN_REFERENCE_DEG: Final = 30.0
_SUN_SOFT_DEG: Final = 3.0

_SMOOTH_PX: Final = 7.0 * GLARE_STEP
"""Distance to a source, or softness of its glare, from which its light is smooth, pixels."""

_SPOT_SIGMAS: Final = 2.0
"""Width of a spot in units of its standard deviation."""

_WIDE_EARTH_DEG: Final = 20.0
"""Angular radius of the Earth from which it is computed on the grid: the limb is within 0.03 pixels of its place."""


@dataclass(frozen=True)
class AreaLight:
    """Light of extended objects, and the fraction of the sky's light that passes them.

    Attributes
    ----------
    glare : ndarray (gh, gw), float32, or None
        Smooth light in electrons/s in a pixel of mean sensitivity, at every `GLARE_STEP`-th column and row.
    electrons_s : ndarray (h, w), float32, or None
        Other light in every pixel, electrons/s.
    transmission : ndarray (h, w), float32, or None
        Fraction of the light from behind that is visible, 0…1; None together with `electrons_s`.
    flooded : bool
        Light passes the baffle and saturates the image; the rest is then empty.
    earth : WideEarth or None
        An Earth in front of `glare` and sky; the other light and shadow are then None.
    """

    glare: Image | None = None
    electrons_s: Image | None = None
    transmission: Image | None = None
    flooded: bool = False
    earth: WideEarth | None = None

    def seen_at(self, xy_px: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Return the transmission (n,) of the pixels nearest to positions (n, 2)."""
        if self.earth is not None:
            return self.earth.seen_at(xy_px)
        if self.transmission is None:
            return np.full(len(xy_px), 0.0 if self.flooded else 1.0)
        height, width = self.transmission.shape
        columns = np.clip(np.rint(xy_px[:, 0]), 0, width - 1).astype(np.int64)
        rows = np.clip(np.rint(xy_px[:, 1]), 0, height - 1).astype(np.int64)
        return self.transmission[rows, columns].astype(np.float64)

    @property
    def covered_share(self) -> float:
        """Fraction of the image that receives less than half of the sky's light."""
        if self.earth is not None:
            return self.earth.covered_share
        if self.transmission is None:
            return float(self.flooded)
        return float(np.count_nonzero(self.transmission < 0.5) / self.transmission.size)


@compiled_ieee
def add_area(
    mean: Image,
    electrons_s: Image,
    transmission: Image,
    sensitivity: Image,
    sky_e_s: float,
    exposure_s: float,
) -> None:
    """Add light (h, w) to the mean electrons, and take away the sky that it hides."""
    sky, exposure = np.float32(sky_e_s), np.float32(exposure_s)
    for y in range(mean.shape[0]):
        to, light, passed, gain = mean[y], electrons_s[y], transmission[y], sensitivity[y]
        for x in range(to.size):
            added = (light[x] + (passed[x] - np.float32(1.0)) * sky) * gain[x] * exposure
            to[x] = max(to[x] + added, np.float32(0.0))


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
def _add_earth(
    electrons_s: Image,
    transmission: Image,
    directions: Image,
    nadir: npt.NDArray[np.float64],
    sun: npt.NDArray[np.float64],
    angles: tuple[float, float],
    brightness: float,
) -> None:
    """Put the Earth in front of light and sky, in place.

    Parameters
    ----------
    electrons_s, transmission : ndarray (h, w), float32
        As in `AreaLight`.
    directions : ndarray (3, h, w), float32
        Of the pixels, sensor frame.
    nadir, sun : ndarray (3,)
        To the Earth's centre and to the Sun, sensor frame; zeros instead of the Sun light all of the disc.
    angles : (float, float)
        Angular radius of the disc, and height over which its limb fades, radians.
    brightness : float
        Electrons/s per pixel where the Sun is in the zenith.
    """
    radius, atmosphere = angles
    distance = 1.0 / math.sin(radius)
    inner, outer = math.cos(radius), math.cos(min(radius + GLOW_HEIGHTS * atmosphere, math.pi))
    n0, n1, n2 = np.float32(nadir[0]), np.float32(nadir[1]), np.float32(nadir[2])
    s0, s1, s2 = np.float32(sun[0]), np.float32(sun[1]), np.float32(sun[2])
    behind = np.float32(-distance * (nadir[0] * sun[0] + nadir[1] * sun[1] + nadir[2] * sun[2]))
    if sun[0] == 0.0 and sun[1] == 0.0 and sun[2] == 0.0:
        behind = np.float32(1.0)
    far, far2 = np.float32(distance), np.float32(distance * distance)
    edge, end, full = np.float32(inner), np.float32(outer), np.float32(brightness)
    zero, one = np.float32(0.0), np.float32(1.0)
    width = electrons_s.shape[1]
    cosines, shades = np.empty(width, dtype=np.float32), np.empty(width, dtype=np.float32)
    for y in range(electrons_s.shape[0]):
        dx, dy, dz = directions[0, y], directions[1, y], directions[2, y]
        light, passed = electrons_s[y], transmission[y]
        least, most = one, -one
        for x in range(width):
            cosine = n0 * dx[x] + n1 * dy[x] + n2 * dz[x]
            cosines[x] = cosine
            least, most = min(least, cosine), max(most, cosine)
        if most < end:
            continue
        for x in range(width):
            # brightness by the Sun's zenith distance where the line of sight meets a sphere of radius 1
            cosine = cosines[x]
            along = far * cosine - np.sqrt(max(one - far2 * (one - cosine * cosine), zero))
            shade = behind + along * (s0 * dx[x] + s1 * dy[x] + s2 * dz[x])
            shades[x] = full * min(max(shade, zero), one)
        for x in range(width):
            inside = cosines[x] >= edge
            light[x] = shades[x] if inside else light[x]
            passed[x] = zero if inside else passed[x]
        if least >= edge:
            continue
        for x in range(width):
            if end <= cosines[x] < edge:
                height = (math.acos(cosines[x]) - radius) / atmosphere
                clear = np.float32(min(height, 1.0))
                light[x] = light[x] * clear + shades[x] * np.float32(math.exp(-height))
                passed[x] *= clear


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
        return self._directions_of(np.arange(self._camera.width), np.arange(self._camera.height))

    @cached_property
    def _grid_directions(self) -> Image:
        """Unit vectors (3, gh, gw) of the points of the glare's grid."""
        steps = (GLARE_STEP * np.arange(-(-size // GLARE_STEP) + 1) for size in self._size)
        return self._directions_of(*steps)

    @cached_property
    def _buffers(self) -> tuple[Image, Image]:
        """Light and transmission (h, w) of the last image, to be used again."""
        shape = (self._camera.height, self._camera.width)
        return np.empty(shape, dtype=np.float32), np.empty(shape, dtype=np.float32)

    @property
    def _size(self) -> tuple[int, int]:
        return self._camera.width, self._camera.height

    def _directions_of(self, columns: npt.NDArray[np.int64], rows: npt.NDArray[np.int64]) -> Image:
        x, y = np.meshgrid(columns, rows)
        vectors = self._camera.back_project(np.column_stack([x.ravel(), y.ravel()]).astype(np.float64))
        vectors[np.isnan(vectors).any(axis=1)] = (0.0, 0.0, -1.0)
        return np.ascontiguousarray(vectors.T.reshape(3, rows.size, columns.size), dtype=np.float32)

    def paint(self, objects: SkyObjects, attitude: Attitude) -> AreaLight:
        """Return light and transmission of all extended objects at one attitude, valid until the next call."""
        if baffle_passed(objects, attitude):
            return AreaLight(flooded=True)
        moon, earth = objects.moon, objects.earth
        if earth is not None and not self._earth_in_field(earth, attitude):
            earth = None
        covered = bool(objects.obstructions) or objects.blank
        disc = None if moon is None else self._moon_box(moon, attitude)
        smooth, sharp = self._sorted_glare(objects, attitude, sharp=covered)
        wide = earth is not None and earth.radius_deg >= _WIDE_EARTH_DEG
        if earth is not None and (covered or sharp or disc or not wide):
            covered, wide = True, False
            smooth, sharp = [], smooth + sharp
        glare = None
        if smooth:
            glare = np.zeros(self._grid_directions.shape[1:], dtype=np.float32)
            for source in smooth:
                _add_glare(glare, self._grid_directions, *source)
        if earth is not None and wide:
            return AreaLight(glare, earth=self._wide_earth(earth, attitude))
        if not (sharp or covered or disc):
            return AreaLight(glare)
        electrons_s, transmission = self._buffers
        electrons_s.fill(0.0)
        transmission.fill(1.0)
        for source in sharp:
            _add_glare(electrons_s, self._directions, *source)
        light = AreaLight(glare, electrons_s, transmission)
        if moon is not None and disc is not None:
            self._paint_moon(electrons_s, transmission, moon, attitude, disc)
        if earth is not None:
            self._paint_earth(electrons_s, transmission, earth, attitude)
        for obstruction in objects.obstructions:
            cover = self._obstruction_transmission(obstruction)
            electrons_s *= cover
            transmission *= cover
        if objects.blank:
            electrons_s[:] = 0.0
            transmission[:] = 0.0
        return light

    def _sorted_glare(
        self, objects: SkyObjects, attitude: Attitude, *, sharp: bool
    ) -> tuple[list[Glare], list[Glare]]:
        """Return the glare of Sun and Moon as arguments of the kernel: what is smooth over the image, and the rest.

        With `sharp`, all of it is taken as not smooth, since something covers part of it.
        """
        sorted_glare: tuple[list[Glare], list[Glare]] = ([], [])
        for body in (objects.sun, objects.moon):
            if body is None:
                continue
            off_axis = _off_axis_deg(attitude, body)
            if off_axis > body.reach_deg:
                continue
            source = attitude.to_sensor(icrs_vector(body.ra_deg, body.dec_deg)).astype(np.float32)
            strength, soft, cube = self._glare_of(body)
            outside = math.radians(off_axis) - self._camera.field_radius_rad
            smooth = max(soft, outside) > _SMOOTH_PX * self._camera.pixel_scale_rad and not sharp
            sorted_glare[0 if smooth else 1].append((source, strength, soft * soft, cube))
        return sorted_glare

    def _glare_of(self, body: SunGlare | Moon) -> tuple[float, float, bool]:
        """Strength and softness of a body's stray light, and whether it falls with the cube of the angle."""
        if isinstance(body, SunGlare):
            reference = 2.0 * math.sin(math.radians(_SUN_REFERENCE_DEG) / 2.0)
            soft = 2.0 * math.sin(math.radians(_SUN_SOFT_DEG) / 2.0)
            return body.electrons_s * reference**3, soft, True
        share = body.glare_share / (2.0 * math.pi * math.log(_GLARE_TO_DEG / _GLARE_FROM_DEG))
        total = self._moonlight(body)
        return total * share * self._camera.pixel_scale_rad**2, math.radians(_GLARE_FROM_DEG), False

    def _moonlight(self, moon: Moon) -> float:
        """Electrons/s from the whole Moon."""
        return self._zero_magnitude_e_s * math.pow(10.0, -0.4 * moon.magnitude)

    def _moon_box(self, moon: Moon, attitude: Attitude) -> tuple[slice, slice] | None:
        """Return the part of the image that the Moon's disc may touch; None if it is outside."""
        source = attitude.to_sensor(icrs_vector(moon.ra_deg, moon.dec_deg))
        xy, _ = self._camera.project(source[None, :])
        return self._box(xy[0], math.radians(moon.diameter_deg) / self._camera.pixel_scale_rad + 8.0)

    def _paint_moon(
        self,
        electrons_s: Image,
        transmission: Image,
        moon: Moon,
        attitude: Attitude,
        box: tuple[slice, slice],
    ) -> None:
        """Add the Moon's disc with the terminator."""
        import cv2

        source = attitude.to_sensor(icrs_vector(moon.ra_deg, moon.dec_deg))
        radius = math.radians(moon.diameter_deg) / 2.0
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
        disc = (lit * (self._moonlight(moon) / area)).astype(np.float32)
        electrons_s[box] += cv2.GaussianBlur(disc, (0, 0), self._psf_sigma_px)
        transmission[box] *= (1.0 - inside).astype(np.float32)

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

    def _paint_earth(
        self, electrons_s: Image, transmission: Image, earth: EarthLimb, attitude: Attitude
    ) -> None:
        """Add the Earth's disc, pixel by pixel."""
        nadir, sun = self._earth_and_sun(earth, attitude)
        angles = (math.radians(earth.radius_deg), self._atmosphere_rad(earth))
        _add_earth(electrons_s, transmission, self._directions, nadir, sun, angles, earth.electrons_s)

    def _wide_earth(self, earth: EarthLimb, attitude: Attitude) -> WideEarth:
        """Return the Earth on the grid."""
        nadir, sun = self._earth_and_sun(earth, attitude)
        directions = self._grid_directions
        cosine = np.tensordot(nadir, directions, axes=1)
        height = np.arccos(np.clip(cosine, -1.0, 1.0)) - math.radians(earth.radius_deg)
        grid = np.stack([cosine, np.tensordot(sun, directions, axes=1), height / self._atmosphere_rad(earth)])
        distance = 1.0 / math.sin(math.radians(earth.radius_deg))
        behind = -distance * float(nadir @ sun) if np.any(sun) else 1.0
        return WideEarth(grid.astype(np.float32), distance, behind, earth.electrons_s)

    def _earth_and_sun(
        self, earth: EarthLimb, attitude: Attitude
    ) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Return the directions (3,) of the Earth's centre and of its Sun, sensor frame; zeros light all of the disc."""
        sun = _sun_of(earth)
        nadir = attitude.to_sensor(icrs_vector(earth.ra_deg, earth.dec_deg))
        return nadir, np.zeros(3) if sun is None else attitude.to_sensor(sun)

    def _atmosphere_rad(self, earth: EarthLimb) -> float:
        """Return the angle over which the limb fades: the atmosphere's, but at least the width of a spot."""
        spot = _SPOT_SIGMAS * self._psf_sigma_px * self._camera.pixel_scale_rad
        return max(math.radians(earth.atmosphere_deg), spot)

    def _earth_in_field(self, earth: EarthLimb, attitude: Attitude) -> bool:
        """Whether the Earth or the glow of its limb reaches into the field."""
        reach_deg = earth.radius_deg + GLOW_HEIGHTS * earth.atmosphere_deg
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
            partial = 0.0 < obstruction.share < 1.0
            cover = (along <= edge if partial else np.full_like(along, obstruction.share == 0.0)).astype(
                np.float32
            )
        if obstruction.softness_px <= 0.0:
            return cover
        soft = cv2.GaussianBlur(cover, (0, 0), obstruction.softness_px, borderType=cv2.BORDER_REPLICATE)
        return np.asarray(soft, dtype=np.float32)
