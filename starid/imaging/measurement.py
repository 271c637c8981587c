"""Fitting each candidate in its window, without the light of its neighbours, and classifying it."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import numpy.typing as npt

from starid.arithmetic.arrays import Array, Array32, Indices, Indices32, Mask, Records
from starid.arithmetic.elementary import hypot
from starid.imaging.centroid import (
    FAINT,
    GOOD,
    HOT_PIXEL,
    SHARP_SIGMA_PX,
    SHORT_TRAIL_PX,
    UNUSABLE,
    WANDERED,
    Fit,
    explained,
    fit_star,
    star_model,
)
from starid.imaging.windows import Window
from starid.kernels.jit import compiled_ieee
from starid.kernels.small_arrays import copy_values

SATURATED, AT_EDGE = 1, 2
"""Bits of a star's flags."""

FIRST_ROUNDS: Final = (0, 3)
FIRST_ROUND: Final = (0, 1)
REFIT_ROUNDS: Final = (1, 4)
"""First and last round of `measure`: starting from the candidates, the first of these alone, or from existing fits."""

NOT_A_STAR, TWICE, OUTSIDE, WRONG_SIZE = 5, 6, 7, 8
"""Reasons to reject a candidate, in addition to those of `starid.imaging.centroid`."""

_HOPELESS_SHARE: Final = 0.6
"""Share of the least signal of a star below which a first guess is not fitted."""

_MIN_EXPLAINED: Final = 0.55
_WANDER_PX: Final = 1.5
_WING_SHARE: Final = 0.6
_EDGE_SIGMA: Final = 2.5
BAD_FIT: Final = 4.0
"""Smallest reduced χ² of a bad fit."""

_REST_CHI2_SHARE: Final = 0.5
_STRAY_SIGMA: Final = 7.0
_STRAY_DISTANCE_SIGMA: Final = 2.0
FIT_PARAMETERS: Final = 3
_MIN_SIDE: Final = 11


@compiled_ieee
def find_neighbours(windows: Records, order: Indices, first: Indices32, neighbours: Indices32) -> int:
    """List, for every window, the others whose stars may contribute light to it.

    Parameters
    ----------
    windows : ndarray (n,) of WINDOW
        From `lay_windows`.
    order : ndarray (n,)
        Indices of the windows, sorted by `start_y`.
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
        if windows[k].columns > 0:
            tallest = max(tallest, windows[k].radius_y)
    for k in range(windows.shape[0]):
        first[k] = min(count, neighbours.size)
        if windows[k].columns <= 0:
            continue
        for step in (-1, 1):
            rank = place[k] + step
            while 0 <= rank < order.size:
                other = order[rank]
                rank += step
                off_y = abs(windows[other].start_y - windows[k].start_y)
                if off_y > tallest + windows[k].radius_y:
                    break
                if (
                    windows[other].columns > 0
                    and off_y <= windows[other].radius_y + windows[k].radius_y
                    and abs(windows[other].start_x - windows[k].start_x)
                    <= windows[other].radius_x + windows[k].radius_x
                ):
                    if count < neighbours.size:
                        neighbours[count] = other
                    count += 1
    first[windows.shape[0]] = min(count, neighbours.size)
    return count


@compiled_ieee
def _mask_stray_pixel(
    pixels: Array32, model: Array, star: Fit, window: Window, sigma: float, per_dn: float, model_error: float
) -> bool:
    """Mask the pixel outside the star's core that contradicts the fit most, if any does."""
    worst = _STRAY_SIGMA * _STRAY_SIGMA
    stray = -1
    variance = window.noise * window.noise
    columns = window.columns
    for k in range(pixels.size):
        off_x = abs(window.left + k % columns - star.x) - 0.5 * abs(window.trail_x)
        off_y = abs(window.top + k // columns - star.y) - 0.5 * abs(window.trail_y)
        if max(off_x, off_y) < _STRAY_DISTANCE_SIGMA * sigma or not pixels[k] < UNUSABLE:
            continue
        light = star.flux * model[0, k]
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
    star: Fit,
    spot: Fit,
) -> bool:
    """Whether a spot at rest fits and the trail of a star does not; `spot` is workspace for its fit."""
    bad = BAD_FIT * (star.pixels - FIT_PARAMETERS)
    if star.state != GOOD or star.chi2 <= bad or hypot(shape[1], shape[2]) <= SHORT_TRAIL_PX:
        return False
    fit_star(pixels, bounds, (star.x, star.y), (shape[0], 0.0, 0.0), noise, 0.0, model, work, spot)
    return bool(spot.state == GOOD and spot.chi2 <= min(bad, _REST_CHI2_SHARE * star.chi2))


