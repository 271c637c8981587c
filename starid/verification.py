"""How much an agreement between detections and catalogue is worth: tested fast, then stated.

Two stages. `worth_refining` tests a candidate attitude star by star by Wald's sequential probability ratio:
wrong candidates die after a handful of look-ups. `log_false_probability` is the judgement.

It compares two explanations of the detections. *Chance*: each of n detections lies anywhere in the field of
area A. *Sky*: an attitude drawn uniformly from all rotations; then each detection is, with probability a, a
catalogue star of about its brightness, seen with the centroid noise, else anywhere. A detection matched to a
star at distance r with magnitude deviation Δm thus favours the sky by

    (1 − a) + a · A · w · N₂(r; σ) ,  w = N(Δm; s)/λ(m)  (at most 1),

λ(m) being the catalogue stars a magnitude in the field: the chance that it is just this one of the stars of
its brightness. Unmatched ones give 1 − a. The product is integrated over the attitude (Laplace's method:
the posterior's volume over the prior's), over the photometric zero point, over the noise where it was
estimated, and averaged over a few shares a. The result is a Bayes factor B whose expectation under chance
is 1, so that by Markov's inequality chance reaches B or more with a probability of at most 1/B, however long
the search was: 1/B is the bound that a solution states.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from starid.jit import compiled
from starid.observation import Observations
from starid.pattern_index import BINS_PER_MAGNITUDE, COUNT_CELLS, GRID_CELLS, IndexArrays, magnitude_bin
from starid.refinement import Refined, residual
from starid.sky_grid import cell_of

TRUE_SHARE: Final = 0.5
"""Share of the detections that are catalogue stars, for the sequential test."""

REJECT_BELOW: Final = -2.6
"""Logarithmic odds at which a candidate is dropped: four misses in a row."""

ACCEPT_ABOVE: Final = 9.0
"""Logarithmic odds at which the sequential test passes a candidate on."""

MAX_TESTED: Final = 40
"""Detections tested at most."""

ROTATIONS: Final = 8.0 * math.pi**2
"""Volume of all rotations, measured in rotation vectors (rad³)."""

ZERO_POINT_RANGE: Final = 10.0
"""Magnitudes over which the photometric zero point may lie."""

NOISE_RANGE: Final = math.log(5.0 / 0.05)
"""Logarithmic range of the centroid noise where it is estimated."""

SHARES: Final = (0.2, 0.5, 0.9)
"""Shares of true stars among the detections that the Bayes factor is averaged over."""

SCATTER_FLOOR: Final = 0.15
"""Least scatter of magnitudes believed in the judgement."""


@compiled
def hit_odds(index: IndexArrays, window_rad: float) -> NDArray[np.float64]:
    """Logarithm of the odds that a hit gives, for each magnitude limit of the look-up (bins)."""
    totals = index.counts[-1]
    odds = np.empty(totals.shape[0])
    for b in range(totals.shape[0]):
        chance = min(0.25 * totals[b] * window_rad * window_rad + 1e-6, 0.9)
        odds[b] = math.log(TRUE_SHARE / chance + 1.0 - TRUE_SHARE)
    return odds


@compiled
def test_order(count: int) -> NDArray[np.int64]:
    """Order in which detections are tested: the brightest, and those of the fainter half, in turn.

    The brightest are the most telling, but they are also where false stars gather.
    """
    order = np.empty(count, dtype=np.int64)
    half = (count + 1) // 2
    for i in range(half):
        order[2 * i] = i
        if 2 * i + 1 < count:
            order[2 * i + 1] = half + i
    return order


@compiled
def worth_refining(
    index: IndexArrays,
    observations: Observations,
    rotation: NDArray[np.float64],
    scale: float,
    faintest_offset: float,
    window_rad: float,
    odds: NDArray[np.float64],
    order: NDArray[np.int64],
    used: tuple[int, int, int],
) -> bool:
    """Sequential test of a candidate attitude on detections outside its pattern.

    Parameters
    ----------
    scale : float
        Factor on the tangents of the directions (1 where the focal length is known).
    faintest_offset : float
        Catalogue minus instrumental magnitude that a true star can have at most.
    odds : ndarray
        From `hit_odds`.
    order : ndarray
        From `test_order`.
    used : (int, int, int)
        Detections of the pattern.
    """
    n = int(index.numbers[GRID_CELLS])
    limit2 = window_rad * window_rad
    miss = math.log(1.0 - TRUE_SHARE)
    total = 0.0
    hits = 0
    a, b, c = rotation[0], rotation[1], rotation[2]
    for step in range(min(order.shape[0], MAX_TESTED)):
        i = order[step]
        if i == used[0] or i == used[1] or i == used[2]:
            continue
        u, v, w = (
            observations.directions[i, 0],
            observations.directions[i, 1],
            observations.directions[i, 2],
        )
        if scale != 1.0:
            u, v = u * scale, v * scale
            norm = 1.0 / math.sqrt(u * u + v * v + w * w)
            u, v, w = u * norm, v * norm, w * norm
        x = a[0] * u + b[0] * v + c[0] * w
        y = a[1] * u + b[1] * v + c[1] * w
        z = a[2] * u + b[2] * v + c[2] * w
        faintest = observations.magnitudes[i] + faintest_offset
        cell = cell_of(x, y, z, n)
        hit = False
        for entry in range(index.grid_start[cell], index.grid_start[cell + 1]):
            star = index.grid_stars[entry]
            if index.magnitudes[star] > faintest:
                break
            dx = index.vectors[star, 0] - x
            dy = index.vectors[star, 1] - y
            dz = index.vectors[star, 2] - z
            if dx * dx + dy * dy + dz * dz < limit2:
                hit = True
                break
        if hit:
            total += odds[magnitude_bin(faintest, odds.shape[0])]
            hits += 1
            if total > ACCEPT_ABOVE and hits > 1:
                return True
        else:
            total += miss
            if total < REJECT_BELOW:
                return False
    return total > 0.0 and hits > 0


@compiled
def _stars_per_magnitude(counts: NDArray[np.int32], magnitude: float) -> float:
    """Catalogue stars a magnitude in a field, smoothed over one magnitude; at least one."""
    bins = counts.shape[0]
    middle = magnitude_bin(magnitude, bins)
    low, high = middle - BINS_PER_MAGNITUDE // 2 - 1, min(middle + BINS_PER_MAGNITUDE // 2, bins - 1)
    stars = float(counts[high])
    if low >= 0:
        stars -= counts[low]
    return max(stars * BINS_PER_MAGNITUDE / (high - max(low, -1)), 1.0)


@compiled
def log_false_probability(
    index: IndexArrays,
    observations: Observations,
    refined: Refined,
    sigmas_known: bool,
    prior_volume: float,
    scale_range: float,
    field_px: float,
) -> float:
    """Logarithm of the bound on the probability that an agreement is chance; see the module.

    Parameters
    ----------
    observations : Observations
        As the refined attitude sees them (rescaled where the focal length was free).
    prior_volume : float
        Volume of the rotations that were possible beforehand, rad³: `ROTATIONS` when lost in space.
    scale_range : float
        Range of the logarithm of the scale that was possible beforehand; 0 where it was known.
    field_px : float
        Pixels in the field.
    """
    m = refined.matched
    unknowns = 4 if scale_range > 0.0 else 3
    freedom = 2 * m - unknowns
    if freedom <= 0:
        return 0.0
    boresight = refined.rotation[2]
    counts = index.counts[cell_of(boresight[0], boresight[1], boresight[2], COUNT_CELLS)]
    variance = refined.variance
    scatter = max(refined.magnitude_sigma, SCATTER_FLOOR)
    totals = np.zeros(len(SHARES))
    for i in range(refined.stars.shape[0]):
        gain = 0.0
        star = refined.stars[i]
        if star >= 0:
            rx, ry, _, _, _ = residual(index, observations, refined.rotation, i, star)
            spread2 = variance * observations.sigmas[i] * observations.sigmas[i]
            here = math.exp(-0.5 * (rx * rx + ry * ry) / spread2) / (2.0 * math.pi * spread2)
            deviation = (index.magnitudes[star] - observations.magnitudes[i] - refined.zero_point) / scatter
            brightness = math.exp(-0.5 * deviation * deviation) / (math.sqrt(2.0 * math.pi) * scatter)
            weight = min(brightness / _stars_per_magnitude(counts, index.magnitudes[star]), 1.0)
            gain = field_px * weight * here
        for k in range(len(SHARES)):
            totals[k] += math.log(1.0 - SHARES[k] + SHARES[k] * gain)
    best = totals.max()
    mean = 0.0
    for k in range(len(SHARES)):
        mean += math.exp(totals[k] - best) / len(SHARES)
    log_factor = best + math.log(mean)
    n = refined.normal
    determinant = (
        n[0, 0] * (n[1, 1] * n[2, 2] - n[1, 2] * n[2, 1])
        - n[0, 1] * (n[1, 0] * n[2, 2] - n[1, 2] * n[2, 0])
        + n[0, 2] * (n[1, 0] * n[2, 1] - n[1, 1] * n[2, 0])
    )
    if not (determinant > 0.0 and variance > 0.0):
        return 0.0
    half_volume = 1.5 * math.log(2.0 * math.pi * variance) - 0.5 * math.log(determinant)
    log_factor += min(half_volume - math.log(prior_volume), 0.0)
    log_factor += min(math.log(math.sqrt(2.0 * math.pi / m) * scatter / ZERO_POINT_RANGE), 0.0)
    if not sigmas_known:
        log_factor += min(math.log(math.sqrt(math.pi / freedom) / NOISE_RANGE), 0.0)
    if scale_range > 0.0:
        error = math.sqrt(variance * refined.scale_variance)
        log_factor += min(math.log(math.sqrt(2.0 * math.pi) * error / scale_range), 0.0)
    return min(-log_factor, 0.0)
