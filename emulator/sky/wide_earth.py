"""An Earth that covers much of the field, drawn from a coarse grid."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from starhil.emulator.sky.light_grid import GLARE_STEP, Image, expand
from starid.jit import compiled_ieee

GLOW_HEIGHTS: Final = 20.0
"""Heights of the atmosphere above the limb up to which it glows."""


@dataclass(frozen=True)
class WideEarth:
    """An Earth that covers much of the field, as smooth functions of the position in the image.

    Attributes
    ----------
    grid : ndarray (3, gh, gw), float32
        At every `GLARE_STEP`-th column and row: cosines of the angles to the Earth's centre and to the Sun, and the height
        above the limb in heights of the atmosphere.
    distance : float
        Distance of the Earth's centre in its radii.
    behind : float
        Cosine of the Sun's zenith distance at the point opposite to the nadir.
    brightness : float
        Electrons/s per pixel where the Sun is in the zenith.
    """

    grid: Image
    distance: float
    behind: float
    brightness: float

    def seen_at(self, xy_px: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Return the transmission (n,) of the atmosphere at positions (n, 2)."""
        height = self.grid[2]
        limits = np.array(height.shape)[::-1] - 2
        cell = np.clip(np.floor(xy_px / GLARE_STEP), 0, limits).astype(np.int64)
        along, down = (xy_px / GLARE_STEP - cell).T
        column, row = cell.T
        upper = height[row, column] * (1.0 - along) + height[row, column + 1] * along
        lower = height[row + 1, column] * (1.0 - along) + height[row + 1, column + 1] * along
        seen: npt.NDArray[np.float64] = np.clip(upper * (1.0 - down) + lower * down, 0.0, 1.0)
        return seen

    @property
    def covered_share(self) -> float:
        """Fraction of the cells of the grid that receive less than half of the sky's light."""
        return float(np.mean(self.grid[2, :-1, :-1] < 0.5))


@compiled_ieee
def _glow(height: npt.NDArray[np.float32], line: npt.NDArray[np.float32]) -> None:
    """Brightness of the atmosphere relative to the disc's, from its height at every `GLARE_STEP`-th column."""
    line[:] = 1.0
    for i in range(height.size - 1):
        first, last = height[i], height[i + 1]
        if max(first, last) <= 0.0:
            continue
        start, end = i * GLARE_STEP, min((i + 1) * GLARE_STEP, line.size)
        if min(first, last) > GLOW_HEIGHTS:
            line[start:end] = 0.0
            continue
        share, ratio = math.exp(-first), math.exp((first - last) / GLARE_STEP)
        for x in range(start, end):
            line[x] = min(share, 1.0)
            share *= ratio


def add_earth(
    mean: Image, still: Image, sensitivity: Image, earth: WideEarth, sky_e_s: float, exposure_s: float
) -> None:
    """Put a wide Earth in front of the mean electrons (h, w), in place.

    `still` is `mean` without the glare of Sun and Moon: sky and dark current.
    """
    body = (earth.distance, earth.behind, earth.brightness)
    _add_wide_earth(mean, still, sensitivity, earth.grid, body, sky_e_s, exposure_s)


@compiled_ieee
def _add_wide_earth(
    mean: Image,
    still: Image,
    sensitivity: Image,
    grid: Image,
    body: tuple[float, float, float],
    sky_e_s: float,
    exposure_s: float,
) -> None:
    """As `add_earth`, with the Earth's grid, and its distance, `behind` and brightness."""
    width = mean.shape[1]
    upper, lower = np.empty((3, width), dtype=np.float32), np.empty((3, width), dtype=np.float32)
    for k in range(3):
        expand(grid[k, 0], lower[k])
    height = np.empty(grid.shape[2], dtype=np.float32)
    light, glow = np.empty(width, dtype=np.float32), np.empty(width, dtype=np.float32)
    zero, one = np.float32(0.0), np.float32(1.0)
    far, far2, behind = np.float32(body[0]), np.float32(body[0] * body[0]), np.float32(body[1])
    full, sky, exposure = np.float32(body[2]), np.float32(sky_e_s), np.float32(exposure_s)
    for y in range(mean.shape[0]):
        cell, share = y // GLARE_STEP, np.float32(y % GLARE_STEP) / np.float32(GLARE_STEP)
        if y % GLARE_STEP == 0:
            upper, lower = lower, upper
            nearest = min(np.min(grid[2, cell]), np.min(grid[2, cell + 1]))
            for k in range(3):
                expand(grid[k, cell + 1], lower[k])
        if nearest > GLOW_HEIGHTS:
            continue
        for i in range(height.size):
            height[i] = grid[2, cell, i] + share * (grid[2, cell + 1, i] - grid[2, cell, i])
        _glow(height, glow)
        near, next_near = upper[0], lower[0]
        lit, next_lit = upper[1], lower[1]
        for x in range(width):
            # brightness by the Sun's zenith distance where the line of sight meets a sphere of radius 1
            cosine = near[x] + share * (next_near[x] - near[x])
            along = far * cosine - np.sqrt(max(one - far2 * (one - cosine * cosine), zero))
            shade = behind + along * (lit[x] + share * (next_lit[x] - lit[x]))
            light[x] = full * glow[x] * min(max(shade, zero), one)
        high, next_high = upper[2], lower[2]
        to, base, gain = mean[y], still[y], sensitivity[y]
        for x in range(width):
            clear = min(max(high[x] + share * (next_high[x] - high[x]), zero), one)
            sensed = gain[x] * exposure
            dark = base[x] - sensed * sky
            to[x] = max(dark + (to[x] - dark) * clear + sensed * light[x], zero)
