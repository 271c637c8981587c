"""Light and shadow over areas of an image: Sun, Moon, Earth and obstructions."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Final, TypeAlias

import numpy as np
import numpy.typing as npt

from starhil.emulator.sky.field import disc_in_field
from starhil.emulator.sky.light_grid import GLARE_STEP, Backdrop, Image, Sensitivity, expand, fill
from starhil.emulator.sky.objects import CelestialBody, EarthLimb, Moon, Obstruction, SkyObjects, SunGlare
from starhil.emulator.sky.wide_earth import GLOW_HEIGHTS, WideEarth
from starid.attitude import Attitude
from starid.camera import Camera
from starid.jit import compiled_ieee, inner

Glare: TypeAlias = tuple[npt.NDArray[np.float32], float, float, bool]
"""Direction of a source in the sensor frame, strength, square of the softness, and whether it falls with the cube."""

Line: TypeAlias = npt.NDArray[np.float32]

Box: TypeAlias = tuple[int, int, int, int]
"""First row and the one after the last, and so the columns, of part of an image."""

NearGlare: TypeAlias = tuple[Box, Glare, Image, Image]
"""Where a source's glare is not smooth, the source, its glare on the grid, and the directions (3, h, w) of the pixels."""

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
    """Light and shadow in part of an image.

    Attributes
    ----------
    box : (int, int, int, int)
        Its rows and columns.
    light : ndarray (h', w'), float32
        Electrons/s in a pixel of mean sensitivity.
    passed : ndarray (h', w'), float32
        Fraction of the light from behind that is visible, 0…1.
    hides_glare : bool
        Whether it is in front of the light scattered in the lens too.
    """

    box: Box
    light: Image
    passed: Image
    hides_glare: bool = True

    def seen_at(self, xy_px: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Return the transmission (n,) of the pixels nearest to positions (n, 2)."""
        return _nearest(self.passed, self.box, xy_px)

    def cover(self, mean: Image, backdrop: Backdrop) -> None:
        """Put it in front of the mean electrons (h, w), in place."""
        light = backdrop.unit * backdrop.exposure_s, backdrop.sky_e_s
        planes = mean, backdrop.still, backdrop.sensitivity
        _cover(planes, self.light, self.passed, self.box, light, self.hides_glare)


@dataclass(frozen=True)
class AreaLight:
    """Light of extended objects, and the fraction of the sky's light that passes them.

    Attributes
    ----------
    size : (int, int)
        Width and height of the image, pixels.
    glare : ndarray (gh, gw), float32, or None
        Smooth light in electrons/s in a pixel of mean sensitivity, at every `GLARE_STEP`-th column and row.
    near : tuple of NearGlare
        What is not smooth of that light.
    earth : WideEarth or None
        An Earth in front of `glare`, sky and the patches before the last `in_front`.
    behind, in_front : tuple of Patch
        What lies behind and in front of that Earth.
    flooded : bool
        Light passes the baffle and saturates the image; the rest is then empty.
    """

    size: tuple[int, int]
    glare: Image | None = None
    near: tuple[NearGlare, ...] = ()
    earth: WideEarth | None = None
    behind: tuple[Patch, ...] = ()
    in_front: tuple[Patch, ...] = ()
    flooded: bool = False

    def seen_at(self, xy_px: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Return the transmission (n,) at positions (n, 2); outside the image that of its edge."""
        seen = np.full(len(xy_px), 0.0 if self.flooded else 1.0)
        if self._layers:
            nearest = np.clip(xy_px, 0.0, np.array(self.size) - 1.0)
            for layer in self._layers:
                seen *= layer.seen_at(nearest)
        return seen

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
            _refine_glare(mean, backdrop.sensitivity, near, backdrop.unit * backdrop.exposure_s)
        for layer in self._layers:
            layer.cover(mean, backdrop)


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


@compiled_ieee
def _nearest(passed: Image, box: Box, xy_px: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """As `Patch.seen_at`."""
    seen = np.ones(len(xy_px))
    for i in range(seen.size):
        row, column = int(np.rint(xy_px[i, 1])) - box[0], int(np.rint(xy_px[i, 0])) - box[2]
        if 0 <= row < passed.shape[0] and 0 <= column < passed.shape[1]:
            seen[i] = passed[row, column]
    return seen


@compiled_ieee
def _cover(
    planes: tuple[Image, Image, Sensitivity],
    light: Image,
    passed: Image,
    box: Box,
    units: tuple[float, float],
    hides_glare: bool,
) -> None:
    """As `Patch.cover`, with the exposure at a sensitivity of 1, and the light of the sky."""
    unit, sky_e_s = np.float32(units[0]), np.float32(units[1])
    zero, one = np.float32(0.0), np.float32(1.0)
    run = slice(box[2], box[3])
    for y in range(light.shape[0]):
        row = box[0] + y
        to, base, gain = planes[0][row, run], planes[1][row, run], planes[2][row, run]
        for x in range(to.size):
            sensed = np.float32(gain[x]) * unit
            sky = sensed * sky_e_s
            dark = base[x] - sky
            through = (
                dark + (to[x] - dark) * passed[y, x] if hides_glare else to[x] - sky * (one - passed[y, x])
            )
            to[x] = max(through + sensed * light[y, x], zero)


@inner
def _glare_at(chord2: np.float32, factor: np.float32, cube: bool) -> np.float32:
    """Glare at a squared chord with the squared softness added."""
    return factor / (chord2 * np.sqrt(chord2) if cube else chord2)


@compiled_ieee
def _add_glare(image: Image, directions: Image, source: Glare) -> None:
    """Add strength/(chord² + soft²), or its power 3/2, over the angle (as chord) between directions and a source."""
    towards, strength, soft2, cube = source
    a, b, c = towards[0], towards[1], towards[2]
    factor, soft = np.float32(strength), np.float32(soft2)
    for y in range(image.shape[0]):
        row, dx, dy, dz = image[y], directions[0, y], directions[1, y], directions[2, y]
        for x in range(row.size):
            u, v, w = dx[x] - a, dy[x] - b, dz[x] - c
            row[x] += _glare_at(u * u + v * v + w * w + soft, factor, cube)


@compiled_ieee
def _refine_glare(mean: Image, sensitivity: Sensitivity, near: NearGlare, exposure_s: float) -> None:
    """Replace interpolated glare by that of each pixel, at an exposure for a sensitivity of 1."""
    (top, bottom, left, right), (towards, strength, soft2, cube), grid, directions = near
    run = slice(left, right)
    a, b, c = towards[0], towards[1], towards[2]
    factor, soft, exposure = np.float32(strength), np.float32(soft2), np.float32(exposure_s)
    lines = np.empty((2, (grid.shape[1] - 1) * GLARE_STEP), dtype=np.float32)
    cells = (left // GLARE_STEP, -(-right // GLARE_STEP))
    above, below = lines[0, run], lines[1, run]
    for band in range(top // GLARE_STEP, -(-bottom // GLARE_STEP)):
        expand(grid[band], lines[0], cells[0], cells[1])
        expand(grid[band + 1], lines[1], cells[0], cells[1])
        for y in range(band * GLARE_STEP, min((band + 1) * GLARE_STEP, bottom)):
            to, gain, share = mean[y, run], sensitivity[y, run], np.float32(y % GLARE_STEP / GLARE_STEP)
            dx, dy, dz = directions[0, y, run], directions[1, y, run], directions[2, y, run]
            for x in range(to.size):
                u, v, w = dx[x] - a, dy[x] - b, dz[x] - c
                exact = _glare_at(u * u + v * v + w * w + soft, factor, cube)
                coarse = above[x] + share * (below[x] - above[x])
                to[x] += np.float32(gain[x]) * exposure * (exact - coarse)


@compiled_ieee
def _points_near(
    directions: Image, centre: npt.NDArray[np.float32], cosine: float
) -> tuple[int, int, int, int]:
    """First and last row and column of directions (3, h, w) within an angle of a centre; the last before the first if none."""
    a, b, c, least = centre[0], centre[1], centre[2], np.float32(cosine)
    height, width = directions.shape[1:]
    top, bottom, left, right = height, -1, width, -1
    near = np.empty(width, dtype=np.bool_)
    for y in range(height):
        dx, dy, dz = directions[0, y], directions[1, y], directions[2, y]
        hits = 0
        for x in range(width):
            near[x] = a * dx[x] + b * dy[x] + c * dz[x] >= least
            hits += near[x]
        if hits:
            top, bottom = min(top, y), y
            for x in range(width):
                if near[x]:
                    left, right = min(left, x), max(right, x)
    return top, bottom, left, right


@compiled_ieee
def _draw_moon(
    disc: Image,
    passed: Image,
    directions: Image,
    box: Box,
    axes: tuple[npt.NDArray[np.float64], tuple[float, float], npt.NDArray[np.float64]],
    shape: tuple[float, float, float],
) -> None:
    """Draw the disc with the terminator, and what is visible behind it.

    `axes` are the directions (2, 3) to north and east, cosine and sine of the position angle of the bright limb over the radius,
    and the direction (3,) of the centre, sensor frame. `shape` is the radius, pixels, the illuminated fraction and the
    brightness of a pixel.
    """
    north, east, (along, sideways), source = axes[0][0], axes[0][1], axes[1], axes[2]
    radius, illuminated, brightness = shape
    terminator = 1.0 - 2.0 * illuminated
    run = slice(box[2], box[3])
    for y in range(disc.shape[0]):
        row = box[0] + y
        dx, dy, dz = directions[0, row, run], directions[1, row, run], directions[2, row, run]
        for x in range(dx.size):
            up = north[0] * dx[x] + north[1] * dy[x] + north[2] * dz[x]
            left = east[0] * dx[x] + east[1] * dy[x] + east[2] * dz[x]
            ahead = source[0] * dx[x] + source[1] * dy[x] + source[2] * dz[x]
            u, v = along * up + sideways * left, along * left - sideways * up
            inside = (
                min(max(0.5 + (1.0 - math.sqrt(u * u + v * v)) * radius, 0.0), 1.0) if ahead > 0.0 else 0.0
            )
            edge = terminator * math.sqrt(max(1.0 - v * v, 0.0))
            disc[y, x] = inside * min(max(0.5 + (u - edge) * radius, 0.0), 1.0) * brightness
            passed[y, x] = 1.0 - inside


@compiled_ieee
def _blurred(image: Image, taps: Line) -> Image:
    """Return an image convolved with weights (2 m + 1,) along both axes; beyond its edge it goes on as it is there."""
    height, width = image.shape
    reach = taps.size // 2
    out, line = np.zeros_like(image), np.empty(width + 2 * reach, dtype=np.float32)
    inside = line[reach : reach + width]
    for y in range(height):
        inside[:] = 0.0
        for k in range(taps.size):
            row = image[min(max(y + k - reach, 0), height - 1)]
            for x in range(width):
                inside[x] += taps[k] * row[x]
        line[:reach], line[reach + width :] = inside[0], inside[-1]
        for k in range(taps.size):
            shifted, to = line[k : k + width], out[y]
            for x in range(width):
                to[x] += taps[k] * shifted[x]
    return out


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
        `light` and `passed` of a `Patch`.
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
    def _spot_taps(self) -> Line:
        """Weights (2 m + 1,) of a Gaussian as wide as a spot."""
        reach = math.ceil(_BLUR_SIGMAS * self._psf_sigma_px)
        weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / self._psf_sigma_px) ** 2)
        return np.asarray(weights / weights.sum(), dtype=np.float32)

    @property
    def _size(self) -> tuple[int, int]:
        return self._camera.width, self._camera.height

    def _directions_of(self, columns: npt.NDArray[np.int64], rows: npt.NDArray[np.int64]) -> Image:
        x, y = np.meshgrid(columns, rows)
        vectors = self._camera.back_project(np.column_stack([x.ravel(), y.ravel()]).astype(np.float64))
        vectors[np.isnan(vectors).any(axis=1)] = (0.0, 0.0, -1.0)
        return np.ascontiguousarray(vectors.T.reshape(3, rows.size, columns.size), dtype=np.float32)

    def paint(self, objects: SkyObjects, attitude: Attitude) -> AreaLight:
        """Return light and transmission of all extended objects at one attitude."""
        if baffle_passed(objects, attitude):
            return AreaLight(self._size, flooded=True)
        glare, near = self._glare(objects, attitude)
        behind = () if objects.moon is None else self._moon_patch(objects.moon, attitude)
        earth: WideEarth | None = None
        in_front: list[Patch] = []
        if objects.earth is not None and self._in_reach(objects.earth, attitude):
            if objects.earth.radius_deg >= _WIDE_EARTH_DEG:
                earth = self._wide_earth(objects.earth, attitude)
            else:
                in_front = self._small_earth(objects.earth, attitude)
        covers = [self._obstruction_transmission(obstruction) for obstruction in objects.obstructions]
        if objects.blank:
            covers.append(np.zeros(self._size[::-1], dtype=np.float32))
        everything = (0, self._camera.height, 0, self._camera.width)
        in_front += [Patch(everything, np.zeros_like(cover), cover) for cover in covers]
        return AreaLight(self._size, glare, near, earth, behind, tuple(in_front))

    def _glare(self, objects: SkyObjects, attitude: Attitude) -> tuple[Image | None, tuple[NearGlare, ...]]:
        """Return the glare of Sun and Moon on the grid, and near them."""
        glare, near = None, []
        grid, smooth_rad = self._grid_directions, _SMOOTH_PX * self._camera.pixel_scale_rad
        for body in (objects.sun, objects.moon):
            if body is None:
                continue
            off_axis = _off_axis_deg(attitude, body)
            if off_axis > body.reach_deg:
                continue
            strength, soft, cube = self._glare_of(body)
            direction = attitude.to_sensor(body.direction)
            source: Glare = (direction.astype(np.float32), strength, soft * soft, cube)
            light = np.zeros(grid.shape[1:], dtype=np.float32)
            _add_glare(light, grid, source)
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
            return body.electrons_s * reference**3, soft, True
        share = body.glare_share / (2.0 * math.pi * math.log(_GLARE_TO_DEG / _GLARE_FROM_DEG))
        total = self._moonlight(body)
        return total * share * self._camera.pixel_scale_rad**2, math.radians(_GLARE_FROM_DEG), False

    def _moonlight(self, moon: Moon) -> float:
        """Electrons/s from the whole Moon."""
        return self._zero_magnitude_e_s * math.pow(10.0, -0.4 * moon.magnitude)

    def _moon_patch(self, moon: Moon, attitude: Attitude) -> tuple[Patch, ...]:
        """Return the Moon's disc with the terminator; nothing if it is outside the image."""
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
        shape = (scale, moon.illuminated, self._moonlight(moon) / area)
        disc, passed = np.empty((2, box[1] - box[0], box[3] - box[2]), dtype=np.float32)
        _draw_moon(disc, passed, self._directions, box, (axes, turn, source), shape)
        return (Patch(box, _blurred(disc, self._spot_taps), passed, hides_glare=False),)

    def _box_around(self, direction: npt.NDArray[np.float64], radius_rad: float) -> Box | None:
        """Return the part of the image that holds a disc in the sensor frame; None if it is outside."""
        reach_rad = radius_rad + 1.25 * GLARE_STEP * self._camera.pixel_scale_rad
        if math.acos(max(min(float(direction[2]), 1.0), -1.0)) > self._camera.field_radius_rad + reach_rad:
            return None
        cosine = math.cos(min(reach_rad, math.pi))
        top, bottom, left, right = _points_near(self._grid_directions, direction.astype(np.float32), cosine)
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
        _add_earth(light, passed, directions, nadir, sun, angles, earth.electrons_s)
        return [Patch(box, light, passed)]

    def _wide_earth(self, earth: EarthLimb, attitude: Attitude) -> WideEarth:
        """Return the Earth on the grid."""
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
        return WideEarth(grid, distance, behind, earth.electrons_s, step_rad)

    def _earth_and_sun(
        self, earth: EarthLimb, attitude: Attitude
    ) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
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

    def _in_reach(self, earth: EarthLimb, attitude: Attitude) -> bool:
        """Whether the Earth or the glow of its limb reaches into the field."""
        return disc_in_field(attitude.to_sensor(earth.direction), self._reach_rad(earth), self._camera)

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
