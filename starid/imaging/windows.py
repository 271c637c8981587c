"""Windows around candidates: their size, the sky under them and their pixels."""

from __future__ import annotations

import math
from typing import Final, Protocol

import numpy as np
import numpy.typing as npt

from starid.arithmetic.arrays import Array, Array32, GreyImage, Indices32, Records, record_type
from starid.arithmetic.elementary import cos, log, sin
from starid.imaging.background import MIN_NOISE_DN, interpolate_at
from starid.imaging.centroid import relative_width
from starid.imaging.trail_flow import trail_at
from starid.kernels.jit import compiled_ieee


class Window(Protocol):
    """Window around a candidate, a record of `WINDOW`.

    Attributes
    ----------
    left, top, columns, rows : int
        Position and size, pixels; `columns` of a candidate without a window is the reason.
    offset : int
        Start of its pixels among those of all windows.
    start_x, start_y : float
        First guess of the star's position, image pixels.
    base, noise : float
        Sky at the first guess, and noise of a pixel, counts.
    sigma : float
        Standard deviation of the spot there, pixels.
    patch : float
        Half-width of the saturated patch, pixels.
    trail_x, trail_y : float
        Trail, pixels.
    radius_x, radius_y : int
        Half-widths before the edges of the image cut the window, pixels.
    """

    left: int
    top: int
    columns: int
    rows: int
    offset: int
    start_x: float
    start_y: float
    base: float
    noise: float
    sigma: float
    patch: float
    trail_x: float
    trail_y: float
    radius_x: int
    radius_y: int


WINDOW: Final = record_type(Window)

LARGEST_HALF_WIDTH: Final = 40
"""Largest half-width of a window, pixels."""

MAX_SATURATED: Final = 400
"""An object with this many connected saturated pixels or more is not a star."""

PATCH_REACH: Final = 40
"""Largest distance of the saturated patch of a star from its peak, pixels."""

MIN_SPREAD_PX: Final = 0.5
"""Smallest standard deviation of a spot, pixels, for the light of a star to reach more than one pixel."""

EXTENDED: Final = -1
DUPLICATE: Final = -2
NO_ROOM: Final = -3
ONE_PIXEL: Final = -4
"""`columns` of candidates without a window."""

_MAX_PATCHES: Final = 1000
_RING_PIXELS: Final = 48
_RING: Final = np.array(
    [[each(2.0 * math.pi * k / _RING_PIXELS) for k in range(_RING_PIXELS)] for each in (cos, sin)]
)
_RING_SHIFT_SIGMA: Final = 0.6
_BLOCK_OF_MORE_THAN_SKY: Final = 1.5
_RING_OF_MORE_THAN_SKY: Final = 2.0
_QUARTILE_SIGMA: Final = 1.349
_MIN_REACH_SIGMA: Final = 2.5
_MAX_REACH_SIGMA: Final = 6.0
_VISIBLE_NOISE: Final = 0.33
_ALONE_SIGMA: Final = 8.0
_ALONE_SHARE: Final = 0.125


@compiled_ieee
def light_radius(sigma: float, flux: float, noise: float) -> int:
    """Half-width of the square where a star exceeds a third of the pixel noise, at least 2.5 sigma."""
    peak = flux / (2.0 * math.pi * sigma * sigma)
    ratio = max(peak / (_VISIBLE_NOISE * noise), 1.0)
    reach = max(_MIN_REACH_SIGMA, min(math.sqrt(2.0 * log(ratio)), _MAX_REACH_SIGMA))
    return min(max(math.ceil(reach * sigma + 0.5), 2), LARGEST_HALF_WIDTH)


@compiled_ieee
def _slopes(level: Array32, block: float, x: float, y: float) -> tuple[float, float]:
    """Slopes of the background along x and y, counts per pixel."""
    return (
        0.5 * (interpolate_at(level, block, x + 1.0, y) - interpolate_at(level, block, x - 1.0, y)),
        0.5 * (interpolate_at(level, block, x, y + 1.0) - interpolate_at(level, block, x, y - 1.0)),
    )


@compiled_ieee
def _ring_statistics(
    image: GreyImage,
    x: int,
    y: int,
    radius_x: int,
    radius_y: int,
    slopes: tuple[float, float],
    values: Array,
) -> tuple[float, float]:
    """Mean of the middle half, and standard deviation from the quartiles, of pixels on a ring around a window.

    The slopes of the sky along x and y are subtracted first.
    """
    height, width = image.shape
    count = 0
    for k in range(_RING_PIXELS):
        out = 1.5 if k % 2 == 0 else 3.0
        column = x + math.floor((radius_x + out) * _RING[0, k] + 0.5)
        row = y + math.floor((radius_y + out) * _RING[1, k] + 0.5)
        if 0 <= column < width and 0 <= row < height:
            key = image[row, column] - slopes[0] * (column - x) - slopes[1] * (row - y)
            j = count - 1
            while j >= 0 and values[j] > key:
                values[j + 1] = values[j]
                j -= 1
            values[j + 1] = key
            count += 1
    if count < _RING_PIXELS // 4:
        return math.nan, math.nan
    low, high = count // 4, (3 * count) // 4
    total = 0.0
    for k in range(low, high):
        total += values[k]
    return total / (high - low), (values[high] - values[low]) / _QUARTILE_SIGMA


