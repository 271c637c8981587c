"""How much an agreement between detections and catalogue is worth: chance, stated and tested.

Two stages. `worth_refining` tests a candidate attitude star by star, brightest first, by Wald's sequential
probability ratio: wrong candidates die after a handful of look-ups. `log_chance` bounds the probability
that chance alone gives so many matches: each of n detections meets a catalogue star within the window with
probability p (star density × window), so their number is binomial, and its tail is bounded by Chernoff's
``exp(−n·KL(k/n ‖ p))``.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from starid.jit import compiled
from starid.observation import Observations
from starid.pattern_index import GRID_CELLS, IndexArrays, magnitude_bin
from starid.sky_grid import cell_of

TRUE_SHARE: Final = 0.4
"""Least share of the detections that are catalogue stars, for the sequential test."""

REJECT_BELOW: Final = -2.6
"""Logarithmic odds at which a candidate is dropped: five misses in a row."""

ACCEPT_ABOVE: Final = 9.0
"""Logarithmic odds at which the sequential test passes a candidate on."""

MAX_TESTED: Final = 40
"""Detections tested at most."""


@compiled
def to_sky(rotation: NDArray[np.float64], direction: NDArray[np.float64]) -> tuple[float, float, float]:
    """Direction of the sensor frame expressed in ICRS, by the ICRS→sensor matrix."""
    x, y, z = direction[0], direction[1], direction[2]
    return (
        rotation[0, 0] * x + rotation[1, 0] * y + rotation[2, 0] * z,
        rotation[0, 1] * x + rotation[1, 1] * y + rotation[2, 1] * z,
        rotation[0, 2] * x + rotation[1, 2] * y + rotation[2, 2] * z,
    )


@compiled
def hit_odds(index: IndexArrays, window_rad: float) -> NDArray[np.float64]:
    """Logarithm of the odds that a hit gives, for each magnitude limit of the look-up (bins)."""
    totals = index.counts[-1]
    odds = np.empty(totals.shape[0])
    for b in range(totals.shape[0]):
        chance = min(0.25 * totals[b] * window_rad * window_rad + 1e-9, 0.9)
        odds[b] = math.log(TRUE_SHARE / chance + 1.0 - TRUE_SHARE)
    return odds


@compiled
def worth_refining(
    index: IndexArrays,
    observations: Observations,
    rotation: NDArray[np.float64],
    scale: float,
    faintest_offset: float,
    window_rad: float,
    odds: NDArray[np.float64],
    used: tuple[int, int, int],
) -> bool:
    """Sequential test of a candidate attitude on the brightest detections outside its pattern.

    Parameters
    ----------
    scale : float
        Factor on the tangents of the directions (1 where the focal length is known).
    faintest_offset : float
        Catalogue minus instrumental magnitude that a true star can have at most.
    odds : ndarray
        From `hit_odds`.
    used : (int, int, int)
        Detections of the pattern.
    """
    n = int(index.numbers[GRID_CELLS])
    limit2 = window_rad * window_rad
    miss = math.log(1.0 - TRUE_SHARE)
    total = 0.0
    hits = 0
    direction = np.empty(3)
    for i in range(min(observations.directions.shape[0], MAX_TESTED)):
        if i == used[0] or i == used[1] or i == used[2]:
            continue
        direction[0] = observations.directions[i, 0] * scale
        direction[1] = observations.directions[i, 1] * scale
        direction[2] = observations.directions[i, 2]
        if scale != 1.0:
            direction /= math.sqrt(direction[0] ** 2 + direction[1] ** 2 + direction[2] ** 2)
        x, y, z = to_sky(rotation, direction)
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
def log_chance(matched: int, tested: int, chance: float) -> float:
    """Logarithm of Chernoff's bound on P(at least `matched` of `tested`), each with the chance given."""
    if tested <= 0 or matched <= 0:
        return 0.0
    share = matched / tested
    if share <= chance:
        return 0.0
    divergence = share * math.log(share / chance)
    if share < 1.0:
        divergence += (1.0 - share) * math.log((1.0 - share) / (1.0 - chance))
    return -tested * divergence
