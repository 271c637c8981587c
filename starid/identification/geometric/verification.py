"""Verification: a fast sequential test, then a bound on the probability that an agreement is chance.

There are two stages. `worth_refining` tests a candidate attitude star by star with Wald's sequential
probability ratio test: wrong candidates fail after a few lookups. `log_false_probability` computes the bound.

The bound compares two explanations of the detections. *Chance*: each of n detections lies anywhere in the
field of area A. *Sky*: an attitude is drawn uniformly from all rotations; then each detection is, with
probability a, a catalogue star of about its brightness, displaced by the centroid noise, and otherwise lies
anywhere. A detection matched to a star at distance r with magnitude deviation Δm thus favours the sky by

    (1 − a) + a · A · w · N₂(r; σ) ,  w = N(Δm; s)/λ(m)  (at most 1),

where λ(m) is the number of catalogue stars per magnitude in the field, so that w is the probability that it
is this star among those of its brightness. An unmatched detection contributes 1 − a. The product is
integrated over the attitude (Laplace's method: the volume of the posterior over that of the prior), over the
photometric zero point, and over the noise if that was estimated, and averaged over a few shares a. The result
is a Bayes factor B whose expectation under chance is 1. By Markov's inequality, chance reaches B or more with
a probability of at most 1/B, however long the search was: 1/B is the bound reported in a solution.

Near a prediction a second rival is as serious as chance: *one star* is where it was expected, and all others
are chance. Its factor is at most A·w·z/Ω, where Ω is the solid angle (px²) in which the prediction lets that
star lie, and z the share of the zero points that fit it. If this exceeds 1, B is divided by it. Two true
stars are no rival: they determine the attitude. Lost in space, Ω is the whole sphere: no rival.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from starid.arithmetic.arrays import Array, Indices, Indices32
from starid.arithmetic.elementary import exp, log, square
from starid.camera.parameter_array import MODEL
from starid.identification.geometric.matching import residual
from starid.identification.geometric.observation import MAGNITUDE, SIGMA_U, SIGMA_V, Table, X, Y, Z, scaled
from starid.identification.geometric.pattern_index import (
    BINS_PER_MAGNITUDE,
    COUNT_CELLS,
    GRID_CELLS,
    STAR_MAGNITUDE,
    IndexArrays,
    magnitude_bin,
)
from starid.identification.geometric.refinement import (
    PRIOR_FREEDOM,
    SCALE_VARIANCE,
    SCATTER,
    VARIANCE,
    ZERO_POINT,
)
from starid.identification.geometric.settings import Settings
from starid.identification.geometric.sky_grid import cell_of
from starid.kernels.jit import inner

TRUE_SHARE: Final = 0.5
"""Share of the detections that are catalogue stars, for the sequential test."""

REJECT_BELOW: Final = -2.6
"""Log odds at which a candidate is dropped: four misses in succession."""

ACCEPT_ABOVE: Final = 9.0
"""Log odds at which the sequential test accepts a candidate."""

MAX_TESTED: Final = 40
"""Largest number of detections tested."""

WHOLE_SKY: Final = (8.0 * square(math.pi), 4.0 * math.pi)
"""Prior for an unknown attitude: volume of all rotations (rad³), solid angle for one star (sr)."""

ZERO_POINT_RANGE: Final = 10.0
"""Range of the photometric zero point, magnitudes."""

MIN_NOISE: Final = 0.05
MAX_NOISE: Final = 5.0
"""Range of the centroid noise if it is estimated, pixels."""

SHARES: Final = (0.2, 0.5, 0.9)
"""Shares of true stars among the detections, over which the Bayes factor is averaged."""

_SMALL: Final = 1e-150
"""A product below this or above its inverse is replaced by its logarithm."""

SCATTER_FLOOR: Final = 0.15
"""Least scatter of magnitudes assumed in the bound."""


@inner
def hit_odds(index: IndexArrays, window_rad: float) -> Array:
    """Log of the odds gained by a hit, for each magnitude limit of the lookup (bins)."""
    sky, bins = index.counts.shape[0] - 1, index.counts.shape[1]
    odds = np.empty(bins)
    for b in range(bins):
        chance = min(0.25 * index.counts[sky, b] * window_rad * window_rad + 1e-6, 0.9)
        odds[b] = log(TRUE_SHARE / chance + 1.0 - TRUE_SHARE)
    return odds


@inner
def test_order(count: int) -> Indices:
    """Order in which detections are tested: alternately from the bright and the faint half.

    The brightest carry the most information, but are often false. Each pattern starts at a different position
    of the order, so that a few false stars cannot block every candidate.
    """
    order = np.empty(count, dtype=np.int64)
    half = (count + 1) // 2
    for i in range(half):
        order[2 * i] = i
        if 2 * i + 1 < count:
            order[2 * i + 1] = half + i
    return order


@inner
def worth_refining(
    index: IndexArrays,
    params: Array,
    observed: Table,
    rotation: Array,
    scale: float,
    faintest_offset: float,
    settings: Settings,
    odds: Array,
    order: Indices,
    used: tuple[int, int, int],
) -> bool:
    """Test a candidate attitude sequentially on detections outside its pattern.

    Parameters
    ----------
    params : ndarray
        The camera.
    scale : float
        Divisor of its focal length (1 if it is known).
    faintest_offset : float
        Largest catalogue minus instrumental magnitude of a true star.
    odds : ndarray
        From `hit_odds`.
    order : ndarray
        From `test_order`.
    used : (int, int, int)
        Detections of the pattern.
    """
    stars, grid_start, grid_stars = index.stars, index.grid_start, index.grid_stars
    cells = int(index.numbers[GRID_CELLS])
    limit2 = settings.test_window * settings.test_window
    miss = log(1.0 - TRUE_SHARE)
    total = 0.0
    hits = 0
    count = order.shape[0]
    position = (used[0] + used[1] + used[2]) % count
    for _ in range(min(count, MAX_TESTED)):
        i = order[position]
        position += 1
        if position == count:
            position = 0
        if i == used[0] or i == used[1] or i == used[2]:
            continue
        u, v, w = scaled(params[MODEL], observed[i, X], observed[i, Y], observed[i, Z], scale)
        x = rotation[0, 0] * u + rotation[1, 0] * v + rotation[2, 0] * w
        y = rotation[0, 1] * u + rotation[1, 1] * v + rotation[2, 1] * w
        z = rotation[0, 2] * u + rotation[1, 2] * v + rotation[2, 2] * w
        faintest = observed[i, MAGNITUDE] + faintest_offset
        cell = cell_of(x, y, z, cells)
        hit = False
        for entry in range(grid_start[cell], grid_start[cell + 1]):
            star = grid_stars[entry]
            if stars[star, STAR_MAGNITUDE] > faintest:
                break
            dx, dy, dz = stars[star, 0] - x, stars[star, 1] - y, stars[star, 2] - z
            if dx * dx + dy * dy + dz * dz < limit2:
                hit = True
                break
        total += odds[magnitude_bin(faintest, odds.shape[0])] if hit else miss
        hits += 1 if hit else 0
        if total < REJECT_BELOW:
            return False
        if total > ACCEPT_ABOVE and hits > 1:
            return True
    return total > 0.0 and hits > 0


@inner
def _stars_per_magnitude(counts: Indices32, cell: int, magnitude: float) -> float:
    """Catalogue stars per magnitude in a field, smoothed over one magnitude; at least one."""
    bins = counts.shape[1]
    middle = magnitude_bin(magnitude, bins)
    low, high = middle - BINS_PER_MAGNITUDE // 2 - 1, min(middle + BINS_PER_MAGNITUDE // 2, bins - 1)
    stars = float(counts[cell, high])
    if low >= 0:
        stars -= counts[cell, low]
    return float(max(stars * BINS_PER_MAGNITUDE / (high - max(low, -1)), 1.0))


@inner
def _log_detections(
    index: IndexArrays,
    detections: Table,
    rotation: Array,
    stars: Indices,
    numbers: Array,
    deviation_of_one: float,
    field_px: float,
) -> tuple[float, float]:
    """Log of the product over the detections, averaged over `SHARES`, and the largest A·w·z; see the module.

    `deviation_of_one` is the centroid noise in units of the stated errors.
    """
    star_table, counts = index.stars, index.counts
    cell = cell_of(rotation[2, 0], rotation[2, 1], rotation[2, 2], COUNT_CELLS)
    scatter = max(numbers[SCATTER], SCATTER_FLOOR)
    least_density = math.inf
    totals, products = np.zeros(len(SHARES)), np.ones(len(SHARES))
    for i in range(stars.shape[0]):
        gain = 0.0
        star = stars[i]
        if star >= 0:
            magnitude = star_table[star, STAR_MAGNITUDE]
            r0, r1, _, _, _ = residual(star_table, detections, rotation, i, star)
            su, sv = deviation_of_one * detections[i, SIGMA_U], deviation_of_one * detections[i, SIGMA_V]
            here = exp(-0.5 * (square(r0 / su) + square(r1 / sv))) / (2.0 * math.pi * su * sv)
            deviation = (magnitude - detections[i, MAGNITUDE] - numbers[ZERO_POINT]) / scatter
            brightness = exp(-0.5 * deviation * deviation) / (math.sqrt(2.0 * math.pi) * scatter)
            density = _stars_per_magnitude(counts, cell, magnitude)
            gain = field_px * min(brightness / density, 1.0) * here
            least_density = min(least_density, density)
        for k in range(len(SHARES)):
            products[k] *= 1.0 - SHARES[k] + SHARES[k] * gain
            if not _SMALL < products[k] < 1.0 / _SMALL:
                totals[k] += log(products[k])
                products[k] = 1.0
    for k in range(len(SHARES)):
        totals[k] += log(products[k])
    best = totals[0]
    for k in range(1, len(SHARES)):
        best = max(best, totals[k])
    mean = 0.0
    for k in range(len(SHARES)):
        mean += exp(totals[k] - best) / len(SHARES)
    likeliest = min(1.0 / (math.sqrt(2.0 * math.pi) * scatter * least_density), 1.0)
    zero_points = math.sqrt(2.0 * math.pi) * scatter / ZERO_POINT_RANGE
    return float(best + log(mean)), field_px * likeliest * zero_points


@inner
def _noise(numbers: Array, freedom: int, has_known_errors: bool) -> tuple[float, float]:
    """Variance of unit weight for the bound, and the log of the factor for averaging over it.

    If the caller gave errors, the prior of the variance is the scaled inverse χ² with `PRIOR_FREEDOM` degrees
    of freedom about 1; otherwise the logarithm of the noise is uniform from `MIN_NOISE` to `MAX_NOISE`. The
    average is by Laplace's method, or by a bound on the integral if the estimate lies below the range.
    """
    variance = numbers[VARIANCE]
    if has_known_errors:
        variance = (PRIOR_FREEDOM + variance * freedom) / (PRIOR_FREEDOM + freedom)
        density = -0.5 * PRIOR_FREEDOM * (log(variance) + 1.0 / variance - 1.0)
        return variance, density + 0.5 * log(PRIOR_FREEDOM / (PRIOR_FREEDOM + freedom))
    width = math.sqrt(math.pi / freedom)
    if variance < MIN_NOISE * MIN_NOISE:
        variance, width = MIN_NOISE * MIN_NOISE, 1.0 / freedom
    return variance, min(log(width / log(MAX_NOISE / MIN_NOISE)), 0.0)


@inner
def log_false_probability(
    index: IndexArrays,
    detections: Table,
    rotation: Array,
    stars: Indices,
    matched: int,
    normal: Array,
    numbers: Array,
    settings: Settings,
    prior: tuple[float, float],
) -> float:
    """Log of the bound on the probability that an agreement is chance; see the module.

    Parameters
    ----------
    detections : Table
        Detections for the refined attitude (rescaled if the focal length was free).
    rotation, stars, matched, normal, numbers
        From `starid.identification.geometric.refinement.refine`.
    prior : (float, float)
        Prior volume of rotations, rad³, and solid angle for one star, sr: `WHOLE_SKY` when lost in space.
    """
    spread = settings.scale_tolerance
    freedom = 2 * matched - (4 if spread > 0.0 else 3)
    determinant = (
        normal[0, 0] * (normal[1, 1] * normal[2, 2] - normal[1, 2] * normal[2, 1])
        - normal[0, 1] * (normal[1, 0] * normal[2, 2] - normal[1, 2] * normal[2, 0])
        + normal[0, 2] * (normal[1, 0] * normal[2, 1] - normal[1, 1] * normal[2, 0])
    )
    if freedom <= 0 or not (determinant > 0.0 and numbers[VARIANCE] > 0.0):
        return 0.0
    variance, noise_factor = _noise(numbers, freedom, settings.sigmas_known != 0)
    log_factor, lone = _log_detections(
        index, detections, rotation, stars, numbers, math.sqrt(variance), settings.field_px
    )
    log_factor += noise_factor
    half_volume = 1.5 * log(2.0 * math.pi * variance) - 0.5 * log(determinant)
    log_factor += min(half_volume - log(prior[0]), 0.0)
    log_factor -= log(max(lone / (prior[1] * square(settings.px_per_rad)), 1.0))
    scatter = max(numbers[SCATTER], SCATTER_FLOOR)
    log_factor += min(log(math.sqrt(2.0 * math.pi / matched) * scatter / ZERO_POINT_RANGE), 0.0)
    if spread > 0.0:
        error = math.sqrt(variance * numbers[SCALE_VARIANCE])
        log_factor += min(log(math.sqrt(2.0 * math.pi) * error / (2.0 * spread)), 0.0)
    return min(-log_factor, 0.0)
