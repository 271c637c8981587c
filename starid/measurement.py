"""From candidates to stars: each is fitted in its own window, judged, and fitted again without its neighbours' light."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import numpy.typing as npt

from starid.background import LEAST_NOISE_DN, interpolate_at
from starid.centroid import (
    FLUX,
    GOOD,
    HOT_PIXEL,
    NO_FIT,
    SHORT_TRAIL_PX,
    STATE,
    WANDERED,
    X,
    Y,
    explained,
    fit_star,
    spot_model,
    trail_model,
    window_radius,
)
from starid.jit_loops import compiled_loops
from starid.spot_shape import trail_at

LARGEST_HALF_WIDTH: Final = 40
"""Half-width of a star's window at most, pixels."""

SATURATED, AT_EDGE = 1, 2
"""Bits of a star's flags."""

FAINT, EXTENDED, NOT_A_STAR, TWICE, OUTSIDE = 4, 5, 6, 7, 8
"""Further reasons, beside those of `starid.centroid`, for which a candidate is not a star."""

_RING_PIXELS: Final = 48
_MOST_SATURATED: Final = 400
_RING_SHIFT_SIGMA: Final = 0.6
_LEAST_EXPLAINED: Final = 0.55
_SHARP_SIGMA_PX: Final = 0.5
_WANDER_PX: Final = 1.5
_QUARTILE_SIGMA: Final = 1.349


@compiled_loops
def _ring(
    image: npt.NDArray[np.uint8] | npt.NDArray[np.uint16],
    x: int,
    y: int,
    radius_x: int,
    radius_y: int,
    values: npt.NDArray[np.float64],
) -> tuple[float, float]:
    """Mean of the middle half, and standard deviation from the quartiles, of pixels on a ring around a window."""
    height, width = image.shape
    count = 0
    for k in range(_RING_PIXELS):
        angle = 2.0 * math.pi * k / _RING_PIXELS
        out = 1.0 if k % 2 == 0 else 2.5
        column = x + round((radius_x + out) * math.cos(angle))
        row = y + round((radius_y + out) * math.sin(angle))
        if 0 <= column < width and 0 <= row < height:
            key = float(image[row, column])
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


@compiled_loops
def _saturated_patch(
    image: npt.NDArray[np.uint8] | npt.NDArray[np.uint16],
    x: int,
    y: int,
    saturation: float,
    visited: npt.NDArray[np.uint8],
    stack: npt.NDArray[np.int32],
    patch: npt.NDArray[np.float64],
) -> int:
    """Follow the connected saturated pixels from (x, y), marking them.

    Parameters
    ----------
    patch : ndarray (4,)
        Filled with the mean column and row, and half the extent along x and y.

    Returns
    -------
    int
        Their number; −1 if the pixel was visited before; counting stops at `_MOST_SATURATED`.
    """
    height, width = image.shape
    if visited[y, x] != 0:
        return -1
    visited[y, x] = 1
    stack[0, 0], stack[0, 1] = x, y
    waiting, count = 1, 0
    total_x = total_y = 0.0
    left, right, top, bottom = x, x, y, y
    while waiting > 0 and count < _MOST_SATURATED:
        waiting -= 1
        column, row = stack[waiting, 0], stack[waiting, 1]
        count += 1
        total_x += column
        total_y += row
        left, right = min(left, column), max(right, column)
        top, bottom = min(top, row), max(bottom, row)
        for dy in range(-1, 2):
            for dx in range(-1, 2):
                a, b = column + dx, row + dy
                if 0 <= a < width and 0 <= b < height and visited[b, a] == 0 and image[b, a] >= saturation:
                    visited[b, a] = 1
                    if waiting < stack.shape[0]:
                        stack[waiting, 0], stack[waiting, 1] = a, b
                        waiting += 1
    patch[0], patch[1] = total_x / count, total_y / count
    patch[2], patch[3] = 0.5 * (right - left + 1), 0.5 * (bottom - top + 1)
    return count


@compiled_loops
def _cut(
    image: npt.NDArray[np.uint8] | npt.NDArray[np.uint16],
    window: tuple[int, int, int, int],
    plane: tuple[float, float, float, float, float],
    out: npt.NDArray[np.float32],
) -> None:
    """Copy a window (left, top, columns, rows) less a plane (level at x, y; slopes along x and y)."""
    left, top, columns, rows = window
    level, x, y, slope_x, slope_y = plane
    for j in range(rows):
        for i in range(columns):
            base = level + slope_x * (left + i - x) + slope_y * (top + j - y)
            out[j, i] = np.float32(image[top + j, left + i] - base)


