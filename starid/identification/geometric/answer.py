"""Testing, refinement and verification of a candidate attitude; the answer of the kernels."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np

from starid.arithmetic.arrays import Array, Indices
from starid.arithmetic.elementary import log, square
from starid.identification.geometric.observation import SIGMA_U, SIGMA_V, SOURCE, Raw, Table
from starid.identification.geometric.pattern_index import IndexArrays
from starid.identification.geometric.refinement import (
    NUMBERS,
    PRIOR_FREEDOM,
    RMS,
    SCALE,
    VARIANCE,
    ZERO_POINT,
    directions_depend_on_solution,
    refine,
    solve_symmetric,
)
from starid.identification.geometric.settings import NOTHING, Settings
from starid.identification.geometric.verification import log_false_probability, worth_refining
from starid.kernels.jit import inlined, inner

MIN_MATCHED: Final = 4
"""Least number of matches for an answer without a predicted attitude."""

MIN_TESTED: Final = 4
"""Number of detections outside the pattern from which the sequential test can reject."""


class Answer(NamedTuple):
    """Result of a kernel.

    Attributes
    ----------
    status : int
        As in `starid.identification.geometric.settings`.
    quaternion : ndarray (4,)
        Scalar-last, ICRS→sensor, scalar ≥ 0.
    covariance : ndarray (3, 3)
        rad², sensor frame.
    pairs : ndarray (2, m) int64
        Matched rows: detections, and stars of the index.
    numbers : ndarray (6,)
        RMS (px), noise (px), log of the bound on the false-answer probability, scale, triangles, candidates.
    """

    status: int
    quaternion: Array
    covariance: Array
    pairs: Indices
    numbers: Array


class Candidate(NamedTuple):
    """Workspace of a candidate attitude; see `starid.identification.geometric.refinement.refine`.

    Attributes
    ----------
    frames : ndarray (3, 3, 3)
        Axes of the pattern in the sensor and in the sky, and the rotation between them.
    stars : ndarray (n,) int64
    normal : ndarray (4, 4)
    numbers : ndarray (`NUMBERS`,)
    """

    frames: Array
    stars: Indices
    normal: Array
    numbers: Array


@inner
def new_candidate(count: int) -> Candidate:
    """Allocate a workspace for a number of detections."""
    stars = np.empty(count, dtype=np.int64)
    return Candidate(np.empty((3, 3, 3)), stars, np.empty((4, 4)), np.empty(NUMBERS))


@inlined
def test_and_refine(
    index: IndexArrays,
    raw: Raw,
    observed: Table,
    settings: Settings,
    candidate: Candidate,
    tests: tuple[Array, Indices],
    used: tuple[int, int, int],
    min_matched: int,
    prior: tuple[float, float],
) -> tuple[int, float]:
    """Test, refine and verify the attitude in ``candidate.frames[2]``.

    Parameters
    ----------
    candidate : Candidate
        Its rotation, scale and zero point must be set.
    tests : (odds, order)
        From `starid.identification.geometric.verification.hit_odds` and `test_order`.
    used : (int, int, int)
        Detections from which the attitude was derived.
    min_matched : int
        Least number of matches. Below `MIN_MATCHED`, a few detections are not tested individually.
    prior : (float, float)
        See `log_false_probability`.

    Returns
    -------
    matched : int
        Number of stars matched; 0 for a rejected candidate.
    bound : float
        Log of the bound on the probability of a false answer.
    """
    rotation, numbers = candidate.frames[2], candidate.numbers
    faintest = numbers[ZERO_POINT] + settings.magnitude_gate
    odds, order = tests
    few = min_matched < MIN_MATCHED and observed.shape[0] < min_matched + MIN_TESTED
    if not few and not worth_refining(
        index, raw.params, observed, rotation, numbers[SCALE], faintest, settings, odds, order, used
    ):
        return 0, 0.0
    detections = observed.copy() if directions_depend_on_solution(settings) else observed
    matched = refine(
        index,
        raw,
        observed,
        settings,
        min_matched,
        detections,
        rotation,
        candidate.stars,
        candidate.normal,
        numbers,
    )
    if matched == 0 or numbers[RMS] > math.sqrt(2.0) * settings.largest_sigma:
        return 0, 0.0
    if abs(log(numbers[SCALE])) > 1.5 * settings.scale_tolerance:
        return 0, 0.0
    bound = log_false_probability(
        index, detections, rotation, candidate.stars, matched, candidate.normal, numbers, settings, prior
    )
    return matched, bound


@inner
def quaternion_of(m: Array, q: Array) -> None:
    """Convert a rotation matrix to a scalar-last quaternion, scalar ≥ 0, in place (Shepperd 1978)."""
    trace = m[0, 0] + m[1, 1] + m[2, 2]
    if trace > 0.0:
        q[3] = 1.0 + trace
        q[0], q[1], q[2] = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    else:
        i = 0
        if m[1, 1] > m[0, 0]:
            i = 1
        if m[2, 2] > m[i, i]:
            i = 2
        j, k = (i + 1) % 3, (i + 2) % 3
        q[i] = 1.0 + m[i, i] - m[j, j] - m[k, k]
        q[j] = m[j, i] + m[i, j]
        q[k] = m[k, i] + m[i, k]
        q[3] = m[k, j] - m[j, k]
    norm = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    if q[3] < 0.0:
        norm = -norm
    for k in range(4):
        q[k] /= norm


@inner
def make_answer(
    status: int,
    observed: Table,
    candidate: Candidate,
    settings: Settings,
    bound: float,
    triangles: int,
    candidates: int,
) -> Answer:
    """Build the answer from an accepted candidate; it is empty for any status but `ACCEPTED`.

    The covariance is the inverse normal matrix times the variance of unit weight. This variance is estimated
    from the residuals with ν degrees of freedom and multiplied by ν/(ν − 2), which gives the covariance of
    the (Student) posterior; errors given by the caller count as additional degrees of freedom.
    """
    numbers = candidate.numbers
    quaternion, covariance = np.full(4, math.nan), np.full((3, 3), math.nan)
    facts = np.full(6, math.nan)
    facts[2], facts[4], facts[5] = bound, triangles, candidates
    if status <= NOTHING or bound == 0.0:
        return Answer(status, quaternion, covariance, np.empty((2, 0), dtype=np.int64), facts)
    m = 0
    for i in range(candidate.stars.shape[0]):
        m += 1 if candidate.stars[i] >= 0 else 0
    pairs = np.empty((2, m), dtype=np.int64)
    mean_sigma2 = 0.0
    filled = 0
    for i in range(candidate.stars.shape[0]):
        if candidate.stars[i] >= 0:
            pairs[0, filled] = np.int64(observed[i, SOURCE])
            pairs[1, filled] = candidate.stars[i]
            mean_sigma2 += 0.5 * (square(observed[i, SIGMA_U]) + square(observed[i, SIGMA_V])) / m
            filled += 1
    freedom = float(max(2 * m - (4 if settings.scale_tolerance > 0.0 else 3), 1))
    variance = numbers[VARIANCE]
    if settings.sigmas_known:
        variance = (PRIOR_FREEDOM + variance * freedom) / (PRIOR_FREEDOM + freedom)
        freedom += PRIOR_FREEDOM
    facts[0], facts[1], facts[3] = numbers[RMS], math.sqrt(variance * mean_sigma2), numbers[SCALE]
    if freedom > 2.0:
        variance *= freedom / (freedom - 2.0)
    unit, column = np.empty(4), np.empty(4)
    for axis in range(3):
        for k in range(3):
            unit[k] = variance if k == axis else 0.0
        solve_symmetric(candidate.normal, unit, covariance.shape[0], column)
        for k in range(3):
            covariance[k, axis] = column[k]
    quaternion_of(candidate.frames[2], quaternion)
    return Answer(status, quaternion, covariance, pairs, facts)
