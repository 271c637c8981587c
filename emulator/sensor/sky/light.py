"""What Sun, Moon, Earth and obstructions put into an image: their stray light, discs, limb and shadows."""

from __future__ import annotations

import dataclasses
import math
from functools import cached_property, lru_cache
from typing import Final

import numpy as np

from starhil.emulator.sensor.sky.area_light import (
    AreaLight,
    Box,
    Glare,
    Image,
    Patch,
    row_blocks,
    scalar_products,
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
from starid.arithmetic.arrays import Array, Array32, elementwise
from starid.arithmetic.elementary import acos, asin, atan2, cos, exp, hypot, log, log10, power, sin, square
from starid.arithmetic.matrices import dot, length, product
from starid.attitude import Attitude
from starid.camera import Camera

_BORDER_SAMPLES: Final = 33
_GLARE_FROM_DEG: Final = 0.3
_GLARE_TO_DEG: Final = 30.0
_SUN_REFERENCE_DEG: Final = 30.0
_SUN_SOFT_DEG: Final = 3.0

_EDGE_PX: Final = 8.0
"""Pixels around the Moon's disc into which its edge is blurred."""

_BLUR_SIGMAS: Final = 4.0
"""Reach of the blur of the Moon's edge, standard deviations of a spot."""

_SPOT_SIGMAS: Final = 2.0
"""Width of a spot in units of its standard deviation."""

_GLOW_HEIGHTS: Final = 20.0
"""Heights of the atmosphere above the limb up to which it glows."""

_LIMB_STEPS: Final = 1024
"""Steps of the table of the limb, in which light is interpolated."""

_EARTH_RINGS: Final = 24
_EARTH_SECTORS: Final = 48
"""Parts of the Earth's disc, of equal solid angle, whose stray light is added up."""

_GRID_STEP: Final = 8
"""Pixels between the points that are examined for the part of an image that shows a body."""


def _blurred(image: Image, taps: Array32) -> Image:
    """Return an image convolved with weights (2 m + 1,) along both axes; beyond its edge it goes on as it is there."""
    reach = taps.size // 2
    for _ in range(2):
        padded = np.pad(image, ((reach, reach), (0, 0)), mode="edge")
        blurred = np.zeros_like(image)
        for k, tap in enumerate(taps):
            blurred += tap * padded[k : k + len(image)]
        image = blurred.T
    return image


def disc_in_field(centre: Array, radius_rad: float, camera: Camera) -> bool:
    """Return whether any part of a disc around a direction (3,) of the sensor frame is in the field."""
    if acos(max(min(float(centre[2]), 1.0), -1.0)) > camera.field_radius_rad + radius_rad:
        return False
    if camera.project(centre[None, :])[1][0]:
        return True
    nearest = float(np.max(product(_border_of(camera), centre), initial=-1.0))
    return nearest >= cos(min(radius_rad, math.pi))


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
    sideways = towards - dot(towards, nadir) * nadir
    sideways /= max(length(sideways), 1e-12)
    angle, distance = math.radians(off_nadir_deg), 1.0 / sin(earth.radius_rad)
    line = cos(angle) * nadir + sin(angle) * sideways
    under = max(1.0 - square(distance * sin(angle)), 0.0)
    normal = (distance * cos(angle) - math.sqrt(under)) * line - distance * nadir
    return dot(normal, sun) > 0.0


@lru_cache(maxsize=4)
def _lit_parts(earth: EarthLimb) -> tuple[Array, Array]:
    """Directions (n, 3), ICRS, of parts of the Earth's disc, and their light (n,) relative to that of the Sun, by Lambert's law."""
    nadir, sun = earth.direction, earth.sun_direction
    cosines = 1.0 - (1.0 - cos(earth.radius_rad)) * (np.arange(_EARTH_RINGS) + 0.5) / _EARTH_RINGS
    sines = np.sqrt(1.0 - square(cosines))
    turns = 2.0 * math.pi / _EARTH_SECTORS * np.arange(_EARTH_SECTORS)
    across = np.array([1.0, 0.0, 0.0]) if abs(float(nadir[0])) < 0.5 else np.array([0.0, 1.0, 0.0])
    side = across - dot(across, nadir) * nadir
    side /= length(side)
    ring = np.outer(elementwise(cos, turns), side) + np.outer(elementwise(sin, turns), np.cross(nadir, side))
    directions = (cosines[:, None, None] * nadir + sines[:, None, None] * ring).reshape(-1, 3)
    solid_angle = 2.0 * math.pi * (1.0 - cos(earth.radius_rad)) / len(directions)
    light = np.full(len(directions), earth.albedo / math.pi * solid_angle)
    if sun is not None:
        distance = 1.0 / sin(earth.radius_rad)
        cosine = np.repeat(cosines, _EARTH_SECTORS)
        along = distance * cosine - np.sqrt(np.maximum(1.0 - square(distance) * (1.0 - square(cosine)), 0.0))
        light *= np.maximum(along * product(directions, sun) - distance * dot(nadir, sun), 0.0)
    return directions, light


def _left_by_baffle(sun: SunGlare, attitude: Attitude) -> float:
    """Return the fraction of sunlight that the baffle leaves at an attitude."""
    if sun.decade_deg == 0.0:
        return sun.stray_share
    outside_deg = max(_off_axis_deg(attitude, sun) - sun.exclusion_deg, 0.0)
    return max(sun.stray_share, power(10.0, -outside_deg / sun.decade_deg))


def _chord(angle_rad: float) -> float:
    return 2.0 * sin(0.5 * angle_rad)


def _off_axis_deg(attitude: Attitude, body: CelestialBody) -> float:
    """Angle of a body's centre from the boresight, degrees."""
    chord = length(body.direction - attitude.boresight)
    return math.degrees(2.0 * asin(min(0.5 * chord, 1.0)))


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
        width, height = self._size
        planes = np.empty((3, height, width), dtype=np.float32)
        for rows in row_blocks(0, height, width):
            y, x = np.mgrid[rows, :width]
            vectors = self._camera.back_project(np.column_stack([x.ravel(), y.ravel()]).astype(np.float64))
            vectors[np.isnan(vectors).any(axis=1)] = (0.0, 0.0, -1.0)
            planes[:, rows] = vectors.T.reshape(3, -1, width)
        return planes

    @cached_property
    def _spot_taps(self) -> Array32:
        """Weights (2 m + 1,) of a Gaussian as wide as a spot."""
        reach = math.ceil(_BLUR_SIGMAS * self._psf_sigma_px)
        weights = elementwise(exp, -0.5 * square(np.arange(-reach, reach + 1) / self._psf_sigma_px))
        return np.asarray(weights / weights.sum(), dtype=np.float32)

    @property
    def _size(self) -> tuple[int, int]:
        return self._camera.width, self._camera.height

    def paint(self, objects: SkyObjects, attitude: Attitude) -> AreaLight:
        if not objects.blank and through_baffle(objects, attitude):
            return AreaLight(self._size, flooded=True)
        sun, earth = objects.sun, objects.earth
        disc = sun.disc if sun and self._in_field(sun, sun.radius_rad, attitude) else None
        lights = [body for body in (sun, disc, objects.moon) if body]
        glare = tuple(
            self._glare(body, attitude) for body in lights if _off_axis_deg(attitude, body) <= body.reach_deg
        )
        if earth is not None and earth.stray_share > 0.0:
            glare += self._earth_glare(earth, attitude)
        patches = [
            patch for body in lights if isinstance(body, Moon) for patch in self._disc_patch(body, attitude)
        ]
        if earth is not None and self._in_field(earth, self._reach_rad(earth), attitude):
            patches += self._earth_patch(earth, attitude)
        if objects.moon is not None and objects.ghost_share > 0.0:
            patches += self._ghost(objects.moon, objects.ghost_share, attitude)
        covers = [_transmission_of(obstruction, *self._size) for obstruction in objects.obstructions]
        if objects.blank:
            covers.append(np.zeros(self._size[::-1], dtype=np.float32))
        everything = (0, self._camera.height, 0, self._camera.width)
        patches += [Patch(everything, np.zeros_like(cover), cover) for cover in covers]
        return AreaLight(self._size, glare, self._directions if glare else None, tuple(patches))

    def _in_field(self, body: CelestialBody, radius_rad: float, attitude: Attitude) -> bool:
        """Whether any part of a disc around a body is in the field."""
        return disc_in_field(attitude.to_sensor(body.direction), radius_rad, self._camera)

    def _glare(self, body: SunGlare | Moon, attitude: Attitude) -> Glare:
        direction = attitude.to_sensor(body.direction)
        outside = math.radians(_off_axis_deg(attitude, body)) - self._camera.field_radius_rad
        nearest = _chord(max(outside, 0.0))
        if isinstance(body, SunGlare):
            reference = _chord(math.radians(_SUN_REFERENCE_DEG))
            strength = _left_by_baffle(body, attitude) * self._scattered(body.disc) * reference
            return Glare(direction, strength, _chord(math.radians(_SUN_SOFT_DEG)), nearest, cube=True)
        return Glare(direction, self._scattered(body), math.radians(_GLARE_FROM_DEG), nearest, cube=False)

    def _earth_glare(self, earth: EarthLimb, attitude: Attitude) -> tuple[Glare, ...]:
        """Return the stray light of the Earth's lit disc, as that of one source; nothing if none of it enters the lens.

        At the boresight it is that of the whole disc, each part of which the baffle dims as it dims the Sun; over the field it
        varies as if all came from the mean direction. Light from behind the lens does not enter it.
        """
        directions, light = _lit_parts(earth)
        chord2 = np.sum(square(directions - attitude.boresight), axis=1)
        soft = _chord(math.radians(_SUN_SOFT_DEG))
        softened = chord2 + square(soft)
        weight = np.where(chord2 < 2.0, light, 0.0) / (softened * np.sqrt(softened))
        total = float(np.sum(weight))
        if total == 0.0:
            return ()
        mean = np.sum(weight[:, None] * directions, axis=0)
        mean /= length(mean)
        chord2_of_mean = float(np.sum(square(mean - attitude.boresight))) + square(soft)
        sun = SunGlare(0.0, 0.0).disc
        reference = _chord(math.radians(_SUN_REFERENCE_DEG))
        strength = earth.stray_share * self._scattered(sun) * reference * total
        strength *= chord2_of_mean * math.sqrt(chord2_of_mean)
        outside = acos(max(min(dot(mean, attitude.boresight), 1.0), -1.0)) - self._camera.field_radius_rad
        return (Glare(attitude.to_sensor(mean), strength, soft, _chord(max(outside, 0.0)), cube=True),)

    def _scattered(self, body: Moon) -> float:
        """Electrons/s per pixel that the lens scatters at an angle, times its square as chord.

        The fraction `glare_share` of the light in the pupil goes into the angles between `_GLARE_FROM_DEG` and
        `_GLARE_TO_DEG`.
        """
        share = body.glare_share / (2.0 * math.pi * log(_GLARE_TO_DEG / _GLARE_FROM_DEG))
        return self._electrons_s(body.magnitude) * share * square(self._camera.pixel_scale_rad)

    def _electrons_s(self, magnitude: float) -> float:
        return self._zero_magnitude_e_s * power(10.0, -0.4 * magnitude)

    def _earthlight(self, earth: EarthLimb) -> float:
        """Electrons/s per pixel of an Earth with the Sun in the zenith, by Lambert's law."""
        return self._electrons_s(SUN_V) * earth.albedo / math.pi * square(self._camera.pixel_scale_rad)

    def _disc_patch(self, moon: Moon, attitude: Attitude) -> list[Patch]:
        """Return the disc of Moon or Sun with the terminator; nothing if it is outside the image."""
        source, scale = attitude.to_sensor(moon.direction), moon.radius_rad / self._camera.pixel_scale_rad
        box = self._box_around(source, moon.radius_rad + _EDGE_PX * self._camera.pixel_scale_rad)
        if box is None:
            return []
        x, y, z = moon.direction.tolist()
        across, along = hypot(x, y), math.radians(moon.bright_limb_deg)
        east, north = (-y / across, x / across, 0.0), (-x * z / across, -y * z / across, across)
        turn = (cos(along) / moon.radius_rad, sin(along) / moon.radius_rad)
        axes = attitude.to_sensor(np.array([north, east]))
        top, bottom, left, right = box
        directions = self._directions[:, top:bottom, left:right].astype(np.float64)
        up, sideways, ahead = (
            v[0] * directions[0] + v[1] * directions[1] + v[2] * directions[2] for v in (*axes, source)
        )
        u, v = turn[0] * up + turn[1] * sideways, turn[0] * sideways - turn[1] * up
        inside = np.clip(0.5 + (1.0 - np.sqrt(u * u + v * v)) * scale, 0.0, 1.0) * (ahead > 0.0)
        terminator = (1.0 - 2.0 * moon.illuminated) * np.sqrt(np.maximum(1.0 - v * v, 0.0))
        area = max(math.pi * square(scale) * moon.illuminated, 1.0)
        brightness = self._electrons_s(moon.magnitude) / area
        disc = inside * np.clip(0.5 + (u - terminator) * scale, 0.0, 1.0) * brightness
        light = _blurred(disc.astype(np.float32), self._spot_taps)
        return [Patch(box, light, (1.0 - inside).astype(np.float32), hides_glare=False)]

    def _ghost(self, moon: Moon, share: float, attitude: Attitude) -> list[Patch]:
        """Return the disc of a Moon mirrored through the axis of the lens; it hides nothing."""
        x, y, z = attitude.to_sensor(moon.direction)
        mirrored = attitude.to_icrs(np.array([-x, -y, z]))
        ghost = dataclasses.replace(
            moon,
            ra_deg=math.degrees(atan2(float(mirrored[1]), float(mirrored[0]))),
            dec_deg=math.degrees(asin(max(min(float(mirrored[2]), 1.0), -1.0))),
            bright_limb_deg=(moon.bright_limb_deg + 180.0) % 360.0,
            magnitude=moon.magnitude - 2.5 * log10(share),
        )
        return [
            dataclasses.replace(patch, passed=np.ones_like(patch.passed))
            for patch in self._disc_patch(ghost, attitude)
        ]

    def _box_around(self, direction: Array, radius_rad: float) -> Box | None:
        """Return the part of the image that holds a disc in the sensor frame; None if it is outside."""
        reach_rad = radius_rad + 1.25 * _GRID_STEP * self._camera.pixel_scale_rad
        if acos(max(min(float(direction[2]), 1.0), -1.0)) > self._camera.field_radius_rad + reach_rad:
            return None
        grid = self._directions[:, ::_GRID_STEP, ::_GRID_STEP]
        near = scalar_products(grid, direction) >= cos(min(reach_rad, math.pi))
        if not near.any():
            return None
        sides = []
        for axis, size in ((1, self._camera.height), (0, self._camera.width)):
            numbers = _GRID_STEP * np.flatnonzero(near.any(axis=axis))
            sides += [int(numbers[0]), min(int(numbers[-1]) + _GRID_STEP, size)]
        return sides[0], sides[1], sides[2], sides[3]

    def _earth_patch(self, earth: EarthLimb, attitude: Attitude) -> list[Patch]:
        """Return the Earth's disc and its glow; nothing if it is outside the image.

        The disc is as bright as the cosine of the Sun's zenith distance where the line of sight meets a sphere.
        """
        nadir = attitude.to_sensor(earth.direction)
        box = self._box_around(nadir, self._reach_rad(earth))
        if box is None:
            return []
        top, bottom, left, right = box
        light = np.zeros((bottom - top, right - left), dtype=np.float32)
        passed = np.ones_like(light)
        zero, one = np.float32(0.0), np.float32(1.0)
        distance = np.float32(1.0 / sin(earth.radius_rad))
        sun = None if earth.sun_direction is None else attitude.to_sensor(earth.sun_direction)
        behind = one if sun is None else np.float32(-float(distance) * dot(nadir, sun))
        full = np.float32(self._earthlight(earth))
        end, edge, step, limb_of = self._limb(earth)
        for rows in row_blocks(0, bottom - top, right - left):
            directions = self._directions[:, top + rows.start : top + rows.stop, left:right]
            cosine = scalar_products(directions, nadir)
            if not (cosine >= end).any():
                continue
            shade = np.full_like(cosine, behind)
            if sun is not None:
                depth = cosine * cosine
                depth -= one
                depth *= distance * distance
                depth += one
                along = distance * cosine
                along -= np.sqrt(np.maximum(depth, zero, out=depth))
                along *= scalar_products(directions, sun)
                shade += along
                np.clip(shade, zero, one, out=shade)
            shade *= full
            inside = cosine >= edge
            light[rows] = np.where(inside, shade, zero)
            passed[rows] = ~inside
            limb = np.flatnonzero((cosine >= end) & ~inside)
            place = (cosine.ravel()[limb] - end) / step
            node = place.astype(np.int64)
            place -= node
            lower, upper = limb_of[:, node], limb_of[:, node + 1]
            share, glow = lower + place * (upper - lower)
            passed[rows].reshape(-1)[limb] = share
            light[rows].reshape(-1)[limb] = shade.ravel()[limb] * glow
        return [Patch(box, light, passed)]

    def _limb(self, earth: EarthLimb) -> tuple[np.float32, np.float32, np.float32, Image]:
        """Return a table (2, n) of the limb by the cosine of the angle from the Earth's centre.

        It has the share of light that passes, and the brightness relative to the disc's, at equal steps of the cosine from the end of the
        glow to the edge of the disc, which come first, with the step.
        """
        height_rad = self._atmosphere_rad(earth)
        end = cos(min(earth.radius_rad + _GLOW_HEIGHTS * height_rad, math.pi))
        step = (cos(earth.radius_rad) - end) / _LIMB_STEPS
        angles = [acos(end + k * step) for k in range(_LIMB_STEPS)]
        heights = [*((angle - earth.radius_rad) / height_rad for angle in angles), 0.0, 0.0]
        table = [[min(height, 1.0) for height in heights], [exp(-height) for height in heights]]
        edge = np.float32(end + _LIMB_STEPS * step)
        return np.float32(end), edge, np.float32(step), np.array(table, dtype=np.float32)

    def _atmosphere_rad(self, earth: EarthLimb) -> float:
        """Return the angle over which the limb fades: the atmosphere's, but at least the width of a spot."""
        spot = _SPOT_SIGMAS * self._psf_sigma_px * self._camera.pixel_scale_rad
        return max(math.radians(earth.atmosphere_deg), spot)

    def _reach_rad(self, earth: EarthLimb) -> float:
        """Return the angle from the Earth's centre to which the glow of its limb reaches."""
        return earth.radius_rad + _GLOW_HEIGHTS * self._atmosphere_rad(earth)


@lru_cache(maxsize=4)
def _transmission_of(obstruction: Obstruction, width: int, height: int) -> Image:
    """Return the transmission (h, w) of an obstruction."""
    import cv2

    if obstruction.polygon_px:
        cover = np.ones((height, width), dtype=np.float32)
        corners = np.round(np.array(obstruction.polygon_px) * 16.0).astype(np.int32)
        cv2.fillPoly(cover, [corners], 0.0, cv2.LINE_8, 4)
    else:
        angle = math.radians(obstruction.angle_deg)
        x, y = np.arange(width) - 0.5 * (width - 1), np.arange(height) - 0.5 * (height - 1)
        along = (cos(angle) * x)[None, :] + (sin(angle) * y)[:, None]
        edge = np.quantile(along, 1.0 - obstruction.share)
        partial = 0.0 < obstruction.share < 1.0
        cover = (along <= edge if partial else np.full_like(along, obstruction.share == 0.0)).astype(
            np.float32
        )
    if obstruction.softness_px <= 0.0:
        return cover
    soft = cv2.GaussianBlur(cover, (0, 0), obstruction.softness_px, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(soft, dtype=np.float32)
