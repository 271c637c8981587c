"""Tracking: the attitude near a predicted one.

Bright detections are paired with the catalogue stars within a window around their predicted directions. Two
such pairs of equal separation determine an attitude, which goes through the same sequential test, refinement
and verification as in the lost-in-space search. An attitude that differs from the prediction by any rotation
within the window, roll included, is found; others are excluded.

Three matched stars can be enough, or two if position errors are known: the bound on the probability of a
false answer decides. An answer with fewer than `MIN_MATCHED` matches is compared with all others near the
prediction. Its bound is then relative to the best one that has fewer than two matches in common with it.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from starid.arithmetic.arrays import Array, Indices, Records
from starid.camera.parameter_array import MODEL
from starid.identification.geometric.answer import (
    MIN_MATCHED,
    Answer,
    Candidate,
    make_answer,
    new_candidate,
    test_and_refine,
)
from starid.identification.geometric.matching import to_sky
from starid.identification.geometric.observation import MAGNITUDE, Raw, Table, observe, without_aberration
from starid.identification.geometric.pattern_index import (
    DEEP_SHORTEST,
    GRID_CELLS,
    GRID_MARGIN,
    STAR_MAGNITUDE,
    IndexArrays,
    chord,
)
from starid.identification.geometric.refinement import SCALE, ZERO_POINT
from starid.identification.geometric.search import set_rotation, set_sensor_triad
from starid.identification.geometric.settings import ACCEPTED, NOTHING, TOO_FEW, Settings
from starid.identification.geometric.sky_grid import cell_of
from starid.identification.geometric.verification import hit_odds, test_order
from starid.kernels.jit import compiled_ieee, inlined, inner

PAIRED_DETECTIONS: Final = 16
"""Number of detections, brightest first, that form pairs."""

CANDIDATES: Final = 6
"""Number of catalogue stars considered for each of them, the brightest in its window."""

MIN_TRACKED: Final = 3
"""Least number of matches near a prediction: one residual is left with two, too few to estimate the noise."""

MIN_TRACKED_KNOWN: Final = 2
"""The same if position errors are known."""


@inner
def _stars_near(
    index: IndexArrays, x: float, y: float, z: float, window_rad: float, near_stars: Indices, row: int
) -> int:
    """Fill a row with the brightest stars within a window around a direction; return their number."""
    stars = index.stars
    first, last, listed = 0, stars.shape[0], False
    if window_rad <= index.numbers[GRID_MARGIN]:
        cell = cell_of(x, y, z, int(index.numbers[GRID_CELLS]))
        first, last, listed = (
            int(np.int64(index.grid_start[cell])),
            int(np.int64(index.grid_start[cell + 1])),
            True,
        )
    count = 0
    for entry in range(first, last):
        star = int(np.int64(index.grid_stars[entry])) if listed else entry
        dx, dy, dz = stars[star, 0] - x, stars[star, 1] - y, stars[star, 2] - z
        if dx * dx + dy * dy + dz * dz < window_rad * window_rad:
            near_stars[row, count] = star
            count += 1
            if count == near_stars.shape[1]:
                break
    return count


@inner
def _keep_better(candidate: Candidate, bound: float, best: Candidate, bounds: Array) -> None:
    """Keep a candidate in `best` if its bound is lower; ``bounds`` belong to `best` and to its best rival."""
    shared = 0
    for i in range(candidate.stars.shape[0]):
        shared += 1 if candidate.stars[i] >= 0 and candidate.stars[i] == best.stars[i] else 0
    if bound >= bounds[0]:
        if shared < 2:
            bounds[1] = min(bounds[1], bound)
        return
    if shared < 2:
        bounds[1] = bounds[0]
    bounds[0] = bound
    # loops: an assignment of whole arrays would compile the text of its error message too
    for i in range(candidate.frames.size):
        best.frames.flat[i] = candidate.frames.flat[i]
    for i in range(candidate.stars.size):
        best.stars[i] = candidate.stars[i]
    for i in range(candidate.normal.size):
        best.normal.flat[i] = candidate.normal.flat[i]
    for i in range(candidate.numbers.size):
        best.numbers[i] = candidate.numbers[i]


@inlined
def _try_pair(
    index: IndexArrays,
    raw: Raw,
    observed: Table,
    settings: Settings,
    candidate: Candidate,
    tests: tuple[Array, Indices],
    detections: tuple[int, int],
    stars: tuple[int, int],
    min_matched: int,
    prior: tuple[float, float],
) -> tuple[int, float]:
    """Try the attitude of two pairs, left in `candidate`; return its matches (0 if rejected) and bound."""
    i, j = detections
    a, b = stars
    da = index.stars[a, STAR_MAGNITUDE] - observed[i, MAGNITUDE]
    db = index.stars[b, STAR_MAGNITUDE] - observed[j, MAGNITUDE]
    if abs(da - db) > 2.0 * settings.magnitude_gate:
        return 0, 0.0
    candidate.numbers[ZERO_POINT], candidate.numbers[SCALE] = 0.5 * (da + db), 1.0
    set_sensor_triad(observed, (i, i, j), raw.params[MODEL], 1.0, candidate.frames)
    set_rotation(index.stars, (a, a, b), candidate.frames)
    return test_and_refine(index, raw, observed, settings, candidate, tests, (i, j, j), min_matched, prior)


@inlined
def _try_detections(
    index: IndexArrays,
    raw: Raw,
    observed: Table,
    settings: Settings,
    candidate: Candidate,
    tests: tuple[Array, Indices],
    detections: tuple[int, int],
    near: Indices,
    counts: Indices,
    min_matched: int,
    prior: tuple[float, float],
    best: Candidate,
    bounds: Array,
    work: Indices,
) -> float:
    """Try all pairs of stars near two detections; return the bound of the first accepted outright, or 0.

    Other candidates are compared through `best` and ``bounds`` (`_keep_better`). `work` counts pairs.
    """
    i, j = detections
    separation = chord(observed, i, j)
    if separation < index.numbers[DEEP_SHORTEST]:
        return 0.0
    for p in range(counts[i]):
        for q in range(counts[j]):
            a, b = near[i, p], near[j, q]
            work[0] += 1
            if a == b or abs(chord(index.stars, a, b) - separation) > settings.search_tolerance:
                continue
            work[1] += 1
            matched, bound = _try_pair(
                index, raw, observed, settings, candidate, tests, detections, (a, b), min_matched, prior
            )
            if matched >= MIN_MATCHED and bound < settings.log_chance_tracking:
                return bound
            if matched > 0 and bound < 0.0:
                _keep_better(candidate, bound, best, bounds)
    return 0.0


@compiled_ieee
def track_kernel(
    index: IndexArrays,
    params: Array,
    xy: Array,
    flux: Array,
    sigmas: Array,
    records: Records,
    predicted: Array,
    window_rad: float,
    min_matched: int,
    prior: tuple[float, float],
) -> Answer:
    """Find the attitude near a predicted one.

    Parameters
    ----------
    records : ndarray (1,) of SETTINGS
    predicted : ndarray (3, 3)
        ICRS→sensor.
    window_rad : float
        Largest angle between a star and its predicted direction.
    min_matched : int
        Least number of matches for an answer.
    prior : (float, float)
        See `starid.identification.geometric.verification.log_false_probability`.
    """
    raw = Raw(params, xy, flux, sigmas)
    settings: Settings = records[0]
    observed = observe(raw)
    n = observed.shape[0]
    candidate, best, bounds = new_candidate(n), new_candidate(n), np.zeros(2)
    best.stars[:] = -1
    tests = (hit_odds(index, settings.test_window), test_order(n))
    near = np.empty((PAIRED_DETECTIONS, CANDIDATES), dtype=np.int64)
    counts = np.zeros(PAIRED_DETECTIONS, dtype=np.int64)
    status, bound, work = TOO_FEW if n < min_matched else NOTHING, 0.0, np.zeros(2, dtype=np.int64)
    for j in range(min(n, PAIRED_DETECTIONS) if status == NOTHING else 0):
        x, y, z = without_aberration(
            *to_sky(predicted, observed, j), settings.beta_x, settings.beta_y, settings.beta_z
        )
        counts[j] = _stars_near(index, x, y, z, window_rad, near, j)
        for i in range(j):
            bound = _try_detections(
                index, raw, observed, settings, candidate, tests, (i, j), near, counts,
                min_matched, prior, best, bounds, work,
            )  # fmt: skip
            if bound < 0.0:
                status = ACCEPTED
                break
        if status == ACCEPTED:
            return make_answer(status, observed, candidate, settings, bound, work[0], work[1])
    bound = bounds[0] - bounds[1]
    if bound < settings.log_chance_tracking:
        status = ACCEPTED
    return make_answer(status, observed, best, settings, bound, work[0], work[1])