@compiled_loops
def _subtract_neighbours(
    out: npt.NDArray[np.float32],
    left: int,
    top: int,
    k: int,
    reach: float,
    stars: npt.NDArray[np.float64],
    shape: tuple[float, float, float],
    model: npt.NDArray[np.float64],
) -> int:
    """Take the light of the other stars near star k out of its window; return how many there are."""
    sigma, trail_x, trail_y = shape
    trailed = math.hypot(trail_x, trail_y) > SHORT_TRAIL_PX
    found = 0
    for other in range(stars.shape[0]):
        if other == k or stars[other, STATE] != GOOD:
            continue
        if abs(stars[other, X] - stars[k, X]) > reach or abs(stars[other, Y] - stars[k, Y]) > reach:
            continue
        found += 1
        if trailed:
            trail_model(stars[other, X], stars[other, Y], sigma, (trail_x, trail_y), left, top, model)
        else:
            spot_model(stars[other, X], stars[other, Y], sigma, left, top, model)
        for j in range(out.shape[0]):
            for i in range(out.shape[1]):
                out[j, i] -= np.float32(stars[other, FLUX] * model[0, j, i])
    return found


@compiled_loops
def measure(
    image: npt.NDArray[np.uint8] | npt.NDArray[np.uint16],
    peaks: npt.NDArray[np.int32],
    heights: npt.NDArray[np.float32],
    level: npt.NDArray[np.float32],
    noise: npt.NDArray[np.float32],
    block: float,
    sigma: float,
    field: npt.NDArray[np.float64],
    sensor: tuple[float, float, float, float],
    limits: tuple[float, float],
    stars: npt.NDArray[np.float64],
    flags: npt.NDArray[np.uint8],
    rounds: int,
) -> None:
    """Measure candidates.

    Parameters
    ----------
    image : ndarray (h, w)
        Counts.
    peaks : ndarray (n, 2)
        Column and row of each candidate, the brightest first.
    heights : ndarray (n,)
        Smoothed counts above the background at each.
    level, noise, block
        Background grid and its block's side.
    sigma, field
        Shape of the spot (`SpotShape`).
    sensor : (float, float, float, float)
        Variance in counts² that a count of star light brings; model error; saturation in counts; noise of the
        typical pixel, counts.
    limits : (float, float)
        Least signal-to-noise ratio of a star; sum of squared shares of the spot.
    stars : ndarray (n, COLUMNS)
        Filled with the fits.
    flags : ndarray (n,)
        Filled with bits `SATURATED`, `AT_EDGE`.
    rounds : int
        1, or 2 to fit stars with near neighbours again without the neighbours' light.
    """
    height, width = image.shape
    per_dn, model_error, saturation, typical_noise = sensor
    least_ratio, shape2 = limits
    ring = np.empty(_RING_PIXELS)
    visited = np.zeros((height, width), np.uint8)
    stack = np.empty((2 * _MOST_SATURATED, 2), np.int32)
    patch = np.zeros(4)
    side = 2 * LARGEST_HALF_WIDTH + 1
    buffer = np.empty(side * side, np.float32)
    models = np.empty(3 * side * side)
    others = np.empty(3 * side * side)
    for turn in range(rounds):
        for k in range(peaks.shape[0]):
            if turn > 0 and stars[k, STATE] != GOOD:
                continue
            column, row = peaks[k, 0], peaks[k, 1]
            x, y = float(column), float(row)
            extra_x = extra_y = 0.0
            if turn == 0:
                flags[k] = 0
                stars[k, STATE] = NO_FIT
                seed = image[row, column] >= saturation
                if seed:
                    count = _saturated_patch(image, column, row, saturation, visited, stack, patch)
                    if count < 0:
                        stars[k, STATE] = TWICE
                        continue
                    if count >= _MOST_SATURATED:
                        stars[k, STATE] = EXTENDED
                        continue
                    flags[k] |= SATURATED
                    x, y, extra_x, extra_y = patch[0], patch[1], patch[2], patch[3]
            else:
                x, y = stars[k, X], stars[k, Y]
            trail_x, trail_y = trail_at(field, x, y, width, height)
            flux = float(heights[k]) / shape2 if turn == 0 else stars[k, FLUX]
            base = interpolate_at(level, block, x, y)
            local_noise = interpolate_at(noise, block, x, y)
            radius = window_radius(sigma, flux, typical_noise, LARGEST_HALF_WIDTH)
            radius_x = min(math.ceil(radius + 0.5 * abs(trail_x) + extra_x), LARGEST_HALF_WIDTH)
            radius_y = min(math.ceil(radius + 0.5 * abs(trail_y) + extra_y), LARGEST_HALF_WIDTH)
            centre_x, centre_y = round(x), round(y)
            around, spread = _ring(image, centre_x, centre_y, radius_x, radius_y, ring)
            if spread == spread:
                if local_noise > 1.5 * typical_noise:
                    local_noise = max(spread, typical_noise)
                elif spread > 2.0 * local_noise:
                    local_noise = spread
                if abs(around - base) > _RING_SHIFT_SIGMA * local_noise + 0.5 * LEAST_NOISE_DN:
                    base = around
            left, right = max(centre_x - radius_x, 0), min(centre_x + radius_x, width - 1)
            top, bottom = max(centre_y - radius_y, 0), min(centre_y + radius_y, height - 1)
            columns, rows = right - left + 1, bottom - top + 1
            if columns < 3 or rows < 3:
                continue
            pixels = buffer[: rows * columns].reshape((rows, columns))
            model = models[: 3 * rows * columns].reshape((3, rows, columns))
            slope_x = 0.5 * (
                interpolate_at(level, block, x + 1.0, y) - interpolate_at(level, block, x - 1.0, y)
            )
            slope_y = 0.5 * (
                interpolate_at(level, block, x, y + 1.0) - interpolate_at(level, block, x, y - 1.0)
            )
            _cut(image, (left, top, columns, rows), (base, x, y, slope_x, slope_y), pixels)
            shape = (sigma, trail_x, trail_y)
            if turn > 0:
                reach = max(radius_x, radius_y) + 3.0 * sigma
                other = others[: 3 * rows * columns].reshape((3, rows, columns))
                if _subtract_neighbours(pixels, left, top, k, reach, stars, shape, other) == 0:
                    continue
            top_level = saturation - base - 0.5
            sensor_noise = (local_noise * local_noise, per_dn, model_error, top_level)
            if left <= round(x) <= right and top <= round(y) <= bottom:
                fit_star(pixels, left, top, (x, y), shape, sensor_noise, model, stars[k])
            if stars[k, STATE] != GOOD:
                continue
            if turn == 0:
                stars[k, STATE] = _judge(
                    pixels,
                    model,
                    stars[k],
                    x,
                    y,
                    max(extra_x, extra_y),
                    local_noise,
                    shape,
                    least_ratio,
                    top_level,
                    (width, height),
                )
            margin = 2.5 * sigma
            if (
                stars[k, X] - 0.5 * abs(trail_x) < margin - 0.5
                or stars[k, Y] - 0.5 * abs(trail_y) < margin - 0.5
                or stars[k, X] + 0.5 * abs(trail_x) > width - 0.5 - margin
                or stars[k, Y] + 0.5 * abs(trail_y) > height - 0.5 - margin
            ):
                flags[k] |= AT_EDGE
            if np.max(pixels) >= top_level:
                flags[k] |= SATURATED
        if turn == 0:
            _drop_doubles(stars, sigma)


