"""Width of the spot, fitted to bright stars together with position and flux."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from starid.arithmetic.arrays import Array, Array32, GreyImage, Indices32
from starid.imaging.background import interpolate_at
from starid.imaging.centroid import FIT, GOOD, Fit, fit_star, relative_width, spot_model
from starid.kernels.jit import compiled_ieee

NARROWEST_PX: Final = 0.25
WIDEST_PX: Final = 8.0
_REACH_SIGMA: Final = 3.5
_LARGEST_HALF_WIDTH: Final = 28
_ROUNDS: Final = 8
_STEP: Final = 0.02
_MAX_CHANGE: Final = 0.3
_CHANGE_SHARE: Final = 0.01
_MODEL_ERROR: Final = 0.02


@compiled_ieee
def _one_width(
    image: GreyImage,
    column: int,
    row: int,
    sky: float,
    noise: float,
    start: float,
    saturation: float,
    result: Fit,
) -> float:
    """Fit the width of the star at a peak; NaN if that fails."""
    height, width = image.shape
    sigma = start
    for _ in range(_ROUNDS):
        half = min(max(math.ceil(_REACH_SIGMA * sigma), 3), _LARGEST_HALF_WIDTH)
        left, top, side = column - half, row - half, 2 * half + 1
        if left < 0 or top < 0 or left + side > width or top + side > height:
            return math.nan
        pixels = np.empty(side * side, np.float32)
        for j in range(side):
            for i in range(side):
                value = image[top + j, left + i]
                if value >= saturation:
                    return math.nan
                pixels[j * side + i] = value - sky
        window = (left, top, side, side)
        model = np.empty((3, side * side))
        wider = np.empty((3, side * side))
        narrower = np.empty((3, side * side))
        work = np.empty((5, max(side, 11)))
        place = (float(column), float(row))
        noises = (noise * noise, 0.0, _MODEL_ERROR)
        fit_star(pixels, window, place, (sigma, 0.0, 0.0), noises, 0.0, model, work, result)
        if result.state != GOOD or not result.flux > 0.0:
            return math.nan
        x, y, flux = result.x, result.y, result.flux
        spot_model(x, y, sigma, window, model, work)
        spot_model(x, y, sigma * (1.0 + _STEP), window, wider, work)
        spot_model(x, y, sigma * (1.0 - _STEP), window, narrower, work)
        # least squares for flux and width; the position is uncorrelated with both
        ff = fs = ss = bf = bs = 0.0
        for k in range(pixels.size):
            share = model[0, k]
            slope = flux * (wider[0, k] - narrower[0, k]) / (2.0 * _STEP * sigma)
            light = flux * share
            weight = 1.0 / (noise * noise + _MODEL_ERROR * _MODEL_ERROR * light * light)
            off = pixels[k] - light
            ff += weight * share * share
            fs += weight * share * slope
            ss += weight * slope * slope
            bf += weight * share * off
            bs += weight * slope * off
        determinant = ff * ss - fs * fs
        if not determinant > 0.0:
            return math.nan
        change = (ff * bs - fs * bf) / determinant
        change = min(max(change, -_MAX_CHANGE * sigma), _MAX_CHANGE * sigma)
        sigma += change
        if not NARROWEST_PX <= sigma <= WIDEST_PX:
            return math.nan
        if abs(change) < _CHANGE_SHARE * sigma:
            return sigma
    return math.nan


@compiled_ieee
def spot_widths(
    image: GreyImage,
    peaks: Indices32,
    level: Array32,
    noise: Array32,
    block: float,
    start: float,
    saturation: float,
    growth: float,
    widths: Array,
) -> int:
    """Fill `widths` (m,) with the mean widths in the image by the first peaks that can be fitted; return their number.

    Parameters
    ----------
    image : ndarray (h, w)
        Counts.
    peaks : ndarray (n, 2)
        Column and row of each, brightest first.
    level, noise, block
        Background on its grid, and the side of a block.
    start : float
        First guess, pixels.
    saturation : float
        Smallest count of a saturated pixel; saturated stars are rejected.
    growth : float
        Growth of the spot towards the edge (`starid.imaging.centroid.relative_width`).
    """
    count = 0
    result: Fit = np.empty(1, FIT)[0]
    for k in range(peaks.shape[0]):
        if count == widths.size:
            break
        column, row = peaks[k, 0], peaks[k, 1]
        x, y = float(column), float(row)
        sky = interpolate_at(level, block, x, y)
        spread = interpolate_at(noise, block, x, y)
        width = _one_width(image, column, row, sky, max(spread, 1e-3), start, saturation, result)
        if width == width:
            widths[count] = width / relative_width(x, y, image.shape[1], image.shape[0], growth)
            count += 1
    return count
