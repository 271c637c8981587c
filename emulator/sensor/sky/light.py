"""Light and shadow over areas of an image: Sun, Moon, Earth and obstructions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Final

import numpy as np

from starhil.emulator.sensor.sky.light_grid import GLARE_STEP, Backdrop, Image, Line, fill
from starhil.emulator.sensor.sky.light_kernels import (
    Box,
    Glare,
    NearGlare,
    add_earth,
    add_glare,
    blurred,
    cover_box,
    draw_moon,
    points_near,
    refine_glare,
    transmission_at,
)
from starhil.emulator.sensor.sky.objects import (
    SUN_V,
    CelestialBody,
    EarthLimb,
    Moon,
    Obstruction,
    SkyObjects,
    SunGlare,
)
from starhil.emulator.sensor.sky.wide_earth import GLOW_HEIGHTS, WideEarth
from starid.arrays import Array, Indices
from starid.attitude import Attitude
from starid.camera import Camera

_BORDER_SAMPLES: Final = 33
_GLARE_FROM_DEG: Final = 0.3
_GLARE_TO_DEG: Final = 30.0
_SUN_REFERENCE_DEG: Final = 30.0
_SUN_SOFT_DEG: Final = 3.0

_SMOOTH_PX: Final = 13.0 * GLARE_STEP
"""Distance to a source, or softness of its glare, from which its light is smooth, pixels: interpolated within 0.5 %."""

_EDGE_PX: Final = 8.0
"""Pixels around the Moon's disc into which its edge is blurred."""

_BLUR_SIGMAS: Final = 4.0
"""Reach of the blur of the Moon's edge, standard deviations of a spot."""

_SPOT_SIGMAS: Final = 2.0
"""Width of a spot in units of its standard deviation."""

_WIDE_EARTH_DEG: Final = 20.0
"""Angular radius of the Earth from which it is computed on the grid: the limb is within 0.03 pixels of its place."""


@dataclass(frozen=True)
class Patch:
    """Light and shadow in part of an image."""

    box: Box
    light: Image
    """Electrons/s in a pixel of mean sensitivity, (h', w'), float32."""
    passed: Image
    """Fraction of the light from behind that is visible, 0…1, (h', w'), float32."""
    hides_glare: bool = True
    """Whether it is in front of the light scattered in the lens too."""

    def seen_at(self, xy_px: Array) -> Array:
        """Return the transmission (n,) of the pixels nearest to positions (n, 2)."""
        return transmission_at(self.passed, self.box, xy_px)

    def cover(self, mean: Image, backdrop: Backdrop) -> None:
        """Put it in front of the mean electrons (h, w), in place."""
        light = backdrop.unit * backdrop.exposure_s, backdrop.sky_e_s
        planes = mean, backdrop.still, backdrop.sensitivity
        cover_box(planes, self.light, self.passed, self.box, light, self.hides_glare)


