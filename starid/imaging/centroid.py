"""Sub-pixel position and flux of a star: the maximum-likelihood fit of its spot to the pixels around it.

The model of a pixel is flux × (share of the spot in the pixel) + background. Position and flux are found by
Gauss–Newton steps on the weighted squares. Each pixel is weighted by the inverse of its variance under the model:
background noise, shot noise of the star, and a share of its light for errors of the model (pixel response, shape of the
spot). The inverse of the normal matrix is then the covariance of the estimate, which is the Cramér–Rao bound for the
given noise. Saturated pixels have no weight.
"""

from __future__ import annotations

import math
from typing import Final, Protocol

import numpy as np

from starid.arithmetic.arrays import Array, Array32, record_type
from starid.arithmetic.elementary import hypot
from starid.imaging.normal_table import normal, quick_normal
from starid.kernels.jit import compiled_ieee, inner

UNUSABLE: Final = 1e9
"""Least count at which a pixel of a window has no weight: saturated and masked pixels are set to infinity."""

GOOD, NO_FIT, HOT_PIXEL, WANDERED, FAINT = range(5)
"""States of a fit."""


class Fit(Protocol):
    """The fit of a spot, a record of `FIT`.

    Attributes
    ----------
    x, y : float
        Position, image pixels.
    flux : float
        Light, counts.
    var_x, var_y, cov_xy, var_flux : float
        Their variances, and the covariance of x and y, pixels² and counts².
    chi2, pixels : float
        Weighted sum of squares, and over how many pixels.
    state : int
        GOOD, or why there is no position.
    """

    x: float
    y: float
    flux: float
    var_x: float
    var_y: float
    cov_xy: float
    var_flux: float
    chi2: float
    pixels: float
    state: int


FIT: Final = record_type(Fit)

_ITERATIONS: Final = 12
_PIXEL_RATIO: Final = 1.8
SHARP_SIGMA_PX: Final = 0.5
"""Standard deviation of a spot above which a single pixel does not look like a star."""

_CONVERGED_PX: Final = 1e-3
_CONVERGED_SIGMA: Final = 0.05
_CONVERGED_FLUX: Final = 0.01
_SETTLED_PX: Final = 0.02
_MAX_STEP_PX: Final = 1.0
_MIN_PIXELS: Final = 5
_PIXEL_VARIANCE: Final = 1.0 / 12.0
_MEAN_SQUARE: Final = 2.0 / 3.0
SHORT_TRAIL_PX: Final = 0.5
"""Trails shorter than this are fitted as round spots, pixels."""


@inner
def relative_width(x: float, y: float, width: int, height: int, growth: float) -> float:
    """Width of a spot over its mean in an image of a size, if it grows with the square of the distance from the centre.

    `growth` is that from the centre to the middle of an edge; in a square image, the mean square of the distance is 2/3 of that.
    """
    off_x, off_y = (2.0 * x + 1.0) / width - 1.0, (2.0 * y + 1.0) / height - 1.0
    return (1.0 + growth * (off_x * off_x + off_y * off_y)) / (1.0 + growth * _MEAN_SQUARE)


@compiled_ieee
def spot_profile(centre: float, sigma: float, first: int, share: Array, slope: Array, count: int) -> None:
    """Shares of a Gaussian in `count` pixels from `first` on, and their derivatives with respect to `centre`."""
    scale = 1.0 / sigma
    z = (first - 0.5 - centre) * scale
    cdf, bell = normal(z)
    for k in range(count):
        z += scale
        next_cdf, next_bell = normal(z)
        share[k] = next_cdf - cdf
        slope[k] = (bell - next_bell) * scale
        cdf = next_cdf
        bell = next_bell


@compiled_ieee
def spot_model(
    x: float, y: float, sigma: float, window: tuple[int, int, int, int], model: Array, work: Array
) -> None:
    """Shares of a round spot in the pixels of a window.

    Parameters
    ----------
    x, y, sigma : float
        Centre and standard deviation, pixels.
    window : (int, int, int, int)
        Image column and row of the first pixel; number of columns and rows.
    model : ndarray (3, rows·columns)
        Filled with the share of the light in each pixel, row by row, and its derivatives in x and y.
    work : ndarray (4, side)
        Scratch; at least as wide as the window.
    """
    left, top, columns, rows = window
    share_x, slope_x, share_y, slope_y = work[0], work[1], work[2], work[3]
    spot_profile(x, sigma, left, share_x, slope_x, columns)
    spot_profile(y, sigma, top, share_y, slope_y, rows)
    k = 0
    for j in range(rows):
        for i in range(columns):
            model[0, k] = share_x[i] * share_y[j]
            model[1, k] = slope_x[i] * share_y[j]
            model[2, k] = share_x[i] * slope_y[j]
            k += 1


