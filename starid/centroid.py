"""Sub-pixel position and flux of a star: the maximum-likelihood fit of its spot to the pixels around it.

The model of a pixel is flux × (share of the spot in the pixel) + background. Position and flux are found by
Gauss–Newton steps on the weighted squares, each pixel weighted by the inverse of its variance under the model:
background noise, shot noise of the star's own light, and a share of its light for what the model does not hold
(pixel response, shape of the spot). The inverse of the normal matrix is then the covariance of the estimate, that
is the Cramér–Rao bound for the noise given. Saturated pixels carry no weight.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import numpy.typing as npt

from starid.jit_loops import compiled_loops

FIT_COLUMNS: Final = 9
X, Y, FLUX, VAR_X, VAR_Y, VAR_FLUX, CHI2, PIXELS, STATE = range(FIT_COLUMNS)
"""Columns of a table of fits; STATE is one of the numbers below."""

GOOD, NO_FIT, HOT_PIXEL, WANDERED = range(4)

_ITERATIONS: Final = 12
_CONVERGED_PX: Final = 1e-3
_CONVERGED_FLUX: Final = 0.01
_SETTLED_PX: Final = 0.02
_MAX_STEP_PX: Final = 1.0
_FLOOR_FLUX: Final = 1e-6
_SQRT_HALF: Final = math.sqrt(0.5)
_INV_SQRT_2PI: Final = 1.0 / math.sqrt(2.0 * math.pi)
_LEAST_PIXELS: Final = 5
_PIXEL_VARIANCE: Final = 1.0 / 12.0
_FAR: Final = 5.0
SHORT_TRAIL_PX: Final = 0.5
"""A shorter trail is fitted as a round spot."""


@compiled_loops
def spot_profile(
    centre: float,
    sigma: float,
    first: int,
    share: npt.NDArray[np.float64],
    slope: npt.NDArray[np.float64],
    count: int,
) -> None:
    """Shares of a Gaussian at `centre` in `count` pixels from `first` on, and their derivatives by the centre."""
    scale = _SQRT_HALF / sigma
    norm = _INV_SQRT_2PI / sigma
    z = (first - 0.5 - centre) * scale
    cdf = 0.5 * math.erf(z)
    bell = norm * math.exp(-z * z)
    for k in range(count):
        z += scale
        next_cdf = 0.5 * math.erf(z)
        next_bell = norm * math.exp(-z * z)
        share[k] = next_cdf - cdf
        slope[k] = bell - next_bell
        cdf = next_cdf
        bell = next_bell


@compiled_loops
def spot_model(x: float, y: float, sigma: float, left: int, top: int, model: npt.NDArray[np.float64]) -> None:
    """Shares of a round spot in the pixels of a window.

    Parameters
    ----------
    x, y, sigma : float
        Centre and standard deviation, pixels.
    left, top : int
        Image column and row of the window's first pixel.
    model : ndarray (3, rows, columns)
        Filled with the share of the light in each pixel, and its derivatives by x and by y.
    """
    _, rows, columns = model.shape
    share_x = np.empty(columns)
    slope_x = np.empty(columns)
    share_y = np.empty(rows)
    slope_y = np.empty(rows)
    spot_profile(x, sigma, left, share_x, slope_x, columns)
    spot_profile(y, sigma, top, share_y, slope_y, rows)
    for j in range(rows):
        for i in range(columns):
            model[0, j, i] = share_x[i] * share_y[j]
            model[1, j, i] = slope_x[i] * share_y[j]
            model[2, j, i] = share_x[i] * slope_y[j]


@compiled_loops
def trail_model(
    x: float,
    y: float,
    sigma: float,
    trail: tuple[float, float],
    left: int,
    top: int,
    model: npt.NDArray[np.float64],
) -> None:
    """As `spot_model`, for a spot that moves evenly by `trail` pixels during the exposure, x and y its middle.

    Along the trail the light is a Gaussian smeared over its length, across it a Gaussian; the pixel's own size
    counts as 1/12 square pixel more of the spot's variance.
    """
    _, rows, columns = model.shape
    length = math.hypot(trail[0], trail[1])
    along_x, along_y = trail[0] / length, trail[1] / length
    spread = math.sqrt(sigma * sigma + _PIXEL_VARIANCE)
    inverse = 1.0 / spread
    half = 0.5 * length
    across_norm = _INV_SQRT_2PI * inverse
    for j in range(rows):
        for i in range(columns):
            dx = left + i - x
            dy = top + j - y
            u = dx * along_x + dy * along_y
            v = (dy * along_x - dx * along_y) * inverse
            head = (u + half) * inverse
            tail = (u - half) * inverse
            if abs(v) > _FAR or tail > _FAR or head < -_FAR:
                model[:, j, i] = 0.0
                continue
            across = across_norm * math.exp(-0.5 * v * v)
            along = 0.5 * (math.erf(head * _SQRT_HALF) - math.erf(tail * _SQRT_HALF)) / length
            bells = math.exp(-0.5 * tail * tail) - math.exp(-0.5 * head * head)
            by_u = bells * _INV_SQRT_2PI * inverse / length * across
            by_v = along * across * v * inverse
            model[0, j, i] = along * across
            model[1, j, i] = by_u * along_x - by_v * along_y
            model[2, j, i] = by_u * along_y + by_v * along_x


@compiled_loops
def fit_star(
    pixels: npt.NDArray[np.float32],
    left: int,
    top: int,
    start: tuple[float, float],
    shape: tuple[float, float, float],
    noise: tuple[float, float, float],
    model: npt.NDArray[np.float64],
    result: npt.NDArray[np.float64],
) -> None:
    """Fit one star to a window.

    Parameters
    ----------
    pixels : ndarray (rows, columns), float32
        Counts above the background; infinite ones are not used.
    left, top : int
        Image column and row of the window's first pixel.
    start : (float, float)
        First guess of the position, image pixels.
    shape : (float, float, float)
        Standard deviation of the spot, and the trail along x and y, pixels.
    noise : (float, float, float)
        Variance of a pixel without star light (counts²); variance that a count of star light brings (1/gain, 0 if
        unknown); share of its light by which the model may be wrong in a pixel.
    model : ndarray (3, rows, columns)
        Left with the model at the result.
    result : ndarray (FIT_COLUMNS,)
        Filled; CHI2 is the sum of weighted squares over PIXELS pixels.
    """
    rows, columns = pixels.shape
    sigma, trail_x, trail_y = shape
    variance, per_dn, model_error = noise
    trailed = math.hypot(trail_x, trail_y) > SHORT_TRAIL_PX
    x, y = start
    flux = -1.0
    result[STATE] = NO_FIT
    error2 = model_error * model_error
    for iteration in range(_ITERATIONS + 1):
        if trailed:
            trail_model(x, y, sigma, (trail_x, trail_y), left, top, model)
        else:
            spot_model(x, y, sigma, left, top, model)
        if flux <= 0.0:
            flux = _best_flux(pixels, model)
        a_xx = a_xy = a_yy = a_xf = a_yf = a_ff = 0.0
        b_x = b_y = b_f = 0.0
        chi2 = 0.0
        used = 0
        for j in range(rows):
            for i in range(columns):
                value = pixels[j, i]
                if math.isinf(value):
                    continue
                share = model[0, j, i]
                light = flux * share
                weight = 1.0 / (variance + light * per_dn + error2 * light * light)
                off = value - light
                d_x = flux * model[1, j, i]
                d_y = flux * model[2, j, i]
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
                used += 1
        # covariance of (x, y, flux): inverse of the symmetric 3 × 3 normal matrix
        c_xx = a_yy * a_ff - a_yf * a_yf
        c_xy = a_xf * a_yf - a_xy * a_ff
        c_xf = a_xy * a_yf - a_xf * a_yy
        c_yy = a_xx * a_ff - a_xf * a_xf
        c_yf = a_xy * a_xf - a_xx * a_yf
        c_ff = a_xx * a_yy - a_xy * a_xy
        determinant = a_xx * c_xx + a_xy * c_xy + a_xf * c_xf
        if used < _LEAST_PIXELS or not determinant > 0.0:
            return
        scale = 1.0 / determinant
        step_x = (c_xx * b_x + c_xy * b_y + c_xf * b_f) * scale
        step_y = (c_xy * b_x + c_yy * b_y + c_yf * b_f) * scale
        step_f = (c_xf * b_x + c_yf * b_y + c_ff * b_f) * scale
        longest = max(abs(step_x), abs(step_y))
        settled = longest <= _CONVERGED_PX and abs(step_f) <= _CONVERGED_FLUX * flux
        if settled or iteration == _ITERATIONS:
            result[X] = x + step_x if settled else x
            result[Y] = y + step_y if settled else y
            result[FLUX] = flux + step_f
            result[VAR_X] = c_xx * scale
            result[VAR_Y] = c_yy * scale
            result[VAR_FLUX] = c_ff * scale
            result[CHI2] = chi2
            result[PIXELS] = used
            result[STATE] = GOOD if longest <= _SETTLED_PX else WANDERED
            return
        shrink = min(1.0, _MAX_STEP_PX / longest)
        x += shrink * step_x
        y += shrink * step_y
        flux = max(flux + shrink * step_f, 0.2 * flux)


@compiled_loops
def _best_flux(pixels: npt.NDArray[np.float32], model: npt.NDArray[np.float64]) -> float:
    """Flux that fits a window best at a given place, all pixels weighted alike."""
    above = 0.0
    below = 1e-12
    for j in range(pixels.shape[0]):
        for i in range(pixels.shape[1]):
            if not math.isinf(pixels[j, i]):
                above += model[0, j, i] * pixels[j, i]
                below += model[0, j, i] * model[0, j, i]
    return max(above / below, _FLOOR_FLUX)


@compiled_loops
def explained(
    pixels: npt.NDArray[np.float32], model: npt.NDArray[np.float64]
) -> tuple[float, float, float, int]:
    """Drop in the sum of squares of a window that the fitted shape makes, and that its highest pixel alone makes.

    Each with its best brightness. Where the highest pixel explains more than the shape of a star does, it is a hot
    pixel or a particle's hit. Returned beside them: the sum of squares itself, and the number of pixels in it.
    """
    highest = 0.0
    product = 0.0
    shape2 = 1e-12
    total = 0.0
    used = 0
    for j in range(pixels.shape[0]):
        for i in range(pixels.shape[1]):
            value = float(pixels[j, i])
            if math.isinf(value):
                continue
            highest = max(highest, value)
            product += model[0, j, i] * value
            shape2 += model[0, j, i] * model[0, j, i]
            total += value * value
            used += 1
    return product * product / shape2, highest * highest, total, used
