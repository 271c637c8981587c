"""Tracking: the attitude near a predicted one, and the tracker that keeps attitude and rate.

Bright detections are paired with the catalogue stars within a window around where the prediction puts them.
Two such pairs that keep their distance give an attitude, which goes through the same sequential test,
refinement and verification as one found lost in space. A prediction that is off by any turn within the
window, roll included, is followed; anything else is refused.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from starid.jit import compiled
from starid.observation import Observations, observe
from starid.pattern_index import GRID_CELLS, GRID_MARGIN, SHORTEST_SIDE, IndexArrays, chord
from starid.refinement import Refined, nothing_refined, refine, to_sky
from starid.search import (
    ACCEPTED,
    FIELD_PX,
    LEAST_MATCHED,
    LOG_CHANCE_TRACKING,
    MAGNITUDE_GATE,
    NOTHING,
    PX_PER_RAD,
    SEARCH_TOLERANCE,
    TEST_WINDOW,
    TOO_FEW,
    WINDOW,
    Outcome,
    frame_of,
    judged,
    rotation_between,
)
from starid.sky_grid import cell_of
from starid.verification import ROTATIONS, hit_odds, test_order, worth_refining

PAIRED: Final = 16
"""Brightest detections that pairs are made of."""

CANDIDATES: Final = 6
"""Catalogue stars considered for each of them, the brightest in its window."""


@compiled
def _stars_near(
    index: IndexArrays, x: float, y: float, z: float, window_rad: float, found: NDArray[np.int64]
) -> int:
    """Fill in the brightest stars within a window around a direction; return how many."""
    limit2 = window_rad * window_rad
    count = 0
    if window_rad <= index.numbers[GRID_MARGIN]:
        cell = cell_of(x, y, z, int(index.numbers[GRID_CELLS]))
        for entry in range(index.grid_start[cell], index.grid_start[cell + 1]):
            star = index.grid_stars[entry]
            dx, dy = index.vectors[star, 0] - x, index.vectors[star, 1] - y
            dz = index.vectors[star, 2] - z
            if dx * dx + dy * dy + dz * dz < limit2:
                found[count] = star
                count += 1
                if count == found.shape[0]:
                    break
        return count
    for star in range(index.vectors.shape[0]):
        dx, dy = index.vectors[star, 0] - x, index.vectors[star, 1] - y
        dz = index.vectors[star, 2] - z
        if dx * dx + dy * dy + dz * dz < limit2:
            found[count] = star
            count += 1
            if count == found.shape[0]:
                break
    return count


@compiled
def _try_pair(
    index: IndexArrays,
    observations: Observations,
    detections: tuple[int, int],
    stars: tuple[int, int],
    odds: NDArray[np.float64],
    order: NDArray[np.int64],
    prior_volume: float,
    settings: NDArray[np.float64],
) -> tuple[Refined, float]:
    """Refine the attitude of two pairs if it stands the tests; the bound is 0 where it does not."""
    i, j = detections
    a, b = stars
    zero_point = 0.5 * (
        index.magnitudes[a] + index.magnitudes[b] - observations.magnitudes[i] - observations.magnitudes[j]
    )
    gate = settings[MAGNITUDE_GATE]
    nothing = nothing_refined()
    if abs(index.magnitudes[a] - observations.magnitudes[i] - zero_point) > gate:
        return nothing, 0.0
    u, c = observations.directions, index.vectors
    rotation = rotation_between(frame_of(u[i], u[j], u[j]), frame_of(c[a], c[b], c[b]))
    if not worth_refining(
        index,
        observations,
        rotation,
        1.0,
        zero_point + gate,
        settings[TEST_WINDOW],
        odds,
        order,
        (i, j, j),
    ):
        return nothing, 0.0
    refined = refine(
        index, observations, rotation, 1.0, False, settings[WINDOW],
        zero_point, gate, settings[PX_PER_RAD], LEAST_MATCHED,
    )  # fmt: skip
    return refined, judged(index, observations, refined, prior_volume, settings)


@compiled
def track_near(
    index: IndexArrays,
    params: NDArray[np.float64],
    xy: NDArray[np.float64],
    flux: NDArray[np.float64],
    sigmas: NDArray[np.float64],
    settings: NDArray[np.float64],
    predicted: NDArray[np.float64],
    window_rad: float,
) -> Outcome:
    """Find the attitude near a predicted one.

    Parameters
    ----------
    predicted : ndarray (3, 3)
        ICRS→sensor.
    window_rad : float
        Largest angle of a star from where the prediction puts it.
    """
    observations = observe(params, xy, flux, sigmas)
    n = observations.directions.shape[0]
    refined = nothing_refined()
    if n < 3:
        return Outcome(TOO_FEW, refined, observations.source, 0.0, 0, 0)
    odds, order = hit_odds(index, settings[TEST_WINDOW]), test_order(n)
    # a star at the border of the field still lies within the window after a turn of window/(field's radius)
    roll = min(window_rad * settings[PX_PER_RAD] / math.sqrt(settings[FIELD_PX] / math.pi), math.pi)
    prior_volume = min(2.0 * math.pi * window_rad**2 * roll, ROTATIONS)
    paired = min(n, PAIRED)
    near = np.empty((paired, CANDIDATES), dtype=np.int64)
    counts = np.empty(paired, dtype=np.int64)
    pairs, hypotheses = 0, 0
    for j in range(paired):
        x, y, z = to_sky(predicted, observations.directions[j])
        counts[j] = _stars_near(index, x, y, z, window_rad, near[j])
        for i in range(j):
            separation = chord(observations.directions, i, j)
            if separation < index.numbers[SHORTEST_SIDE]:
                continue
            pairs += 1
            for p in range(counts[i]):
                for q in range(counts[j]):
                    a, b = near[i, p], near[j, q]
                    if a == b or abs(chord(index.vectors, a, b) - separation) > settings[SEARCH_TOLERANCE]:
                        continue
                    hypotheses += 1
                    refined, bound = _try_pair(
                        index, observations, (i, j), (a, b), odds, order, prior_volume, settings
                    )
                    if refined.matched > 0 and bound < settings[LOG_CHANCE_TRACKING]:
                        return Outcome(ACCEPTED, refined, observations.source, bound, pairs, hypotheses)
    return Outcome(NOTHING, nothing_refined(), observations.source, 0.0, pairs, hypotheses)