@compiled_ieee
def _classify_fit(
    pixels: Array32,
    model: Array,
    star: Fit,
    window: Window,
    sigma: float,
    least_ratio: float,
    saturation_dn: float,
    lit: tuple[float, float, float],
    size: tuple[int, int],
) -> int:
    """Return GOOD for a star, or the reason to reject the fit."""
    width, height = size
    noise, patch = window.noise, window.patch
    length = hypot(window.trail_x, window.trail_y)
    if not star.flux > 0.0:
        return FAINT
    if not (-0.5 <= star.x < width - 0.5 and -0.5 <= star.y < height - 0.5):
        return OUTSIDE
    squares = 0.0
    for k in range(pixels.size):
        squares += model[0, k] * model[0, k]
    if patch == 0.0 and star.flux * math.sqrt(squares) < least_ratio * noise:
        return FAINT
    bright = 0
    for k in range(pixels.size):
        bright += pixels[k] > lit[0] * noise
    if not lit[1] <= bright <= lit[2]:
        return WRONG_SIZE
    allowed = _WANDER_PX * max(sigma, 1.0) + patch + 0.5 * length
    if hypot(star.x - window.start_x, star.y - window.start_y) > allowed:
        return WANDERED
    if patch > 0.0:
        # the wings must imply a saturated core
        return (
            GOOD if star.flux * np.max(model[0, : pixels.size]) > _WING_SHARE * saturation_dn else HOT_PIXEL
        )
    _, by_shape, by_pixel, total, used = explained(pixels, model)
    if sigma > SHARP_SIGMA_PX and by_pixel > by_shape:
        return HOT_PIXEL
    if by_shape < _MIN_EXPLAINED * (total - 2.0 * used * noise * noise):
        return NOT_A_STAR
    return GOOD


@compiled_ieee
def _flags(star: Fit, window: Window, pixels: Array32, sigma: float, size: tuple[int, int]) -> int:
    """Flags of a star: whether its core has saturated pixels, and whether the image edge cuts off its light."""
    flags = 0
    reach_x = _EDGE_SIGMA * sigma + 0.5 * abs(window.trail_x)
    reach_y = _EDGE_SIGMA * sigma + 0.5 * abs(window.trail_y)
    if (
        min(star.x - reach_x, star.y - reach_y) < -0.5
        or star.x + reach_x > size[0] - 0.5
        or star.y + reach_y > size[1] - 0.5
    ):
        flags |= AT_EDGE
    if window.patch > 0.0:
        flags |= SATURATED
    column, row = round(star.x - window.left), round(star.y - window.top)
    inside = 0 <= row < window.rows and 0 <= column < window.columns
    if inside and not pixels[row * window.columns + column] < UNUSABLE:
        flags |= SATURATED
    return flags


@compiled_ieee
def _subtract_star(
    star: Fit,
    shape: tuple[float, float, float],
    bounds: tuple[int, int, int, int],
    lights: Array,
    work: Array,
    target: Array32,
) -> None:
    """Subtract the light of a candidate, if it is a star, from a window."""
    if star.state != GOOD:
        return
    star_model(star.x, star.y, shape, bounds, lights, work)
    for i in range(target.size):
        target[i] -= np.float32(star.flux * lights[0, i])


