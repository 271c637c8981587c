"""An Earth that covers much of the field, drawn from a coarse grid.

Each cell of the grid is one of four sorts, by what its corners are: clear sky, disc so bright that it saturates, disc
whose light is smooth, and limb, terminator or a disc seen at a grazing angle. Only those of the last sort are computed pixel
by pixel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from starhil.emulator.sensor.sky.light_grid import GLARE_STEP, Backdrop, Image, Sensitivity, expand
from starid.arrays import Array, Array32, Indices32
from starid.kernels.jit import compiled_ieee, inner

GLOW_HEIGHTS: Final = 20.0
"""Heights of the atmosphere above the limb up to which it glows."""

_MIN_E: Final = 0.05
"""Light of the atmosphere that is neglected, electrons."""

_ERROR_E: Final = 1.0
"""Largest error of light that is interpolated in a cell, electrons."""

_CLEAR: Final = 0
_BRIGHT: Final = 1
_SMOOTH: Final = 2
_DETAILED: Final = 3

Line = Array32
Gain = npt.NDArray[np.uint16]


@dataclass(frozen=True)
class WideEarth:
    """An Earth that covers much of the field, as smooth functions of the position in the image."""

    grid: Image
    """At every `GLARE_STEP`-th column and row: cosines of the angles to the Earth's centre and to the Sun, and the
    height above the limb in heights of the atmosphere, (3, gh, gw), float32."""
    distance: float
    """Distance of the Earth's centre in its radii."""
    behind: float
    """Cosine of the Sun's zenith distance at the point opposite to the nadir."""
    brightness: float
    """Electrons/s per pixel where the Sun is in the zenith."""
    step_rad: float

    def seen_at(self, xy_px: Array) -> Array:
        """Return the transmission (n,) of the atmosphere at positions (n, 2)."""
        height = self.grid[2]
        across, down = (xy_px / GLARE_STEP).T
        column = np.minimum(across.astype(np.int64), height.shape[1] - 2)
        row = np.minimum(down.astype(np.int64), height.shape[0] - 2)
        across, down = across - column, down - row
        upper = height[row, column] * (1.0 - across) + height[row, column + 1] * across
        lower = height[row + 1, column] * (1.0 - across) + height[row + 1, column + 1] * across
        seen: Array = np.clip(upper * (1.0 - down) + lower * down, 0.0, 1.0)
        return seen

    @property
    def covered_share(self) -> float:
        """Fraction of the cells of the grid that receive less than half of the sky's light."""
        return float(np.count_nonzero(self.grid[2, :-1, :-1] < 0.5) / self.grid[2, :-1, :-1].size)

    def cover(self, mean: Image, backdrop: Backdrop) -> None:
        """Put the Earth in front of the mean electrons (h, w), in place."""
        body = (self.distance, self.behind, self.brightness, self.step_rad)
        unit, exposure_s = backdrop.unit, backdrop.exposure_s
        light = (unit * backdrop.sky_e_s * exposure_s, exposure_s, unit, backdrop.saturated_e)
        _cover(mean, backdrop.still, backdrop.sensitivity, self.grid, body, light)


@inner
def _glow(height: Line, line: Line, first: int, last: int) -> None:
    """Brightness of the atmosphere relative to the disc's in some cells, from its height at every `GLARE_STEP`-th column."""
    for i in range(first, last):
        start, end = height[i], height[i + 1]
        if max(start, end) <= 0.0:
            line[i * GLARE_STEP : (i + 1) * GLARE_STEP] = 1.0
            continue
        share, ratio = math.exp(-start), math.exp((start - end) / GLARE_STEP)
        for x in range(i * GLARE_STEP, (i + 1) * GLARE_STEP):
            line[x] = min(share, 1.0)
            share *= ratio


@inner
def _shades(cosine: Line, lit: Line, shade: Line, emergent: Line, far: float, behind: float) -> None:
    """Cosines of the zenith distances of the Sun and of the observer where lines of sight meet a sphere of radius 1."""
    zero, one = np.float32(0.0), np.float32(1.0)
    distance, opposite = np.float32(far), np.float32(behind)
    far2 = distance * distance
    for i in range(cosine.size):
        emergent[i] = np.sqrt(max(one - far2 * (one - cosine[i] * cosine[i]), zero))
        shade[i] = opposite + (distance * cosine[i] - emergent[i]) * lit[i]


@inner
def _sort_cells(
    sorts: Indices32,
    heights: tuple[Line, Line],
    shades: tuple[Line, Line],
    emergents: tuple[Line, Line],
    light: tuple[float, float, float, float],
) -> None:
    """Sort the cells between two rows of the grid.

    `light` is of the disc with the Sun in the zenith, electrons; what saturates a pixel; the height that glow reaches; and the
    error of linear interpolation, which grows as the inverse cube of the cosine of the observer's zenith distance.
    """
    saturated, reach, error = (
        np.float32(light[1] / max(light[0], 1e-9)),
        np.float32(light[2]),
        np.float32(light[3] / _ERROR_E),
    )
    zero, one = np.float32(0.0), np.float32(1.0)
    (h, next_h), (s, next_s), (e, next_e) = heights, shades, emergents
    for i in range(sorts.size - 1):
        low = min(h[i], h[i + 1], next_h[i], next_h[i + 1])
        high = max(h[i], h[i + 1], next_h[i], next_h[i + 1])
        least = min(s[i], s[i + 1], next_s[i], next_s[i + 1])
        most = max(s[i], s[i + 1], next_s[i], next_s[i + 1])
        nearest = min(e[i], e[i + 1], next_e[i], next_e[i + 1])
        clear = (low > reach) | ((low > one) & (most <= zero))
        smooth = (most <= zero) | ((least >= zero) & (error < nearest * nearest * nearest))
        disc = _BRIGHT if least > saturated else (_SMOOTH if smooth else _DETAILED)
        sorts[i] = _CLEAR if clear else (_DETAILED if high > zero else disc)
    sorts[-1] = -1