@compiled_ieee
def _saturated_patch(
    image: GreyImage,
    x: int,
    y: int,
    saturation: float,
    visited: npt.NDArray[np.uint8],
    stack: Indices32,
    patch: Array,
) -> bool:
    """Follow the connected saturated pixels from (x, y); False if they are too many or too far for a star.

    Fills `patch` (7,) with their mean column and row, half their larger extent, and their first and last column and
    row. `visited` is workspace of (2·PATCH_REACH + 1)².
    """
    height, width = image.shape
    visited[:] = 0
    visited[PATCH_REACH, PATCH_REACH] = 1
    stack[0, 0], stack[0, 1] = x, y
    waiting, count = 1, 0
    total_x = total_y = 0.0
    left, right, top, bottom = x, x, y, y
    while waiting > 0:
        waiting -= 1
        column, row = stack[waiting, 0], stack[waiting, 1]
        count += 1
        if count >= MAX_SATURATED or max(abs(column - x), abs(row - y)) >= PATCH_REACH:
            return False
        total_x += column
        total_y += row
        left, right = min(left, column), max(right, column)
        top, bottom = min(top, row), max(bottom, row)
        for b in range(max(row - 1, 0), min(row + 2, height)):
            for a in range(max(column - 1, 0), min(column + 2, width)):
                i, j = a - x + PATCH_REACH, b - y + PATCH_REACH
                if visited[j, i] == 0 and image[b, a] >= saturation and waiting < stack.shape[0]:
                    visited[j, i] = 1
                    stack[waiting, 0], stack[waiting, 1] = a, b
                    waiting += 1
    patch[0], patch[1] = total_x / count, total_y / count
    patch[2] = 0.5 * (max(right - left, bottom - top) + 1)
    patch[3], patch[4], patch[5], patch[6] = left, right, top, bottom
    return True


@compiled_ieee
def _in_patches(column: int, row: int, patches: Array, count: int) -> bool:
    """Whether a pixel is in the bounding box of an earlier patch."""
    for k in range(count):
        if patches[k, 3] <= column <= patches[k, 4] and patches[k, 5] <= row <= patches[k, 6]:
            return True
    return False


@compiled_ieee
def _sky_under(
    around: float, spread: float, base: float, noise: float, typical_noise: float
) -> tuple[float, float]:
    """Sky and noise under a star, from its ring (NaN if there is none) and from the grid of blocks.

    The grid has the smaller error; the ring is used if they disagree, as in stray light or near a bright limb.
    """
    if spread != spread:
        return base, noise
    if noise > _BLOCK_OF_MORE_THAN_SKY * typical_noise:
        noise = max(spread, typical_noise)
    elif spread > _RING_OF_MORE_THAN_SKY * noise:
        noise = spread
    if abs(around - base) > _RING_SHIFT_SIGMA * noise + 0.5 * MIN_NOISE_DN:
        base = around
    return base, noise


@compiled_ieee
def _first_position(image: GreyImage, column: int, row: int, sky: float) -> tuple[float, float]:
    """Guess a star's position: 1.5 times the offset of the centroid of the 3 × 3 pixels around its peak."""
    height, width = image.shape
    if not (0 < column < width - 1 and 0 < row < height - 1):
        return float(column), float(row)
    total = 1e-6
    x = y = 0.0
    for dy in range(-1, 2):
        for dx in range(-1, 2):
            light = max(float(image[row + dy, column + dx]) - sky, 0.0)
            total += light
            x += light * dx
            y += light * dy
    return column + min(max(1.5 * x / total, -0.7), 0.7), row + min(max(1.5 * y / total, -0.7), 0.7)


@compiled_ieee
def _stands_alone(image: GreyImage, column: int, row: int, sky: float, noise: float) -> bool:
    """Whether a pixel is hot: bright, with no neighbour as bright as an eighth of it."""
    height, width = image.shape
    peak = image[row, column] - sky
    if peak < _ALONE_SIGMA * noise:
        return False
    for b in range(max(row - 1, 0), min(row + 2, height)):
        for a in range(max(column - 1, 0), min(column + 2, width)):
            if (a != column or b != row) and image[b, a] - sky > _ALONE_SHARE * peak:
                return False
    return True


@compiled_ieee
def sky_under_lone_pixels(
    image: GreyImage, peaks: Indices32, level: Array32, noise: Array32, block: float, sky: Array
) -> None:
    """Fill `sky` (n,) with the background under peaks (n, 2) that are hot pixels, and NaN for the others."""
    for k in range(peaks.shape[0]):
        column, row = peaks[k, 0], peaks[k, 1]
        x, y = float(column), float(row)
        base = interpolate_at(level, block, x, y)
        alone = _stands_alone(image, column, row, base, interpolate_at(noise, block, x, y))
        sky[k] = base if alone else math.nan


