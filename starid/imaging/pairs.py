"""Deblending: a badly fitted star is fitted as two stars that are too close for separate peaks."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from starid.arithmetic.arrays import Array, Array32, Indices, Indices32, Mask, Records
from starid.arithmetic.elementary import exp, hypot, square
from starid.catalog.photometry import EVEN_PAIR
from starid.imaging.centroid import (
    FIT,
    GOOD,
    UNUSABLE,
    Fit,
    star_model,
)
from starid.imaging.windows import WINDOW, Window
from starid.kernels.jit import compiled_ieee
from starid.kernels.small_arrays import copy_values

_UNKNOWNS: Final = 6
_ITERATIONS: Final = 25
_CONVERGED_PX: Final = 2e-3
_MAX_STEP_PX: Final = 0.4
_MAX_CHANGE: Final = 0.5
_CHI2_SHARE: Final = 0.5
_HOPEFUL_STEPS: Final = 10
"""Steps after which the fit is abandoned unless it is better than the fit of one star."""

_MIN_SIGNAL: Final = 6.0
_MIN_SHARE: Final = 0.03
_CLOSEST_SIGMA: Final = 1.0
_MIN_SIDE: Final = 11
_PAIR_SIGMA: Final = 2.5
_FAR_SIGMA: Final = 4.0
_CORE_SIGMA: Final = 1.0
_ONE_PIXEL: Final = 0.5
_MERGER_SHARE: Final = 1.4
"""Pairs closer than this many blending distances may be merged in the catalogue (off axis, an angle has more pixels)."""


@compiled_ieee
def _invert(matrix: Array, inverse: Array) -> bool:
    """Invert a small positive matrix in place by Gauss–Jordan elimination; False if it is singular."""
    size = matrix.shape[0]
    inverse[:] = 0.0
    for i in range(size):
        inverse[i, i] = 1.0
    for i in range(size):
        pivot = matrix[i, i]
        if not pivot > 0.0:
            return False
        for k in range(size):
            matrix[i, k] /= pivot
            inverse[i, k] /= pivot
        for j in range(size):
            if j != i:
                factor = matrix[j, i]
                for k in range(size):
                    matrix[j, k] -= factor * matrix[i, k]
                    inverse[j, k] -= factor * inverse[i, k]
    return True


@compiled_ieee
def fit_pair(
    pixels: Array32,
    window: tuple[int, int, int, int],
    shape: tuple[float, float, float],
    noise: tuple[float, float, float],
    models: Array,
    work: Array,
    enough: float,
    pair: Records,
) -> bool:
    """Fit two stars at once to a window by Gauss–Newton steps, weighted as in `starid.imaging.centroid.fit_star`.

    Parameters
    ----------
    pixels, window, shape, noise, work
        As in `fit_star`.
    models : ndarray (6, m)
        Room for rows·columns pixels; on return, the models of both stars.
    enough : float
        `chi2` that a fit has to reach in its first steps, or it is abandoned.
    pair : ndarray (2,) of FIT
        First guesses of `x`, `y` and `flux` on entry; filled with the fits. `chi2` and `pixels` are for both together.

    Returns
    -------
    bool
        Whether the fit converged.
    """
    variance, per_dn, model_error = noise
    error2 = model_error * model_error
    matrix = np.empty((_UNKNOWNS, _UNKNOWNS))
    inverse = np.empty((_UNKNOWNS, _UNKNOWNS))
    right = np.empty(_UNKNOWNS)
    slopes = np.empty(_UNKNOWNS)
    step = np.empty(_UNKNOWNS)
    for iteration in range(_ITERATIONS):
        for star in range(2):
            star_model(pair[star].x, pair[star].y, shape, window, models[3 * star : 3 * star + 3], work)
        matrix[:] = 0.0
        right[:] = 0.0
        chi2 = used = 0.0
        for k in range(pixels.size):
            if not pixels[k] < UNUSABLE:
                continue
            first, second = pair[0].flux * models[0, k], pair[1].flux * models[3, k]
            light = first + second
            weight = 1.0 / (variance + light * per_dn + error2 * light * light)
            off = pixels[k] - light
            slopes[0], slopes[1], slopes[2] = (
                pair[0].flux * models[1, k],
                pair[0].flux * models[2, k],
                models[0, k],
            )
            slopes[3], slopes[4], slopes[5] = (
                pair[1].flux * models[4, k],
                pair[1].flux * models[5, k],
                models[3, k],
            )
            for i in range(_UNKNOWNS):
                right[i] += weight * slopes[i] * off
                for j in range(i + 1):
                    matrix[i, j] += weight * slopes[i] * slopes[j]
            chi2 += weight * off * off
            used += 1.0
        for i in range(_UNKNOWNS):
            for j in range(i):
                matrix[j, i] = matrix[i, j]
        hopeless = iteration >= _HOPEFUL_STEPS and chi2 > enough
        if hopeless or used <= _UNKNOWNS or not _invert(matrix, inverse):
            return False
        for i in range(_UNKNOWNS):
            step[i] = 0.0
            for j in range(_UNKNOWNS):
                step[i] += inverse[i, j] * right[j]
        longest = max(abs(step[0]), abs(step[1]), abs(step[3]), abs(step[4]))
        shrink = min(1.0, _MAX_STEP_PX / max(longest, 1e-12))
        for star in range(2):
            pair[star].x += shrink * step[3 * star]
            pair[star].y += shrink * step[3 * star + 1]
            flux = pair[star].flux
            change = shrink * step[3 * star + 2]
            pair[star].flux = flux + min(max(change, -_MAX_CHANGE * flux), max(flux, -change))
            pair[star].var_x = inverse[3 * star, 3 * star]
            pair[star].var_y = inverse[3 * star + 1, 3 * star + 1]
            pair[star].cov_xy = inverse[3 * star, 3 * star + 1]
            pair[star].var_flux = inverse[3 * star + 2, 3 * star + 2]
            pair[star].chi2 = chi2
            pair[star].pixels = used
        if longest < _CONVERGED_PX:
            return True
    return False


@compiled_ieee
def _first_guesses(
    left_over: Array, window: tuple[int, int, int, int], star: Fit, sigma: float, pair: Records
) -> bool:
    """Guess two stars from the residuals of a single-star fit; False if there is no residual light."""
    left, top, columns, rows = window
    best = 0.0
    best_x = best_y = 0.0
    for j in range(1, rows - 1):
        for i in range(1, columns - 1):
            off_x, off_y = left + i - star.x, top + j - star.y
            if hypot(off_x, off_y) < _CORE_SIGMA * sigma:
                continue
            total = 0.0
            for b in range(-1, 2):
                for a in range(-1, 2):
                    total += left_over[(j + b) * columns + i + a] * (2 - abs(a)) * (2 - abs(b)) / 16.0
            if total > best:
                best, best_x, best_y = total, off_x, off_y
    if best <= 0.0:
        return False
    distance = hypot(best_x, best_y)
    pair[0] = star
    pair[1] = star
    if distance > _FAR_SIGMA * sigma:
        pair[1].x += best_x
        pair[1].y += best_y
        pair[1].flux = min(best * 2.0 * math.pi * sigma * sigma, star.flux)
        return True
    # very close: share the light between two stars on either side of the single fit
    half = 0.5 * _PAIR_SIGMA * sigma / distance
    for k in range(2):
        sense = 1.0 if k == 1 else -1.0
        pair[k].x += sense * half * best_x
        pair[k].y += sense * half * best_y
        pair[k].flux *= 0.5
    return True


@compiled_ieee
def _is_better(pair: Records, chi2: float, sigma: float, models: Array, pixels: Array32) -> bool:
    """Whether two stars fit much better than one, and neither is noise or a single pixel."""
    apart = hypot(pair[0].x - pair[1].x, pair[0].y - pair[1].y)
    if pair[0].chi2 > _CHI2_SHARE * chi2 or apart < _CLOSEST_SIGMA * sigma:
        return False
    total = pair[0].flux + pair[1].flux
    for k in range(2):
        flux = pair[k].flux
        if flux < _MIN_SHARE * total or flux < _MIN_SIGNAL * math.sqrt(pair[k].var_flux):
            return False
    # light of the fainter star without its highest pixel
    highest = everything = 0.0
    faint = 1 if pair[1].flux < pair[0].flux else 0
    for k in range(pixels.size):
        if pixels[k] < UNUSABLE:
            value = pixels[k] - pair[1 - faint].flux * models[3 * (1 - faint), k]
            highest = max(highest, value)
            everything += pair[faint].flux * models[3 * faint, k]
    return highest < _ONE_PIXEL * everything


@compiled_ieee
def _blend_shift(off_x: float, off_y: float, ratio: float, blend_px: float) -> float:
    """Where a single spot fits between a star and its companion, as a share of their distance."""
    gaussian = exp(-(off_x * off_x + off_y * off_y) / (blend_px * blend_px))
    share = 1.0 - (1.0 - gaussian) * max(1.0 - square(ratio / EVEN_PAIR), 0.0)
    return share * ratio / (1.0 + ratio)


@compiled_ieee
def doubt_close_pairs(stars: Records, order: Indices, blend_px: float) -> None:
    """Increase the errors of the brighter star of a pair that is barely resolved.

    A catalogue with merged pairs may have it as one star, displaced by the shift of the merged position.

    Parameters
    ----------
    stars : ndarray (n,) of FIT
        `var_x` and `var_y` grow, and with them `cov_xy`.
    order : ndarray (n,)
        Indices of the stars, sorted by decreasing `y`.
    blend_px : float
        See `split_pairs`.
    """
    reach = _MERGER_SHARE * blend_px
    for place in range(order.size):
        one = stars[order[place]]
        for later in range(place + 1, order.size):
            other = stars[order[later]]
            if one.y - other.y > reach:
                break
            off_x, off_y = other.x - one.x, other.y - one.y
            if off_x * off_x + off_y * off_y > reach * reach:
                continue
            brighter, ratio = (one, other.flux / one.flux)
            if ratio > 1.0:
                brighter, ratio = other, 1.0 / ratio
            shift = _blend_shift(off_x, off_y, ratio, blend_px)
            brighter.var_x += square(shift * off_x)
            brighter.var_y += square(shift * off_y)
            brighter.cov_xy += shift * shift * off_x * off_y


@compiled_ieee
def _merge(pair: Records, blend_px: float, star: Fit) -> None:
    """Replace two stars by one with their total light, at the position and with the errors of a single-spot fit.

    The position follows `starid.catalog.photometry.fitted_share`, so that resolved and unresolved pairs agree with an index
    of merged stars.
    """
    faint = 1 if pair[1].flux < pair[0].flux else 0
    bright = pair[1 - faint]
    off_x, off_y = pair[faint].x - bright.x, pair[faint].y - bright.y
    shift = _blend_shift(off_x, off_y, pair[faint].flux / bright.flux, blend_px)
    star.x, star.y = bright.x + shift * off_x, bright.y + shift * off_y
    total = pair[0].flux + pair[1].flux
    star.flux = total
    star.chi2, star.pixels = pair[0].chi2, pair[0].pixels


def warm_up() -> None:
    """Compile `split_pairs`, without stars."""
    windows, stars, todo = (
        np.zeros(1, WINDOW),
        np.zeros(1, FIT),
        np.zeros(1, dtype=np.bool_),
    )
    pixels, near = np.empty(0, dtype=np.float32), (np.zeros(2, dtype=np.int32), np.empty(0, dtype=np.int32))
    partners, none = np.empty(0, FIT), np.empty(0, dtype=np.int64)
    split_pairs(windows, pixels, *near, (0.0, 0.0), stars, none, 0.0, partners, none, todo)


@compiled_ieee
def split_pairs(
    windows: Records,
    pixels: Array32,
    first: Indices32,
    neighbours: Indices32,
    noise: tuple[float, float],
    stars: Records,
    suspects: Indices,
    blend_px: float,
    partners: Records,
    owners: Indices,
    todo: Mask,
) -> int:
    """Fit badly fitted stars as pairs; the brighter member replaces the original star.

    Parameters
    ----------
    windows, pixels, first, neighbours, stars
        See `starid.imaging.measurement.measure`, which must have been called.
    noise : (float, float)
        Variance in counts² per count of star light; model error.
    suspects : ndarray (m,)
        Indices of the stars to try.
    blend_px : float
        Pairs closer than this stay one star, at the position where a single spot fits.
    partners : ndarray (m,) of FIT
        Filled with the fits of the fainter stars.
    owners : ndarray (m,)
        Filled with the indices of the brighter members.
    todo : ndarray (n,) of bool
        Cleared for stars that are pairs.

    Returns
    -------
    int
        Number of pairs resolved as two stars.
    """
    per_dn, model_error = noise
    largest, side = 1, _MIN_SIDE
    for k in suspects:
        largest = max(largest, windows[k].columns * windows[k].rows)
        side = max(side, windows[k].columns, windows[k].rows)
    models = np.empty((6, largest))
    work = np.empty((5, side))
    cleaned = np.empty(largest, np.float32)
    left_over = np.empty(largest)
    pair = np.empty(2, stars.dtype)
    pair_count = 0
    for k in suspects:
        window: Window = windows[k]
        star: Fit = stars[k]
        bounds = (window.left, window.top, window.columns, window.rows)
        count = bounds[2] * bounds[3]
        begin = window.offset
        sigma = window.sigma
        shape = (sigma, window.trail_x, window.trail_y)
        target = cleaned[:count]
        copy_values(pixels[begin:], target)
        for entry in range(first[k], first[k + 1]):
            other = stars[neighbours[entry]]
            if other.state == GOOD:
                star_model(other.x, other.y, shape, bounds, models[:3], work)
                for i in range(count):
                    target[i] -= np.float32(other.flux * models[0, i])
        star_model(star.x, star.y, shape, bounds, models[:3], work)
        for i in range(count):
            left_over[i] = target[i] - star.flux * models[0, i] if target[i] < UNUSABLE else 0.0
        if not _first_guesses(left_over, bounds, star, sigma, pair):
            continue
        noises = (square(window.noise), per_dn, model_error)
        enough = _CHI2_SHARE * star.chi2
        fitted = fit_pair(target, bounds, shape, noises, models, work, enough, pair)
        if not fitted or not _is_better(pair, star.chi2, sigma, models, target):
            continue
        todo[k] = False
        faint = 1 if pair[1].flux < pair[0].flux else 0
        if hypot(pair[0].x - pair[1].x, pair[0].y - pair[1].y) < blend_px:
            _merge(pair, blend_px, star)
            continue
        stars[k] = pair[1 - faint]
        partners[pair_count] = pair[faint]
        owners[pair_count] = k
        pair_count += 1
    return pair_count