@compiled_ieee
def trail_model(
    x: float,
    y: float,
    sigma: float,
    trail: tuple[float, float],
    window: tuple[int, int, int, int],
    model: Array,
) -> None:
    """As `spot_model`, for a spot that moves uniformly by `trail` pixels during the exposure, centred on x, y.

    Along the trail the light is a Gaussian smeared over its length, across it a Gaussian; the pixel's own size
    counts as 1/12 square pixel more of the spot's variance. The loop has no branch, so it is vectorised.
    """
    left, top, columns, rows = window
    length = hypot(trail[0], trail[1])
    inverse = 1.0 / math.sqrt(sigma * sigma + _PIXEL_VARIANCE)
    along_x, along_y = trail[0] / length * inverse, trail[1] / length * inverse
    half = 0.5 * length * inverse
    scale = inverse / length
    per_row = 1.0 / columns
    for k in range(np.int32(rows * columns)):
        row = np.floor((k + 0.5) * per_row)
        dx, dy = left - x + (k - row * columns), top - y + row
        u = dx * along_x + dy * along_y
        v = dy * along_x - dx * along_y
        across, _ = quick_normal(v)
        head_bell, head_cdf = quick_normal(u + half)
        tail_bell, tail_cdf = quick_normal(u - half)
        across *= scale
        share = (head_cdf - tail_cdf) * across
        by_u = (tail_bell - head_bell) * across
        by_v = share * v
        model[0, k] = share
        model[1, k] = by_u * along_x - by_v * along_y
        model[2, k] = by_u * along_y + by_v * along_x


@compiled_ieee
def star_model(
    x: float,
    y: float,
    shape: tuple[float, float, float],
    window: tuple[int, int, int, int],
    model: Array,
    work: Array,
) -> None:
    """Model of a round spot or of a trail, depending on the shape (sigma, trail x, trail y)."""
    if hypot(shape[1], shape[2]) > SHORT_TRAIL_PX:
        trail_model(x, y, shape[0], (shape[1], shape[2]), window, model)
    else:
        spot_model(x, y, shape[0], window, model, work)


@compiled_ieee
def _normal_equations(
    pixels: Array32, model: Array, flux: float, noise: tuple[float, float, float], sums: Array
) -> None:
    """Sums over a window for a Gauss–Newton step, in the order used in `fit_star`."""
    variance, per_dn, model_error = noise
    error2 = model_error * model_error
    a_xx = a_xy = a_yy = a_xf = a_yf = a_ff = 0.0
    b_x = b_y = b_f = 0.0
    chi2 = used = 0.0
    for k in range(pixels.size):
        value = float(pixels[k])
        valid = value < UNUSABLE
        share = model[0, k]
        light = flux * share
        weight = (1.0 if valid else 0.0) / (variance + light * per_dn + error2 * light * light)
        off = (value if valid else 0.0) - light
        d_x = flux * model[1, k]
        d_y = flux * model[2, k]
        w_x = weight * d_x
        w_y = weight * d_y
        w_f = weight * share
        a_xx += w_x * d_x
        a_xy += w_x * d_y
        a_yy += w_y * d_y
        a_xf += w_x * share
        a_yf += w_y * share
        a_ff += w_f * share
        b_x += w_x * off
        b_y += w_y * off
        b_f += w_f * off
        chi2 += weight * off * off
        used += 1.0 if valid else 0.0
    sums[0], sums[1], sums[2], sums[3], sums[4], sums[5] = a_xx, a_xy, a_yy, a_xf, a_yf, a_ff
    sums[6], sums[7], sums[8], sums[9], sums[10] = b_x, b_y, b_f, chi2, used