@compiled_ieee
def lay_windows(
    image: GreyImage,
    peaks: Indices32,
    flux: Array32,
    level: Array32,
    noise: Array32,
    block: float,
    spot: tuple[float, float, float, float],
    flow: Array,
    windows: Records,
) -> int:
    """Define a window around every candidate.

    Parameters
    ----------
    image : ndarray (h, w)
        Counts.
    peaks : ndarray (n, 2)
        Column and row of each candidate, brightest first.
    flux : ndarray (n,)
        First guess of the flux, counts.
    level, noise, block
        Background on its grid, and the side of a block.
    spot : (float, float, float, float)
        Mean standard deviation of the spot, pixels; its growth (`starid.imaging.centroid.relative_width`); saturation and
        typical noise of a pixel, counts.
    flow : ndarray (5,)
        Flow of the trails (`starid.imaging.trail_flow`).
    windows : ndarray (n,) of WINDOW
        Filled.

    Returns
    -------
    int
        Number of pixels in all windows together.
    """
    height, width = image.shape
    sigma, growth, saturation, typical_noise = spot
    ring = np.empty(_RING_PIXELS)
    visited = np.empty((2 * PATCH_REACH + 1, 2 * PATCH_REACH + 1), np.uint8)
    stack = np.empty((2 * MAX_SATURATED, 2), np.int32)
    patches = np.empty((_MAX_PATCHES, 7))
    patch_count = 0
    total = 0
    for k in range(peaks.shape[0]):
        window: Window = windows[k]
        column, row = peaks[k, 0], peaks[k, 1]
        patch = patches[patch_count]
        patch[0], patch[1], patch[2] = column, row, 0.0
        window.sigma = sigma * relative_width(float(column), float(row), width, height, growth)
        if image[row, column] >= saturation:
            if _in_patches(column, row, patches, patch_count):
                window.columns = DUPLICATE
                continue
            if not _saturated_patch(image, column, row, saturation, visited, stack, patch):
                window.columns = EXTENDED
                continue
            patch_count = min(patch_count + 1, _MAX_PATCHES - 1)
        x, y, extra = patch[0], patch[1], patch[2]
        trail_x, trail_y = trail_at(flow, x, y, width, height)
        radius = light_radius(window.sigma, float(flux[k]), typical_noise)
        radius_x = min(math.ceil(radius + 0.5 * abs(trail_x) + extra), LARGEST_HALF_WIDTH)
        radius_y = min(math.ceil(radius + 0.5 * abs(trail_y) + extra), LARGEST_HALF_WIDTH)
        centre_x, centre_y = round(x), round(y)
        slopes = _slopes(level, block, x, y)
        around, spread = _ring_statistics(image, centre_x, centre_y, radius_x, radius_y, slopes, ring)
        sky_level, window.noise = _sky_under(
            around,
            spread,
            interpolate_at(level, block, x, y),
            interpolate_at(noise, block, x, y),
            typical_noise,
        )
        window.base = sky_level
        if sigma >= MIN_SPREAD_PX and _stands_alone(image, column, row, sky_level, window.noise):
            window.columns = ONE_PIXEL
            continue
        left, top = max(centre_x - radius_x, 0), max(centre_y - radius_y, 0)
        columns = min(centre_x + radius_x, width - 1) - left + 1
        rows = min(centre_y + radius_y, height - 1) - top + 1
        window.left, window.top = left, top
        if extra == 0.0:
            x, y = _first_position(image, column, row, sky_level)
        window.start_x, window.start_y, window.patch = x, y, extra
        window.trail_x, window.trail_y = trail_x, trail_y
        window.radius_x, window.radius_y = radius_x, radius_y
        window.offset = total
        if min(columns, rows) < 3:
            window.columns = NO_ROOM
            continue
        window.columns, window.rows = columns, rows
        total += columns * rows
    return total


@compiled_ieee
def cut_windows(
    image: GreyImage, windows: Records, level: Array32, block: float, saturation: float, pixels: Array32
) -> None:
    """Copy the pixels of all windows, minus the sky; saturated ones become infinite.

    The sky is a plane: `base` at the first guess of the star, with the slopes of the grid.
    """
    position = 0
    for k in range(windows.shape[0]):
        window: Window = windows[k]
        if window.columns <= 0:
            continue
        x, y, base = window.start_x, window.start_y, window.base
        slope_x, slope_y = _slopes(level, block, x, y)
        left, top = window.left, window.top
        for j in range(top, top + window.rows):
            for i in range(left, left + window.columns):
                value = float(image[j, i])
                sky = base + slope_x * (i - x) + slope_y * (j - y)
                pixels[position] = np.float32(value - sky if value < saturation else math.inf)
                position += 1
