"""Fitting each candidate in its window, without the light of its neighbours, and classifying it."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import numpy.typing as npt

from starid.arrays import Array, Array32, Indices, Indices32, Mask
from starid.imaging.centroid import (
    CHI2,
    FAINT,
    FLUX,
    GOOD,
    HOT_PIXEL,
    PIXELS,
    SHARP_SIGMA_PX,
    SHORT_TRAIL_PX,
    STATE,
    UNUSABLE,
    WANDERED,
    X,
    Y,
    explained,
    fit_star,
    star_model,
)
from starid.imaging.windows import (
    COLUMNS,
    LEFT,
    NOISE,
    OFFSET,
    PATCH,
    RADIUS_X,
    RADIUS_Y,
    ROWS,
    START_X,
    START_Y,
    TOP,
    TRAIL_X,
    TRAIL_Y,
)
from starid.jit import compiled_ieee
from starid.small_arrays import copy_values

SATURATED, AT_EDGE = 1, 2
"""Bits of a star's flags."""

FRESH: Final = (0, 3)
AGAIN: Final = (1, 4)
"""First and last round of `measure`: starting from the candidates, or from existing fits."""

NOT_A_STAR, TWICE, OUTSIDE, WRONG_SIZE = 5, 6, 7, 8
"""Reasons to reject a candidate, in addition to those of `starid.imaging.centroid`."""

_HOPELESS: Final = 0.6
"""Share of the least signal of a star below which a first guess is not fitted."""

_MIN_EXPLAINED: Final = 0.55
_WANDER_PX: Final = 1.5
_WING_SHARE: Final = 0.6
_EDGE_SIGMA: Final = 2.5
BAD_FIT: Final = 4.0
"""Smallest reduced χ² of a bad fit."""

_AT_REST: Final = 0.5
_STRAY_SIGMA: Final = 7.0
_STRAY_DISTANCE_SIGMA: Final = 2.0
FIT_PARAMETERS: Final = 3
_MIN_SIDE: Final = 11


@compiled_ieee
def find_neighbours(windows: Array, order: Indices, first: Indices32, neighbours: Indices32) -> int:
    """List, for every window, the others whose stars may contribute light to it.

    Parameters
    ----------
    windows : ndarray (n, WINDOW_COLUMNS)
        From `lay_windows`.
    order : ndarray (n,)
        Indices of the windows, sorted by START_Y.
    first : ndarray (n + 1,)
        Filled so that the neighbours of k are ``neighbours[first[k]:first[k + 1]]``.
    neighbours : ndarray (m,)
        Filled as far as there is room.

    Returns
    -------
    int
        Number of neighbours; more than m means that there was not enough room.
    """
    count = 0
    place = np.empty(order.size, np.int32)
    for rank in range(order.size):
        place[order[rank]] = rank
    tallest = 0.0
    for k in range(windows.shape[0]):
        if windows[k, COLUMNS] > 0.0:
            tallest = max(tallest, windows[k, RADIUS_Y])
    for k in range(windows.shape[0]):
        first[k] = min(count, neighbours.size)
        if windows[k, COLUMNS] <= 0.0:
            continue
        for step in (-1, 1):
            rank = place[k] + step
            while 0 <= rank < order.size:
                other = order[rank]
                rank += step
                off_y = abs(windows[other, START_Y] - windows[k, START_Y])
                if off_y > tallest + windows[k, RADIUS_Y]:
                    break
                if (
                    windows[other, COLUMNS] > 0.0
                    and off_y <= windows[other, RADIUS_Y] + windows[k, RADIUS_Y]
                    and abs(windows[other, START_X] - windows[k, START_X])
                    <= windows[other, RADIUS_X] + windows[k, RADIUS_X]
                ):
                    if count < neighbours.size:
                        neighbours[count] = other
                    count += 1
    first[windows.shape[0]] = min(count, neighbours.size)
    return count


