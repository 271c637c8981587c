"""The loops over pixels behind `starhil.emulator.sensor.sky.light`: glare, the discs of Moon and Earth, what is visible behind them."""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np

from starhil.emulator.sensor.sky.light_grid import GLARE_STEP, Image, Line, Sensitivity, expand
from starhil.emulator.sensor.sky.wide_earth import GLOW_HEIGHTS
from starid.arrays import Array, Array32
from starid.kernels.jit import compiled_ieee, inner

Glare: TypeAlias = tuple[Array32, float, float, bool]
"""Direction of a source in the sensor frame, strength, square of the softness, and whether it falls with the cube."""

Box: TypeAlias = tuple[int, int, int, int]
"""First row and the one after the last, and so the columns, of part of an image."""

NearGlare: TypeAlias = tuple[Box, Glare, Image, Image]
"""Where a source's glare is not smooth, the source, its glare on the grid, and the directions (3, h, w) of the pixels."""


@compiled_ieee
def transmission_at(passed: Image, box: Box, xy_px: Array) -> Array:
    """Return the transmission (n,) of the pixels nearest to positions (n, 2); 1 outside the box."""
    transmission = np.ones(len(xy_px))
    for i in range(transmission.size):
        row, column = int(np.rint(xy_px[i, 1])) - box[0], int(np.rint(xy_px[i, 0])) - box[2]
        if 0 <= row < passed.shape[0] and 0 <= column < passed.shape[1]:
            transmission[i] = passed[row, column]
    return transmission


@compiled_ieee
def cover_box(
    planes: tuple[Image, Image, Sensitivity],
    light: Image,
    passed: Image,
    box: Box,
    units: tuple[float, float],
    hides_glare: bool,
) -> None:
    """Put light and shadow in front of part of an image, in place.

    `planes` are the mean electrons and `still` and `sensitivity` of a `Backdrop`; `units` the exposure at a sensitivity of
    1, and the light of the sky.
    """
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
def add_glare(image: Image, directions: Image, source: Glare) -> None:
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
def refine_glare(mean: Image, sensitivity: Sensitivity, near: NearGlare, exposure_s: float) -> None:
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
def points_near(directions: Image, centre: Array32, cosine: float) -> tuple[int, int, int, int]:
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
def draw_moon(
    disc: Image,
    passed: Image,
    directions: Image,
    box: Box,
    axes: tuple[Array, tuple[float, float], Array],
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
def blurred(image: Image, taps: Line) -> Image:
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
def add_earth(
    electrons_s: Image,
    transmission: Image,
    directions: Image,
    nadir: Array,
    sun: Array,
    angles: tuple[float, float],
    brightness: float,
) -> None:
    """Put the Earth in front of light and sky, `light` and `passed` (h, w) of a `Patch`, in place.

    `directions` (3, h, w) are those of the pixels, `nadir` and `sun` (3,) those to the Earth's centre and to the Sun,
    all in the sensor frame; zeros instead of the Sun light all of the disc. `angles` are the angular radius of the
    disc, and the height over which its limb fades, radians. `brightness` is electrons/s per pixel where the Sun is in
    the zenith.
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