@compiled_ieee
def fit_star(
    pixels: Array32,
    window: tuple[int, int, int, int],
    start: tuple[float, float],
    shape: tuple[float, float, float],
    noise: tuple[float, float, float],
    least_signal: float,
    model: Array,
    work: Array,
    result: Fit,
) -> None:
    """Fit one star to a window.

    Parameters
    ----------
    pixels : ndarray (rows·columns,), float32
        Counts above the background, row by row; counts from `UNUSABLE` up are not used.
    window : (int, int, int, int)
        Image column and row of the first pixel; number of columns and rows.
    start : (float, float)
        First guess of the position, image pixels.
    shape : (float, float, float)
        Standard deviation of the spot, and the trail along x and y, pixels.
    noise : (float, float, float)
        Variance of a pixel without star light (counts²); variance that a count of star light brings (1/gain, 0 if
        unknown); relative error of the model in a pixel.
    least_signal : float
        Least light at the first guess, weighted by the model's share of its norm, counts; below it the star is FAINT
        and not fitted. 0 to fit a known star, which is not tested for a HOT_PIXEL either.
    model : ndarray (3, m)
        Room for rows·columns pixels; on return, the model near the result.
    work : ndarray (5, side)
        Scratch; side at least that of the window, and 11.
    result : Fit
        Filled.
    """
    x, y = start
    result.state = NO_FIT
    star_model(x, y, shape, window, model, work)
    flux, by_shape, by_pixel, _, _ = explained(pixels, model)
    if flux <= 0.0 or by_shape < least_signal * least_signal:
        result.state = FAINT
        return
    if least_signal > 0.0 and shape[0] > SHARP_SIGMA_PX and by_pixel > _PIXEL_RATIO * by_shape:
        result.state = HOT_PIXEL
        return
    sums = work[4]
    for iteration in range(_ITERATIONS + 1):
        if iteration > 0:
            star_model(x, y, shape, window, model, work)
        _normal_equations(pixels, model, flux, noise, sums)
        a_xx, a_xy, a_yy, a_xf, a_yf, a_ff = sums[0], sums[1], sums[2], sums[3], sums[4], sums[5]
        b_x, b_y, b_f = sums[6], sums[7], sums[8]
        # covariance of (x, y, flux): inverse of the symmetric 3 × 3 normal matrix
        c_xx = a_yy * a_ff - a_yf * a_yf
        c_xy = a_xf * a_yf - a_xy * a_ff
        c_xf = a_xy * a_yf - a_xf * a_yy
        c_yy = a_xx * a_ff - a_xf * a_xf
        c_yf = a_xy * a_xf - a_xx * a_yf
        c_ff = a_xx * a_yy - a_xy * a_xy
        determinant = a_xx * c_xx + a_xy * c_xy + a_xf * c_xf
        if sums[10] < _MIN_PIXELS or not determinant > 0.0:
            return
        scale = 1.0 / determinant
        step_x = (c_xx * b_x + c_xy * b_y + c_xf * b_f) * scale
        step_y = (c_xy * b_x + c_yy * b_y + c_yf * b_f) * scale
        step_f = (c_xf * b_x + c_yf * b_y + c_ff * b_f) * scale
        longest = max(abs(step_x), abs(step_y))
        # a step far smaller than the errors is negligible
        small = max(_CONVERGED_PX, _CONVERGED_SIGMA * math.sqrt(max(c_xx, c_yy) * scale))
        small_flux = max(_CONVERGED_FLUX * flux, _CONVERGED_SIGMA * math.sqrt(c_ff * scale))
        settled = longest <= small and abs(step_f) <= small_flux
        if settled or iteration == _ITERATIONS:
            result.x = x + step_x if settled else x
            result.y = y + step_y if settled else y
            result.flux = flux + step_f
            result.var_x = c_xx * scale
            result.var_y = c_yy * scale
            result.cov_xy = c_xy * scale
            result.var_flux = c_ff * scale
            result.chi2 = sums[9]
            result.pixels = sums[10]
            result.state = GOOD if longest <= _SETTLED_PX else WANDERED
            return
        shrink = min(1.0, _MAX_STEP_PX / longest)
        x += shrink * step_x
        y += shrink * step_y
        flux = max(flux + shrink * step_f, 0.2 * flux)
        if abs(x - start[0]) > window[2] or abs(y - start[1]) > window[3]:
            result.state = WANDERED
            return


@compiled_ieee
def explained(pixels: Array32, model: Array) -> tuple[float, float, float, float, float]:
    """Flux of a shape, and how far it and the highest pixel alone each reduce the sum of squares of a window.

    Each has its best-fitting flux, with equal weights of all pixels. If the highest pixel explains more than the shape of
    a star, it is a hot pixel or a particle hit. The sum of squares and its number of pixels are also returned.
    """
    highest = product = total = used = 0.0
    shape2 = 1e-12
    for k in range(pixels.size):
        valid = float(pixels[k]) < UNUSABLE
        value = float(pixels[k]) if valid else 0.0
        share = model[0, k] if valid else 0.0
        highest = max(highest, value)
        product += share * value
        shape2 += share * share
        total += value * value
        used += 1.0 if valid else 0.0
    return product / shape2, product * product / shape2, highest * highest, total, used