@inner
def _draw_bright(
    to: Line, gain: Gain, shades: tuple[Line, Line], share: np.float32, full: np.float32
) -> None:
    """Draw a row of disc that saturates."""
    above, below = shades
    for x in range(to.size):
        to[x] = np.float32(gain[x]) * full * (above[x] + share * (below[x] - above[x]))


@inner
def _draw_smooth(
    to: Line,
    base: Line,
    gain: Gain,
    shades: tuple[Line, Line],
    share: np.float32,
    light: tuple[np.float32, np.float32],
) -> None:
    """Draw a row of disc whose shade is smooth."""
    above, below = shades
    full, sky = light
    zero = np.float32(0.0)
    for x in range(to.size):
        shade = max(above[x] + share * (below[x] - above[x]), zero)
        to[x] = max(base[x] + np.float32(gain[x]) * (full * shade - sky), zero)


@inner
def _draw_detailed(
    to: Line,
    base: Line,
    gain: Gain,
    planes: tuple[Line, Line, Line, Line, Line, Line, Line],
    share: np.float32,
    body: tuple[np.float32, np.float32, np.float32],
    sky: np.float32,
) -> None:
    """Draw a row pixel by pixel, from the planes of the grid above and below it, and the glow."""
    near, next_near, lit, next_lit, high, next_high, glow = planes
    far, behind, full = body
    zero, one = np.float32(0.0), np.float32(1.0)
    far2 = far * far
    for x in range(to.size):
        cosine = near[x] + share * (next_near[x] - near[x])
        along = far * cosine - np.sqrt(max(one - far2 * (one - cosine * cosine), zero))
        shade = behind + along * (lit[x] + share * (next_lit[x] - lit[x]))
        clear = min(max(high[x] + share * (next_high[x] - high[x]), zero), one)
        light = full * glow[x] * min(max(shade, zero), one)
        sensed = np.float32(gain[x])
        dark = base[x] - sensed * sky
        to[x] = max(dark + (to[x] - dark) * clear + sensed * light, zero)


@compiled_ieee
def _cover(
    mean: Image,
    still: Image,
    sensitivity: Sensitivity,
    grid: Image,
    body: tuple[float, float, float, float],
    light: tuple[float, float, float, float],
) -> None:
    """As `WideEarth.cover`, with the Earth's numbers, and those of the light."""
    distance, behind, brightness, step_rad = body
    full_e, saturated_e = brightness * light[1], light[3]
    rows, width = mean.shape
    points = grid.shape[2]
    reach = min(max(math.log(max(full_e, 1e-9) / _MIN_E), 1.0), GLOW_HEIGHTS)
    limits = (full_e, saturated_e, reach, full_e * (distance**2 - 1.0) * step_rad**2 / 4.0)
    full, sky = np.float32(full_e * light[2]), np.float32(light[0])
    shades, emergents = np.empty((2, points), dtype=np.float32), np.empty((2, points), dtype=np.float32)
    lines = np.empty((7, points * GLARE_STEP), dtype=np.float32)
    height, sorts = np.empty(points, dtype=np.float32), np.empty(points, dtype=np.int32)
    _shades(grid[0, 0], grid[1, 0], shades[0], emergents[0], distance, behind)
    for band in range((rows + GLARE_STEP - 1) // GLARE_STEP):
        up, low = band % 2, 1 - band % 2
        upper = (grid[0, band], grid[1, band], grid[2, band])
        lower = (grid[0, band + 1], grid[1, band + 1], grid[2, band + 1])
        _shades(lower[0], lower[1], shades[low], emergents[low], distance, behind)
        pairs = (shades[up], shades[low]), (emergents[up], emergents[low])
        _sort_cells(sorts, (upper[2], lower[2]), pairs[0], pairs[1], limits)
        last = 0
        while last < points - 1:
            first, sort = last, sorts[last]
            while sorts[last] == sort:
                last += 1
            if sort == _CLEAR:
                continue
            run = slice(first * GLARE_STEP, min(last * GLARE_STEP, width))
            for k in range(3 if sort == _DETAILED else 1):
                expand(upper[k] if sort == _DETAILED else shades[up], lines[2 * k], first, last)
                expand(lower[k] if sort == _DETAILED else shades[low], lines[2 * k + 1], first, last)
            a, b, c, d = lines[0, run], lines[1, run], lines[2, run], lines[3, run]
            planes = (a, b, c, d, lines[4, run], lines[5, run], lines[6, run])
            for y in range(band * GLARE_STEP, min((band + 1) * GLARE_STEP, rows)):
                share = np.float32(y % GLARE_STEP) / np.float32(GLARE_STEP)
                to, base, gain = mean[y, run], still[y, run], sensitivity[y, run]
                if sort == _BRIGHT:
                    _draw_bright(to, gain, (a, b), share, full)
                elif sort == _SMOOTH:
                    _draw_smooth(to, base, gain, (a, b), share, (full, sky))
                else:
                    height[:] = upper[2] + share * (lower[2] - upper[2])
                    _glow(height, lines[6], first, last)
                    _draw_detailed(
                        to, base, gain, planes, share, (np.float32(distance), np.float32(behind), full), sky
                    )
