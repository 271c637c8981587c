"""Shape of the stars of a frame: width of the spot, and the trail that a turning sensor draws.

Second moments of bright stars under a Gaussian weight that is adapted to the star itself (Bernstein & Jarvis 2002)
give each star's covariance. What all have in common and round is the spot; the rest is the trail: a star that moves
evenly by d during the exposure has d·dᵀ/12 added. As d is nearly linear in the image position (translation, roll,
and a little from the projection), d·dᵀ is taken as a quadratic in it; a pure roll, whose trails turn about a point
of the image, is covered as well.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from starid.background import interpolate_at
from starid.jit_loops import compiled_loops

_PIXEL_VARIANCE: Final = 1.0 / 12.0
_ITERATIONS: Final = 12
_SETTLED: Final = 1e-2
_LEAST_FOR_SPOT: Final = 3
_LEAST_FOR_FIELD: Final = 14
_ROUND_BELOW_PX: Final = 0.7
_LEAST_SIGMA_PX: Final = 0.3
_CLIP: Final = 3.0


@dataclass(frozen=True)
class SpotShape:
    """Spot and trail over a frame.

    Attributes
    ----------
    sigma_px : float
        Standard deviation of the spot, pixels.
    trail_field : ndarray (6, 3)
        Coefficients over (1, u, v, u², uv, v²), u and v the image position scaled to ±1, of the trail's products
        (dx², dx·dy, dy²), pixels²; all zero where stars are round.
    trail_px : float
        Median length of the trail, pixels.
    stars : int
        Stars that the estimate rests on; 0 if it is only assumed.
    """

    sigma_px: float
    trail_field: npt.NDArray[np.float64]
    trail_px: float
    stars: int


@compiled_loops
def adaptive_moments(
    image: npt.NDArray[np.uint8] | npt.NDArray[np.uint16],
    x0: float,
    y0: float,
    background: float,
    start_sigma: float,
    largest: int,
    saturation: float,
    moments: npt.NDArray[np.float64],
) -> bool:
    """Centre and covariance of a bright star: (x, y, c_xx, c_xy, c_yy) into `moments`; False if there is none.

    Parameters
    ----------
    image : ndarray (h, w)
        Counts.
    x0, y0, background, start_sigma
        First guess of the place, background under it, first guess of the width.
    largest : int
        Half-width of the window at most; a star that needs more is given up.
    saturation : float
        Counts from which a star is saturated and given up.
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
        if not determinant > 1e-4:
            return False
        i_xx, i_xy, i_yy = c_yy / determinant, -c_xy / determinant, c_xx / determinant
        total = m_x = m_y = m_xx = m_xy = m_yy = 0.0
        for row in range(top, bottom + 1):
            dy = row - y
            for column in range(left, right + 1):
                dx = column - x
                distance2 = i_xx * dx * dx + 2.0 * i_xy * dx * dy + i_yy * dy * dy
                if distance2 > 12.0:
                    continue
                if image[row, column] >= saturation:
                    return False
                light = math.exp(-0.5 * distance2) * (image[row, column] - background)
                total += light
                m_x += light * dx
                m_y += light * dy
                m_xx += light * dx * dx
                m_xy += light * dx * dy
                m_yy += light * dy * dy
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
        settled = change < _SETTLED * (c_xx + c_yy)
        c_xx, c_xy, c_yy = max(n_xx, 0.05), n_xy, max(n_yy, 0.05)
        if abs(x - x0) > largest or abs(y - y0) > largest:
            return False
        if settled:
            moments[0], moments[1] = x, y
            moments[2], moments[3], moments[4] = c_xx, c_xy, c_yy
            return True
    return False


@compiled_loops
def moments_of(
    image: npt.NDArray[np.uint8] | npt.NDArray[np.uint16],
    peaks: npt.NDArray[np.int32],
    level: npt.NDArray[np.float32],
    block: float,
    start_sigma: float,
    largest: int,
    saturation: float,
    wanted: int,
    table: npt.NDArray[np.float64],
) -> int:
    """Fill `table` (n, 5) with the moments of up to `wanted` peaks, in their order; return how many were usable."""
    count = 0
    for k in range(peaks.shape[0]):
        if count == wanted:
            break
        x, y = float(peaks[k, 0]), float(peaks[k, 1])
        background = interpolate_at(level, block, x, y)
        if adaptive_moments(image, x, y, background, start_sigma, largest, saturation, table[count]):
            count += 1
    return count


def quadratic_terms(
    x: npt.NDArray[np.float64], y: npt.NDArray[np.float64], width: int, height: int
) -> npt.NDArray[np.float64]:
    """Terms (n, 6) of a quadratic in the image position, scaled to ±1 at the edges."""
    u = (2.0 * x + 1.0) / width - 1.0
    v = (2.0 * y + 1.0) / height - 1.0
    return np.column_stack([np.ones_like(u), u, v, u * u, u * v, v * v])