@compiled_loops
def _judge(
    pixels: npt.NDArray[np.float32],
    model: npt.NDArray[np.float64],
    star: npt.NDArray[np.float64],
    x: float,
    y: float,
    patch: float,
    noise: float,
    shape: tuple[float, float, float],
    least_ratio: float,
    top_level: float,
    size: tuple[int, int],
) -> float:
    """Decide whether a fit is a star: GOOD, or why it is not."""
    sigma = shape[0]
    length = math.hypot(shape[1], shape[2])
    if not star[FLUX] > 0.0:
        return float(FAINT)
    if not (-0.5 <= star[X] < size[0] - 0.5 and -0.5 <= star[Y] < size[1] - 0.5):
        return float(OUTSIDE)
    squares = 0.0
    for j in range(pixels.shape[0]):
        for i in range(pixels.shape[1]):
            squares += model[0, j, i] * model[0, j, i]
    if star[FLUX] * math.sqrt(squares) < least_ratio * noise and patch == 0.0:
        return float(FAINT)
    allowed = _WANDER_PX * max(sigma, 1.0) + patch + 0.5 * length
    if math.hypot(star[X] - x, star[Y] - y) > allowed:
        return float(WANDERED)
    if patch > 0.0:
        # unsaturated wings must call for light that saturates
        brightest = star[FLUX] * np.max(model[0])
        return float(GOOD) if brightest > 0.6 * top_level else float(HOT_PIXEL)
    by_shape, by_pixel, total = explained(pixels, model)
    if sigma > _SHARP_SIGMA_PX and by_pixel > by_shape:
        return float(HOT_PIXEL)
    expected = pixels.size * noise * noise
    if total - expected > 0.0 and by_shape < _LEAST_EXPLAINED * (total - 2.0 * expected):
        return float(NOT_A_STAR)
    return float(GOOD)


@compiled_loops
def _drop_doubles(stars: npt.NDArray[np.float64], sigma: float) -> None:
    """Mark the later of two fits that have come to the same place."""
    reach = max(0.7 * sigma, 0.5)
    for k in range(stars.shape[0]):
        if stars[k, STATE] != GOOD:
            continue
        for other in range(k + 1, stars.shape[0]):
            if (
                stars[other, STATE] == GOOD
                and abs(stars[other, X] - stars[k, X]) < reach
                and abs(stars[other, Y] - stars[k, Y]) < reach
            ):
                stars[other, STATE] = TWICE
