"""Shape of the stars in an image: width of the spot, and the trails of a rotating sensor.

Second moments of bright stars under an adaptive Gaussian weight (Bernstein & Jarvis 2002) give the covariance of each
star: across a trail it is the variance of the spot, along it is larger.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np

from starid.arithmetic.arrays import Array, Array32, GreyImage, Indices32, Mask, interpolated
from starid.arithmetic.elementary import square
from starid.imaging.background import interpolate_at, median
from starid.imaging.normal_table import gaussian
from starid.imaging.trail_flow import FLOW_TERMS, fit_flow, lengths_and_mismatches
from starid.kernels.jit import compiled_ieee

MIN_LONG: Final = 6
"""Least number of elongated objects that agree on a flow, among others that are round."""

MOMENT_COLUMNS: Final = 5
_PIXEL_VARIANCE: Final = 1.0 / 12.0
_ITERATIONS: Final = 30
_CHANGE_SHARE: Final = 1e-2
_WEIGHT_END: Final = 12.0
_MIN_FOR_SPOT: Final = 3
_ROUND_BELOW_PX: Final = 1.0
_MIN_SIGMA_PX: Final = 0.3
_LEAST_SPLIT: Final = 1e-300
_SERIES_END: Final = 101
_MISMATCH_SHARE: Final = 0.4
_LONG_PX: Final = 2.5
_AGREEMENT_SHARE: Final = 0.3
_AGREEING_SHARE: Final = 0.5


@dataclass(frozen=True)
class SpotShape:
    """Spot and trails of an image.

    Attributes
    ----------
    sigma_px : float
        Standard deviation of the spot, pixels.
    flow : ndarray (5,)
        Flow of the trails (`starid.imaging.trail_flow`); all zero if stars are round.
    trail_px : float
        Median length of the trails, pixels.
    stars : int
        Number of stars used for the estimate; 0 for an assumed width.
    """

    sigma_px: float
    flow: Array
    trail_px: float
    stars: int


@compiled_ieee
def _weighted_sums(
    image: GreyImage,
    box: tuple[int, int, int, int],
    x: float,
    y: float,
    inverse: tuple[float, float, float],
    background: float,
    saturation: float,
) -> tuple[float, float, float, float, float, float]:
    """Sum of the light under a Gaussian weight about (x, y), and of it times dx, dy, dx², dx·dy and dy².

    `box` holds the first and last column and row, `inverse` xx, xy and yy of the weight's inverse covariance. The first sum is 0 where a saturated pixel has weight.
    """
    total = m_x = m_y = m_xx = m_xy = m_yy = saturated = 0.0
    for row in range(box[2], box[3] + 1):
        dy = row - y
        line = image[row, box[0] : box[1] + 1]
        for column in range(np.int32(line.size)):
            dx = box[0] - x + column
            distance2 = inverse[0] * dx * dx + 2.0 * inverse[1] * dx * dy + inverse[2] * dy * dy
            value = float(line[column])
            weight = gaussian(distance2) if distance2 <= _WEIGHT_END else 0.0
            saturated += weight if value >= saturation else 0.0
            light = weight * (value - background)
            total += light
            m_x += light * dx
            m_y += light * dy
            m_xx += light * dx * dx
            m_xy += light * dx * dy
            m_yy += light * dy * dy
    return 0.0 if saturated > 0.0 else total, m_x, m_y, m_xx, m_xy, m_yy


@compiled_ieee
def adaptive_moments(
    image: GreyImage,
    x0: float,
    y0: float,
    background: float,
    start_sigma: float,
    largest: int,
    saturation: float,
    moments: Array,
) -> bool:
    """Measure centre and covariance (x, y, c_xx, c_xy, c_yy) of a bright star; False if there is none.

    Parameters
    ----------
    image : ndarray (h, w)
        Counts.
    x0, y0, background, start_sigma
        First guess of the position, local background, first guess of the width.
    largest : int
        Largest half-width of the window; a star that needs more is rejected.
    saturation : float
        Smallest count of a saturated pixel; saturated stars are rejected.
    """
    height, width = image.shape
    x, y = x0, y0
    c_xx = c_yy = start_sigma * start_sigma
    c_xy = 0.0
    for _ in range(_ITERATIONS):
        reach_x = math.ceil(3.0 * math.sqrt(c_xx))
        reach_y = math.ceil(3.0 * math.sqrt(c_yy))
        if max(reach_x, reach_y) > largest:
            return False
        left, right = round(x) - reach_x, round(x) + reach_x
        top, bottom = round(y) - reach_y, round(y) + reach_y
        if left < 0 or top < 0 or right >= width or bottom >= height:
            return False
        determinant = c_xx * c_yy - c_xy * c_xy
        if not determinant > 1e-4:  # the covariance of a line has no inverse
            return False
        inverse = (c_yy / determinant, -c_xy / determinant, c_xx / determinant)
        total, m_x, m_y, m_xx, m_xy, m_yy = _weighted_sums(
            image, (left, right, top, bottom), x, y, inverse, background, saturation
        )
        if not total > 0.0:
            return False
        m_x /= total
        m_y /= total
        x += 2.0 * m_x
        y += 2.0 * m_y
        n_xx = 2.0 * (m_xx / total - m_x * m_x)
        n_xy = 2.0 * (m_xy / total - m_x * m_y)
        n_yy = 2.0 * (m_yy / total - m_y * m_y)
        change = abs(n_xx - c_xx) + abs(n_yy - c_yy) + abs(n_xy - c_xy)
        settled = change < _CHANGE_SHARE * (c_xx + c_yy)
        c_xx, c_xy, c_yy = max(n_xx, 0.05), n_xy, max(n_yy, 0.05)
        if abs(x - x0) > largest or abs(y - y0) > largest:
            return False
        if settled:
            moments[0], moments[1] = x, y
            moments[2], moments[3], moments[4] = c_xx, c_xy, c_yy
            return True
    return False


@compiled_ieee
def moments_of(
    image: GreyImage,
    peaks: Indices32,
    level: Array32,
    block: float,
    start_sigma: float,
    largest: int,
    saturation: float,
    table: Array,
) -> int:
    """Fill `table` (n, 5) with the moments of the first measurable peaks; return their number.

    Peaks that converge to the same position (several on one trail) count once.
    """
    count = 0
    for k in range(peaks.shape[0]):
        if count == table.shape[0]:
            break
        x, y = float(peaks[k, 0]), float(peaks[k, 1])
        background = interpolate_at(level, block, x, y)
        if not adaptive_moments(image, x, y, background, start_sigma, largest, saturation, table[count]):
            continue
        again = False
        for earlier in range(count):
            off = abs(table[earlier, 0] - table[count, 0]) + abs(table[earlier, 1] - table[count, 1])
            again = again or off < 2.0  # pixels
        if not again:
            count += 1
    return count


def shape_from_moments(
    table: Array, width: int, height: int, known_sigma_px: float | None, assumed_sigma_px: float
) -> SpotShape:
    """Estimate the spot and the trails from the moments of bright stars.

    Parameters
    ----------
    table : ndarray (n, 5)
        (x, y, c_xx, c_xy, c_yy) of each star.
    width, height : int
        Size of the image.
    known_sigma_px : float or None
        Width of the spot, if it is known.
    assumed_sigma_px : float
        Width to assume if there are too few stars.
    """
    still = np.zeros(FLOW_TERMS)
    if len(table) < _MIN_FOR_SPOT:
        return SpotShape(known_sigma_px or assumed_sigma_px, still, 0.0, 0)
    mean, split = _mean_and_split(table)
    across = square(known_sigma_px) + _PIXEL_VARIANCE if known_sigma_px else median(mean - split)
    across = max(across, square(_MIN_SIGMA_PX) + _PIXEL_VARIANCE)
    # for a short trail of length L the split is L²/24
    if math.sqrt(24.0 * median(split)) > _ROUND_BELOW_PX:
        positions, trails, length = _trails(table, width, height, across)
        flow = np.zeros(FLOW_TERMS)
        fit_flow(positions, trails, flow)
        lengths, off = lengths_and_mismatches(flow, positions, trails)
        typical = median(lengths)
        if typical > _ROUND_BELOW_PX and median(off) < _MISMATCH_SHARE * median(length):
            return SpotShape(_sigma(across, known_sigma_px), flow, typical, len(table))
    return SpotShape(_sigma(median(mean), known_sigma_px), still, 0.0, len(table))


def long_trails(table: Array, sigma_px: float) -> Mask:
    """Mask (n,) of the stars, in a table of moments, too elongated for noise or a close neighbour."""
    mean, split = _mean_and_split(table)
    return np.asarray(trail_length(mean + split, square(sigma_px) + _PIXEL_VARIANCE) > _LONG_PX, dtype=bool)


def trails_among_round(longest: Array, width: int, height: int, shape: SpotShape, least: int) -> SpotShape:
    """Find trails where most objects are round and not stars: particles, hot pixels, reflections.

    Parameters
    ----------
    longest : ndarray (n, 5)
        Moments, as in `shape_from_moments`, of the elongated objects (`long_trails`).
    width, height : int
        Size of the image.
    shape : SpotShape
        Shape of the round objects; returned unchanged unless enough elongated ones agree on a flow.
    least : int
        Least number of those that agree.
    """
    if len(longest) < least:
        return shape
    trail = shape_from_moments(longest, width, height, shape.sigma_px, shape.sigma_px)
    positions, trails, length = _trails(longest, width, height, square(shape.sigma_px) + _PIXEL_VARIANCE)
    agree = np.count_nonzero(
        lengths_and_mismatches(trail.flow, positions, trails)[1] < _AGREEMENT_SHARE * length
    )
    return trail if trail.trail_px > 0.0 and agree >= max(least, _AGREEING_SHARE * len(longest)) else shape


def _mean_and_split(table: Array) -> tuple[Array, Array]:
    """Mean (n,) and half-difference (n,) of the variances along and across each star of a table of moments."""
    c_xx, c_xy, c_yy = table[:, 2], table[:, 3], table[:, 4]
    return 0.5 * (c_xx + c_yy), np.sqrt(square(0.5 * (c_xx - c_yy)) + square(c_xy))


def _trails(table: Array, width: int, height: int, across: float) -> tuple[Array, Array, Array]:
    """Positions (n, 2) for `fit_flow`, trails (n, 2) and lengths (n,), given the variance across the trails."""
    mean, split = _mean_and_split(table)
    length = trail_length(mean + split, across)
    # half of the angle of (c_xx − c_yy, 2 c_xy)
    difference, mixed = 0.5 * (table[:, 2] - table[:, 4]), table[:, 3]
    size = np.maximum(split, _LEAST_SPLIT)
    larger = np.sqrt(0.5 + 0.5 * np.abs(difference) / size)
    smaller = 0.5 * np.abs(mixed) / (size * larger)
    cosine = np.where(difference < 0.0, smaller, larger)
    sine = np.copysign(np.where(difference < 0.0, larger, smaller), mixed)
    trails = length[:, None] * np.column_stack([cosine, sine])
    positions = (table[:, :2] - 0.5 * (np.array([width, height]) - 1.0)) / (0.5 * max(width, height))
    return positions, trails, length


def _sigma(variance: float, known: float | None) -> float:
    """Standard deviation of the spot from its variance as sampled by pixels."""
    return known or math.sqrt(max(variance - _PIXEL_VARIANCE, square(_MIN_SIGMA_PX)))


@lru_cache(maxsize=1)
def _box_share() -> tuple[Array, Array]:
    """Half-length z of a box in sigmas of a Gaussian weight, from 0, and 1 − 2zφ(z)/(2Φ(z) − 1) for it."""
    z = np.linspace(1e-3, 4.0, 2000)
    # Φ(z) − ½ = φ(z) (z + z³/3 + z⁵/15 + …)
    term, series = z, np.zeros_like(z)
    for k in range(3, _SERIES_END, 2):
        term = term * square(z) / k
        series += term
    return np.append(0.0, z), np.append(0.0, series / (z + series))


def trail_length(along: Array, across: float) -> Array:
    """Lengths (n,) of trails from the adaptive variances along (n,) and across them.

    A trail is a box of half-length h convolved with the spot. Under a Gaussian weight of variance C (in units of the
    spot's) its second moment is C/(C + 1) + (C/(C + 1))²·(C + 1)·s, where s is the share of the variance that a Gaussian of
    variance C + 1 retains on (−h, h); adapted moments equal C/2, so that s = (C − 1)/2C.
    """
    ratio = np.maximum(along / across, 1.0)
    z, share = _box_share()
    cut = interpolated((ratio - 1.0) / (2.0 * ratio), share, z)
    return np.asarray(2.0 * cut * np.sqrt(ratio + 1.0) * math.sqrt(across), dtype=np.float64)