@compiled_loops
def trail_at(
    field: npt.NDArray[np.float64], x: float, y: float, width: int, height: int
) -> tuple[float, float]:
    """Trail (dx, dy) in pixels at an image position, up to its sign, from the coefficients of `SpotShape`."""
    u = (2.0 * x + 1.0) / width - 1.0
    v = (2.0 * y + 1.0) / height - 1.0
    xx = (
        field[0, 0]
        + u * (field[1, 0] + u * field[3, 0] + v * field[4, 0])
        + v * (field[2, 0] + v * field[5, 0])
    )
    xy = (
        field[0, 1]
        + u * (field[1, 1] + u * field[3, 1] + v * field[4, 1])
        + v * (field[2, 1] + v * field[5, 1])
    )
    yy = (
        field[0, 2]
        + u * (field[1, 2] + u * field[3, 2] + v * field[4, 2])
        + v * (field[2, 2] + v * field[5, 2])
    )
    # the part of rank one: the larger eigenvalue and its direction
    half = 0.5 * (xx - yy)
    root = math.sqrt(half * half + xy * xy)
    largest = 0.5 * (xx + yy) + root
    if largest <= 0.0 or root <= 0.0:
        return 0.0, 0.0
    angle = 0.5 * math.atan2(xy, half)
    length = math.sqrt(largest)
    return length * math.cos(angle), length * math.sin(angle)


def shape_from_moments(
    table: npt.NDArray[np.float64],
    width: int,
    height: int,
    known_sigma_px: float | None,
    assumed_sigma_px: float,
) -> SpotShape:
    """Spot and trail from the moments of bright stars.

    Parameters
    ----------
    table : ndarray (n, 5)
        (x, y, c_xx, c_xy, c_yy) of each star.
    width, height : int
        Size of the image.
    known_sigma_px : float or None
        Width of the spot, where it is known.
    assumed_sigma_px : float
        Width to assume where too few stars tell.
    """
    none = np.zeros((6, 3))
    assumed = assumed_sigma_px if known_sigma_px is None else known_sigma_px
    if len(table) < _LEAST_FOR_SPOT:
        return SpotShape(assumed, none, 0.0, 0)
    c_xx, c_xy, c_yy = table[:, 2], table[:, 3], table[:, 4]
    root = np.hypot(0.5 * (c_xx - c_yy), c_xy)
    small = 0.5 * (c_xx + c_yy) - root
    # noise splits the eigenvalues of a round spot; where the split is common to all stars it is a trail
    trail = math.sqrt(12.0 * float(np.median(root)) * 2.0)
    spot = float(np.median(0.5 * (c_xx + c_yy)))
    direction = math.hypot(
        float(np.mean((c_xx - c_yy) / (2.0 * root + 1e-12))), float(np.mean(c_xy / (root + 1e-12)))
    )
    lined_up = direction > 0.5 or trail > 2.0
    if trail > _ROUND_BELOW_PX and lined_up:
        spot = float(np.median(small))
        sigma2 = max(spot - _PIXEL_VARIANCE, _LEAST_SIGMA_PX**2)
        sigma = math.sqrt(sigma2) if known_sigma_px is None else known_sigma_px
        products = 12.0 * np.column_stack(
            [c_xx - sigma**2 - _PIXEL_VARIANCE, c_xy, c_yy - sigma**2 - _PIXEL_VARIANCE]
        )
        return SpotShape(sigma, _fit_field(table, products, width, height), trail, len(table))
    sigma2 = max(spot - _PIXEL_VARIANCE, _LEAST_SIGMA_PX**2)
    return SpotShape(math.sqrt(sigma2) if known_sigma_px is None else known_sigma_px, none, 0.0, len(table))


def _fit_field(
    table: npt.NDArray[np.float64], products: npt.NDArray[np.float64], width: int, height: int
) -> npt.NDArray[np.float64]:
    """Least-squares quadratic (6, 3) through the trail's products, outliers dropped once; constant for few stars."""
    field = np.zeros((6, 3))
    centre = np.median(products, axis=0)
    off = np.abs(products - centre).sum(axis=1)
    if len(table) < _LEAST_FOR_FIELD:
        field[0] = centre
        return field
    terms = quadratic_terms(table[:, 0], table[:, 1], width, height)
    keep = np.ones(len(table), dtype=bool)
    for _ in range(2):
        field = np.linalg.lstsq(terms[keep], products[keep], rcond=None)[0].astype(np.float64)
        off = np.abs(products - terms @ field).sum(axis=1)
        keep = off <= _CLIP * max(float(np.median(off)), 1e-3)
        if np.count_nonzero(keep) < _LEAST_FOR_FIELD:
            break
    return field