@compiled_ieee
def measure(
    windows: Records,
    pixels: Array32,
    first: Indices32,
    neighbours: Indices32,
    sensor: tuple[float, float, float, float],
    lit: tuple[float, float, float],
    size: tuple[int, int],
    todo: Mask,
    turns: tuple[int, int],
    stars: Records,
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
    sensor : (float, float, float, float)
        Variance in counts² per count of star light; model error;
        smallest signal-to-noise ratio of a star; saturation in counts above the sky.
    lit : (float, float, float)
        Sigmas from which a pixel is lit; smallest and largest number of lit pixels of a star.
    size : (int, int)
        Columns and rows of the image.
    todo : ndarray (n,) of bool
        The candidates to fit; the fits of the others are kept.
    turns : (int, int)
        First and last round: `FIRST_ROUNDS`, or `REFIT_ROUNDS` to continue from existing fits. In the last round a fit that is still bad is
        repeated without the pixel that contradicts it most.
    stars : ndarray (n,) of FIT
        Filled; `state` is NO_FIT before the first round.
    flags : ndarray (n,)
        Filled with bits `SATURATED`, `AT_EDGE`.
    """
    per_dn, model_error, least_ratio, saturation_dn = sensor
    largest, side = 1, _MIN_SIDE
    for k in range(windows.shape[0]):
        if windows[k].columns > 0:
            largest = max(largest, windows[k].columns * windows[k].rows)
            side = max(side, windows[k].columns, windows[k].rows)
    model = np.empty((3, largest))
    lights = np.empty((3, largest))
    work = np.empty((5, side))
    cleaned = np.empty(largest, np.float32)
    spot: Fit = np.empty_like(stars[:1])[0]
    for turn in range(turns[0], turns[1]):
        last = turns[0] > 0 and turn == turns[1] - 1
        for k in range(windows.shape[0]):
            window: Window = windows[k]
            star: Fit = stars[k]
            alone = first[k] == first[k + 1]
            if not todo[k] or window.columns <= 0:
                continue
            if turn > 0 and (star.state != GOOD or (alone and not last)):
                continue
            bounds = (window.left, window.top, window.columns, window.rows)
            count = bounds[2] * bounds[3]
            begin = window.offset
            own = pixels[begin : begin + count]
            sigma = window.sigma
            shape = (sigma, window.trail_x, window.trail_y)
            target = own
            if not alone:
                target = cleaned[:count]
                copy_values(own, target)
                for entry in range(first[k], first[k + 1]):
                    _subtract_star(stars[neighbours[entry]], shape, bounds, lights, work, target)
            noise = (window.noise * window.noise, per_dn, model_error)
            guess = (star.x, star.y) if turn > 0 else (window.start_x, window.start_y)
            least = _HOPELESS_SHARE * least_ratio * window.noise if turn == 0 and window.patch == 0.0 else 0.0
            fit_star(target, bounds, guess, shape, noise, least, model, work, star)
            if (
                last
                and star.state == GOOD
                and star.chi2 > BAD_FIT * (star.pixels - FIT_PARAMETERS)
                and _mask_stray_pixel(target, model, star, window, sigma, per_dn, model_error)
            ):
                fit_star(target, bounds, (star.x, star.y), shape, noise, 0.0, model, work, star)
            if star.state == GOOD:
                star.state = _classify_fit(
                    target, model, star, window, sigma, least_ratio, saturation_dn, lit, size
                )
            if not last and _is_at_rest(target, bounds, shape, noise, model, work, star, spot):
                star.state = NOT_A_STAR
            if star.state == GOOD:
                flags[k] = _flags(star, window, own, sigma, size)
        _drop_doubles(stars, windows, first, neighbours)


@compiled_ieee
def _drop_doubles(stars: Records, windows: Records, first: Indices32, neighbours: Indices32) -> None:
    """Mark the fainter of two fits with the same position."""
    for k in range(stars.shape[0]):
        reach = max(0.7 * windows[k].sigma, 0.5)
        for place in range(first[k], first[k + 1]):
            other = neighbours[place]
            if (
                other > k
                and stars[k].state == GOOD
                and stars[other].state == GOOD
                and abs(stars[other].x - stars[k].x) < reach
                and abs(stars[other].y - stars[k].y) < reach
            ):
                stars[other].state = TWICE