@dataclass(frozen=True)
class AreaLight:
    """Light of extended objects, and the fraction of the sky's light that passes them."""

    size: tuple[int, int]
    glare: Image | None = None
    """Smooth light in electrons/s in a pixel of mean sensitivity, at every `GLARE_STEP`-th column and row, (gh, gw)."""
    near: tuple[NearGlare, ...] = ()
    """What is not smooth of that light."""
    earth: WideEarth | None = None
    """An Earth in front of `glare`, sky and the patches before the last `in_front`."""
    behind: tuple[Patch, ...] = ()
    in_front: tuple[Patch, ...] = ()
    """What lies behind and in front of that Earth."""
    flooded: bool = False
    """Light passes the baffle and saturates the image; the rest is then empty."""

    def seen_at(self, xy_px: Array) -> Array:
        """Return the transmission (n,) at positions (n, 2); outside the image that of its edge."""
        transmission = np.full(len(xy_px), 0.0 if self.flooded else 1.0)
        if self._layers:
            nearest = np.clip(xy_px, 0.0, np.array(self.size) - 1.0)
            for layer in self._layers:
                transmission *= layer.seen_at(nearest)
        return transmission

    @property
    def covered_share(self) -> float:
        """Fraction of the image that receives less than half of the sky's light; behind obstructions, by a grid of pixels."""
        if not self.in_front:
            hidden = sum(np.count_nonzero(patch.passed < 0.5) for patch in self.behind)
            share = float(self.flooded) if self.earth is None else self.earth.covered_share
            return min(share + hidden / math.prod(self.size), 1.0)
        x, y = np.meshgrid(*(np.arange(GLARE_STEP // 2, size, GLARE_STEP) for size in self.size))
        return float(np.mean(self.seen_at(np.column_stack([x.ravel(), y.ravel()]).astype(np.float64)) < 0.5))

    @property
    def _layers(self) -> tuple[Patch | WideEarth, ...]:
        return (*self.behind, *(() if self.earth is None else (self.earth,)), *self.in_front)

    def draw(self, mean: Image, backdrop: Backdrop) -> None:
        """Fill the mean electrons (h, w) with the backdrop, and all light and shadow.

        What `mean` holds before must be finite: it stays behind a wide Earth until that is drawn.
        """
        glare = self.glare
        if glare is not None and backdrop.exposure_s * np.max(glare) <= backdrop.min_glare_e:
            glare = None
        if glare is None and self.earth is None:
            np.copyto(mean, backdrop.still)
        else:
            none = np.empty((0, 0), dtype=np.float32)
            hidden = none if self.earth is None else self.earth.grid[2]
            exposure_s = backdrop.unit * backdrop.exposure_s
            smooth = none if glare is None else glare
            planes = backdrop.still, backdrop.dark, backdrop.sensitivity
            fill(mean, planes, smooth, hidden, (backdrop.dark_unit_e, backdrop.sky_e_s, exposure_s))
        for near in self.near:
            refine_glare(mean, backdrop.sensitivity, near, backdrop.unit * backdrop.exposure_s)
        for layer in self._layers:
            layer.cover(mean, backdrop)


def disc_in_field(centre: Array, radius_rad: float, camera: Camera) -> bool:
    """Return whether any part of a disc around a direction (3,) of the sensor frame is in the field."""
    if math.acos(max(min(float(centre[2]), 1.0), -1.0)) > camera.field_radius_rad + radius_rad:
        return False
    if camera.project(centre[None, :])[1][0]:
        return True
    nearest = float(np.max(_border_of(camera) @ centre, initial=-1.0))
    return nearest >= math.cos(min(radius_rad, math.pi))


@lru_cache(maxsize=4)
def _border_of(camera: Camera) -> Array:
    """Directions (n, 3) of the outer edge of the pixel array, where it sees any."""
    border = camera.back_project(camera.border(_BORDER_SAMPLES))
    return border[~np.isnan(border).any(axis=1)]


def through_baffle(objects: SkyObjects, attitude: Attitude) -> tuple[str, ...]:
    """Return which of `sun`, `moon` and `earth` is within its exclusion angle, so that its light saturates the image."""
    earth = objects.earth
    passing = [
        name
        for name, body in (("sun", objects.sun), ("moon", objects.moon))
        if body is not None and _off_axis_deg(attitude, body) < body.exclusion_deg
    ]
    if earth is not None and earth.exclusion_deg > 0.0:
        off_axis = _off_axis_deg(attitude, earth)
        near_deg = min(off_axis, earth.radius_deg)
        near = off_axis - near_deg < earth.exclusion_deg
        if near and _is_lit(earth, attitude.boresight, near_deg):
            passing.append("earth")
    return tuple(passing)


def _is_lit(earth: EarthLimb, towards: Array, off_nadir_deg: float) -> bool:
    """Whether the Sun shines on the point of the Earth seen at an angle from its centre towards a direction."""
    sun = earth.sun_direction
    if sun is None:
        return True
    nadir = earth.direction
    sideways = towards - float(towards @ nadir) * nadir
    sideways /= max(float(np.linalg.norm(sideways)), 1e-12)
    angle, distance = math.radians(off_nadir_deg), 1.0 / math.sin(earth.radius_rad)
    line = math.cos(angle) * nadir + math.sin(angle) * sideways
    under = max(1.0 - (distance * math.sin(angle)) ** 2, 0.0)
    normal = (distance * math.cos(angle) - math.sqrt(under)) * line - distance * nadir
    return float(normal @ sun) > 0.0


def _off_axis_deg(attitude: Attitude, body: CelestialBody) -> float:
    """Angle of a body's centre from the boresight, degrees."""
    chord = math.dist(body.direction.tolist(), attitude.boresight.tolist())
    return math.degrees(2.0 * math.asin(min(0.5 * chord, 1.0)))


class AreaPainter:
    """Paints the extended objects of a sky for one camera; caches the directions of its pixels.

    A source of magnitude 0 has `zero_magnitude_e_s` electrons/s. A spot of standard deviation `psf_sigma_px` blurs
    edges.
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
    def _spot_taps(self) -> Line:
        """Weights (2 m + 1,) of a Gaussian as wide as a spot."""
        reach = math.ceil(_BLUR_SIGMAS * self._psf_sigma_px)
        weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / self._psf_sigma_px) ** 2)
        return np.asarray(weights / weights.sum(), dtype=np.float32)

    @property
    def _size(self) -> tuple[int, int]:
        return self._camera.width, self._camera.height

    def _directions_of(self, columns: Indices, rows: Indices) -> Image:
        x, y = np.meshgrid(columns, rows)
        vectors = self._camera.back_project(np.column_stack([x.ravel(), y.ravel()]).astype(np.float64))
        vectors[np.isnan(vectors).any(axis=1)] = (0.0, 0.0, -1.0)
        return np.ascontiguousarray(vectors.T.reshape(3, rows.size, columns.size), dtype=np.float32)

    def paint(self, objects: SkyObjects, attitude: Attitude) -> AreaLight:
        """Return light and transmission of all extended objects at one attitude."""
        if not objects.blank and through_baffle(objects, attitude):
            return AreaLight(self._size, flooded=True)
        sun, earth = objects.sun, objects.earth
        disc = sun.disc if sun and self._in_field(sun, sun.radius_rad, attitude) else None
        lights = [body for body in (sun, disc, objects.moon) if body]
        glare, near = self._glare(lights, attitude)
        behind = tuple(
            patch for body in lights if isinstance(body, Moon) for patch in self._disc_patch(body, attitude)
        )
        wide_earth: WideEarth | None = None
        in_front: list[Patch] = []
        if earth is not None and self._in_field(earth, self._reach_rad(earth), attitude):
            if earth.radius_deg >= _WIDE_EARTH_DEG:
                wide_earth = self._wide_earth(earth, attitude)
            else:
                in_front = self._small_earth(earth, attitude)
        covers = [self._obstruction_transmission(obstruction) for obstruction in objects.obstructions]
        if objects.blank:
            covers.append(np.zeros(self._size[::-1], dtype=np.float32))
        everything = (0, self._camera.height, 0, self._camera.width)
        in_front += [Patch(everything, np.zeros_like(cover), cover) for cover in covers]
        return AreaLight(self._size, glare, near, wide_earth, behind, tuple(in_front))

    def _in_field(self, body: CelestialBody, radius_rad: float, attitude: Attitude) -> bool:
        """Whether any part of a disc around a body is in the field."""
        return disc_in_field(attitude.to_sensor(body.direction), radius_rad, self._camera)

    def _glare(
        self, lights: Sequence[SunGlare | Moon], attitude: Attitude
    ) -> tuple[Image | None, tuple[NearGlare, ...]]:
        """Return the glare of Sun and Moon on the grid, and near them."""
        glare, near = None, []
        grid, smooth_rad = self._grid_directions, _SMOOTH_PX * self._camera.pixel_scale_rad
        for body in lights:
            off_axis = _off_axis_deg(attitude, body)
            if off_axis > body.reach_deg:
                continue
            strength, soft, cube = self._glare_of(body)
            direction = attitude.to_sensor(body.direction)
            source: Glare = (direction.astype(np.float32), strength, soft * soft, cube)
            light = np.zeros(grid.shape[1:], dtype=np.float32)
            add_glare(light, grid, source)
            outside = math.radians(off_axis) - self._camera.field_radius_rad
            if max(soft, outside) < smooth_rad:
                box = self._box_around(direction, smooth_rad)
                if box is not None:
                    near.append((box, source, light, self._directions))
            glare = light if glare is None else glare + light
        return glare, tuple(near)

    def _glare_of(self, body: SunGlare | Moon) -> tuple[float, float, bool]:
        """Strength and softness of a body's stray light, and whether it falls with the cube of the angle."""
        if isinstance(body, SunGlare):
            reference = 2.0 * math.sin(math.radians(_SUN_REFERENCE_DEG) / 2.0)
            soft = 2.0 * math.sin(math.radians(_SUN_SOFT_DEG) / 2.0)
            return body.stray_share * self._scattered(body.disc) * reference, soft, True
        return self._scattered(body), math.radians(_GLARE_FROM_DEG), False

    def _scattered(self, body: Moon) -> float:
        """Electrons/s per pixel that the lens scatters at an angle, times its square as chord.

        The fraction `glare_share` of the light in the pupil goes into the angles between `_GLARE_FROM_DEG` and
        `_GLARE_TO_DEG`.
        """
        share = body.glare_share / (2.0 * math.pi * math.log(_GLARE_TO_DEG / _GLARE_FROM_DEG))
        return self._electrons_s(body.magnitude) * share * self._camera.pixel_scale_rad**2

    def _electrons_s(self, magnitude: float) -> float:
        """Electrons/s from all of a body."""
        return self._zero_magnitude_e_s * math.pow(10.0, -0.4 * magnitude)

    def _earthlight(self, earth: EarthLimb) -> float:
        """Electrons/s per pixel of an Earth with the Sun in the zenith, by Lambert's law."""
        return self._electrons_s(SUN_V) * earth.albedo / math.pi * self._camera.pixel_scale_rad**2

    def _disc_patch(self, moon: Moon, attitude: Attitude) -> tuple[Patch, ...]:
        """Return the disc of Moon or Sun with the terminator; nothing if it is outside the image."""
        source, scale = attitude.to_sensor(moon.direction), moon.radius_rad / self._camera.pixel_scale_rad
        box = self._box_around(source, moon.radius_rad + _EDGE_PX * self._camera.pixel_scale_rad)
        if box is None:
            return ()
        x, y, z = moon.direction.tolist()
        across, along = math.hypot(x, y), math.radians(moon.bright_limb_deg)
        east, north = (-y / across, x / across, 0.0), (-x * z / across, -y * z / across, across)
        turn = (math.cos(along) / moon.radius_rad, math.sin(along) / moon.radius_rad)
        axes = attitude.to_sensor(np.array([north, east]))
        area = max(math.pi * scale**2 * moon.illuminated, 1.0)
        shape = (scale, moon.illuminated, self._electrons_s(moon.magnitude) / area)
        disc, passed = np.empty((2, box[1] - box[0], box[3] - box[2]), dtype=np.float32)
        draw_moon(disc, passed, self._directions, box, (axes, turn, source), shape)
        return (Patch(box, blurred(disc, self._spot_taps), passed, hides_glare=False),)

    def _box_around(self, direction: Array, radius_rad: float) -> Box | None:
        """Return the part of the image that holds a disc in the sensor frame; None if it is outside."""
        reach_rad = radius_rad + 1.25 * GLARE_STEP * self._camera.pixel_scale_rad
        if math.acos(max(min(float(direction[2]), 1.0), -1.0)) > self._camera.field_radius_rad + reach_rad:
            return None
        cosine = math.cos(min(reach_rad, math.pi))
        top, bottom, left, right = points_near(self._grid_directions, direction.astype(np.float32), cosine)
        width, height = self._size
        top, bottom = GLARE_STEP * top, min(GLARE_STEP * bottom + 1, height)
        left, right = GLARE_STEP * left, min(GLARE_STEP * right + 1, width)
        return (top, bottom, left, right) if top < bottom and left < right else None

    def _small_earth(self, earth: EarthLimb, attitude: Attitude) -> list[Patch]:
        """Return the Earth's disc, pixel by pixel; nothing if it is outside the image."""
        nadir, sun = self._earth_and_sun(earth, attitude)
        box = self._box_around(nadir, self._reach_rad(earth))
        if box is None:
            return []
        directions = np.ascontiguousarray(self._directions[:, box[0] : box[1], box[2] : box[3]])
        light, passed = np.zeros_like(directions[0]), np.ones_like(directions[0])
        angles = (earth.radius_rad, self._atmosphere_rad(earth))
        add_earth(light, passed, directions, nadir, sun, angles, self._earthlight(earth))
        return [Patch(box, light, passed)]

    def _wide_earth(self, earth: EarthLimb, attitude: Attitude) -> WideEarth:
        nadir, sun = self._earth_and_sun(earth, attitude)
        directions = self._grid_directions
        grid = np.empty_like(directions)
        towards = np.array([nadir, sun], dtype=np.float32)
        np.matmul(towards, directions.reshape(3, -1), out=grid[:2].reshape(2, -1))
        np.arccos(np.clip(grid[0], -1.0, 1.0, out=grid[2]), out=grid[2])
        grid[2] -= np.float32(earth.radius_rad)
        grid[2] *= np.float32(1.0 / self._atmosphere_rad(earth))
        distance = 1.0 / math.sin(earth.radius_rad)
        behind = -distance * float(nadir @ sun) if np.any(sun) else 1.0
        step_rad = GLARE_STEP * self._camera.pixel_scale_rad
        return WideEarth(grid, distance, behind, self._earthlight(earth), step_rad)

    def _earth_and_sun(self, earth: EarthLimb, attitude: Attitude) -> tuple[Array, Array]:
        """Return the directions (3,) of the Earth's centre and of its Sun, sensor frame; zeros light all of the disc."""
        sun = earth.sun_direction
        nadir = attitude.to_sensor(earth.direction)
        return nadir, np.zeros(3) if sun is None else attitude.to_sensor(sun)

    def _atmosphere_rad(self, earth: EarthLimb) -> float:
        """Return the angle over which the limb fades: the atmosphere's, but at least the width of a spot."""
        spot = _SPOT_SIGMAS * self._psf_sigma_px * self._camera.pixel_scale_rad
        return max(math.radians(earth.atmosphere_deg), spot)

    def _reach_rad(self, earth: EarthLimb) -> float:
        """Return the angle from the Earth's centre to which the glow of its limb reaches."""
        return earth.radius_rad + GLOW_HEIGHTS * self._atmosphere_rad(earth)

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