@compiled_ieee
def _mask_stray_pixel(
    pixels: Array32, model: Array, star: Array, window: Array, sigma: float, per_dn: float, model_error: float
) -> bool:
    """Mask the pixel outside the star's core that contradicts the fit most, if any does."""
    worst = _STRAY_SIGMA * _STRAY_SIGMA
    stray = -1
    variance = window[NOISE] * window[NOISE]
    columns = int(window[COLUMNS])
    for k in range(pixels.size):
        off_x = abs(window[LEFT] + k % columns - star[X]) - 0.5 * abs(window[TRAIL_X])
        off_y = abs(window[TOP] + k // columns - star[Y]) - 0.5 * abs(window[TRAIL_Y])
        if max(off_x, off_y) < _STRAY_DISTANCE_SIGMA * sigma or not pixels[k] < UNUSABLE:
            continue
        light = star[FLUX] * model[0, k]
        off = pixels[k] - light
        error = model_error * light
        chi2 = off * off / (variance + light * per_dn + error * error)
        if off > 0.0 and chi2 > worst:
            worst, stray = chi2, k
    if stray >= 0:
        pixels[stray] = np.float32(math.inf)
    return stray >= 0


@compiled_ieee
def _is_at_rest(
    pixels: Array32,
    bounds: tuple[int, int, int, int],
    shape: tuple[float, float, float],
    noise: tuple[float, float, float],
    model: Array,
    work: Array,
    star: Array,
    spot: Array,
) -> bool:
    """Whether a spot at rest fits and the trail of a star does not; `spot` is workspace for its fit."""
    bad = BAD_FIT * (star[PIXELS] - FIT_PARAMETERS)
    if star[STATE] != GOOD or star[CHI2] <= bad or math.hypot(shape[1], shape[2]) <= SHORT_TRAIL_PX:
        return False
    fit_star(pixels, bounds, (star[X], star[Y]), (shape[0], 0.0, 0.0), noise, 0.0, model, work, spot)
    return bool(spot[STATE] == GOOD and spot[CHI2] <= min(bad, _AT_REST * star[CHI2]))


@compiled_ieee
def _classify_fit(
    pixels: Array32,
    model: Array,
    star: Array,
    window: Array,
    sigma: float,
    least_ratio: float,
    saturation_dn: float,
    lit: tuple[float, float, float],
    size: tuple[int, int],
) -> float:
    """Return GOOD for a star, or the reason to reject the fit."""
    width, height = size
    noise, patch = window[NOISE], window[PATCH]
    length = math.hypot(window[TRAIL_X], window[TRAIL_Y])
    if not star[FLUX] > 0.0:
        return float(FAINT)
    if not (-0.5 <= star[X] < width - 0.5 and -0.5 <= star[Y] < height - 0.5):
        return float(OUTSIDE)
    squares = 0.0
    for k in range(pixels.size):
        squares += model[0, k] * model[0, k]
    if patch == 0.0 and star[FLUX] * math.sqrt(squares) < least_ratio * noise:
        return float(FAINT)
    bright = 0
    for k in range(pixels.size):
        bright += pixels[k] > lit[0] * noise
    if not lit[1] <= bright <= lit[2]:
        return float(WRONG_SIZE)
    allowed = _WANDER_PX * max(sigma, 1.0) + patch + 0.5 * length
    if math.hypot(star[X] - window[START_X], star[Y] - window[START_Y]) > allowed:
        return float(WANDERED)
    if patch > 0.0:
        # the wings must imply a saturated core
        return (
            float(GOOD)
            if star[FLUX] * np.max(model[0, : pixels.size]) > _WING_SHARE * saturation_dn
            else float(HOT_PIXEL)
        )
    _, by_shape, by_pixel, total, used = explained(pixels, model)
    if sigma > SHARP_SIGMA_PX and by_pixel > by_shape:
        return float(HOT_PIXEL)
    if by_shape < _MIN_EXPLAINED * (total - 2.0 * used * noise * noise):
        return float(NOT_A_STAR)
    return float(GOOD)


@compiled_ieee
def _flags(star: Array, window: Array, pixels: Array32, sigma: float, size: tuple[int, int]) -> int:
    """Flags of a star: whether its core has saturated pixels, and whether the image edge cuts off its light."""
    flags = 0
    reach_x = _EDGE_SIGMA * sigma + 0.5 * abs(window[TRAIL_X])
    reach_y = _EDGE_SIGMA * sigma + 0.5 * abs(window[TRAIL_Y])
    if (
        min(star[X] - reach_x, star[Y] - reach_y) < -0.5
        or star[X] + reach_x > size[0] - 0.5
        or star[Y] + reach_y > size[1] - 0.5
    ):
        flags |= AT_EDGE
    if window[PATCH] > 0.0:
        flags |= SATURATED
    column, row = round(star[X] - window[LEFT]), round(star[Y] - window[TOP])
    inside = 0 <= row < window[ROWS] and 0 <= column < window[COLUMNS]
    if inside and not pixels[row * int(window[COLUMNS]) + column] < UNUSABLE:
        flags |= SATURATED
    return flags


@compiled_ieee
def _subtract_star(
    star: Array,
    shape: tuple[float, float, float],
    bounds: tuple[int, int, int, int],
    lights: Array,
    work: Array,
    target: Array32,
) -> None:
    """Subtract the light of a candidate, if it is a star, from a window."""
    if star[STATE] != GOOD:
        return
    star_model(star[X], star[Y], shape, bounds, lights, work)
    for i in range(target.size):
        target[i] -= np.float32(star[FLUX] * lights[0, i])


@compiled_ieee
def measure(
    windows: Array,
    pixels: Array32,
    first: Indices32,
    neighbours: Indices32,
    sensor: tuple[float, float, float, float, float],
    lit: tuple[float, float, float],
    size: tuple[int, int],
    todo: Mask,
    turns: tuple[int, int],
    stars: Array,
    flags: npt.NDArray[np.uint8],
) -> None:
    """Fit and classify candidates.

    The brightest come first, and each is fitted after subtracting the light of its brighter neighbours; those with
    neighbours are then fitted again without the light of any of them.

    Parameters
    ----------
    windows, pixels
        From `lay_windows` and `cut_windows`, the brightest star first.
    first, neighbours
        From `find_neighbours`.
    sensor : (float, float, float, float, float)
        Standard deviation of the spot, pixels; variance in counts² per count of star light; model error;
        smallest signal-to-noise ratio of a star; saturation in counts above the sky.
    lit : (float, float, float)
        Sigmas from which a pixel is lit; smallest and largest number of lit pixels of a star.
    size : (int, int)
        Columns and rows of the image.
    todo : ndarray (n,) of bool
        The candidates to fit; the fits of the others are kept.
    turns : (int, int)
        First and last round: `FRESH`, or `AGAIN` to continue from existing fits. In the last round a fit that is still bad is
        repeated without the pixel that contradicts it most.
    stars : ndarray (n, FIT_COLUMNS)
        Filled with the fits; STATE is NO_FIT before the first round.
    flags : ndarray (n,)
        Filled with bits `SATURATED`, `AT_EDGE`.
    """
    sigma, per_dn, model_error, least_ratio, saturation_dn = sensor
    largest, side = 1, _MIN_SIDE
    for k in range(windows.shape[0]):
        if windows[k, COLUMNS] > 0.0:
            largest = max(largest, int(windows[k, COLUMNS] * windows[k, ROWS]))
            side = max(side, int(max(windows[k, COLUMNS], windows[k, ROWS])))
    model = np.empty((3, largest))
    lights = np.empty((3, largest))
    work = np.empty((5, side))
    cleaned = np.empty(largest, np.float32)
    spot = np.empty(stars.shape[1])
    for turn in range(turns[0], turns[1]):
        last = turns[0] > 0 and turn == turns[1] - 1
        for k in range(windows.shape[0]):
            window, star = windows[k], stars[k]
            alone = first[k] == first[k + 1]
            if not todo[k] or window[COLUMNS] <= 0.0:
                continue
            if turn > 0 and (star[STATE] != GOOD or (alone and not last)):
                continue
            bounds = (int(window[LEFT]), int(window[TOP]), int(window[COLUMNS]), int(window[ROWS]))
            count = bounds[2] * bounds[3]
            begin = int(window[OFFSET])
            own = pixels[begin : begin + count]
            shape = (sigma, window[TRAIL_X], window[TRAIL_Y])
            target = own
            if not alone:
                target = cleaned[:count]
                copy_values(own, target)
                for entry in range(first[k], first[k + 1]):
                    _subtract_star(stars[neighbours[entry]], shape, bounds, lights, work, target)
            noise = (window[NOISE] * window[NOISE], per_dn, model_error)
            guess = (star[X], star[Y]) if turn > 0 else (window[START_X], window[START_Y])
            least = _HOPELESS * least_ratio * window[NOISE] if turn == 0 and window[PATCH] == 0.0 else 0.0
            fit_star(target, bounds, guess, shape, noise, least, model, work, star)
            if (
                last
                and star[STATE] == GOOD
                and star[CHI2] > BAD_FIT * (star[PIXELS] - FIT_PARAMETERS)
                and _mask_stray_pixel(target, model, star, window, sigma, per_dn, model_error)
            ):
                fit_star(target, bounds, (star[X], star[Y]), shape, noise, 0.0, model, work, star)
            if star[STATE] == GOOD:
                star[STATE] = _classify_fit(
                    target, model, star, window, sigma, least_ratio, saturation_dn, lit, size
                )
            if not last and _is_at_rest(target, bounds, shape, noise, model, work, star, spot):
                star[STATE] = NOT_A_STAR
            if star[STATE] == GOOD:
                flags[k] = _flags(star, window, own, sigma, size)
        _drop_doubles(stars, first, neighbours, sigma)


@compiled_ieee
def _drop_doubles(stars: Array, first: Indices32, neighbours: Indices32, sigma: float) -> None:
    """Mark the fainter of two fits with the same position."""
    reach = max(0.7 * sigma, 0.5)
    for k in range(stars.shape[0]):
        for place in range(first[k], first[k + 1]):
            other = neighbours[place]
            if (
                other > k
                and stars[k, STATE] == GOOD
                and stars[other, STATE] == GOOD
                and abs(stars[other, X] - stars[k, X]) < reach
                and abs(stars[other, Y] - stars[k, Y]) < reach
            ):
                stars[other, STATE] = TWICE
