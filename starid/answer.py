"""Kernels that end an identification: search or track, then covariance, quaternion and lists of pairs."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from starid.jit import compiled
from starid.pattern_index import IndexArrays
from starid.refinement import solve_symmetric
from starid.search import SCALE_TOLERANCE, SIGMAS_KNOWN, Outcome, search
from starid.tracking import track_near

PRIOR_FREEDOM: Final = 10.0
"""Weight of the errors that the caller gives, in degrees of freedom, against what the residuals say."""


class Answer(NamedTuple):
    """What a kernel hands back to Python.

    Attributes
    ----------
    status : int
        As in `starid.search.Outcome`.
    quaternion : ndarray (4,)
        Scalar-last, ICRS→sensor, scalar ≥ 0.
    covariance : ndarray (3, 3)
        rad², sensor frame.
    detections, stars : ndarray (m,) int64
        Matched rows of the detections, and of the index's stars.
    numbers : ndarray (6,)
        rms (px), noise (px), logarithm of the bound on a false answer, scale, triangles, candidates.
    """

    status: int
    quaternion: NDArray[np.float64]
    covariance: NDArray[np.float64]
    detections: NDArray[np.int64]
    stars: NDArray[np.int64]
    numbers: NDArray[np.float64]


@compiled
def quaternion_of(m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Scalar-last quaternion, scalar ≥ 0, of a rotation matrix, from its largest component (Shepperd 1978)."""
    q = np.empty(4)
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
    return q / norm


@compiled
def finish(outcome: Outcome, sigmas: NDArray[np.float64], sigmas_known: bool, unknowns: int) -> Answer:
    """Turn an outcome into an answer.

    The covariance is the inverse normal matrix times the variance of unit weight. That is estimated from the
    residuals with ν degrees of freedom and multiplied by ν/(ν − 2), which makes it the covariance of the
    (Student) posterior; errors given by the caller count as further degrees of freedom.
    """
    refined = outcome.refined
    m = refined.matched
    detections = np.empty(m, dtype=np.int64)
    stars = np.empty(m, dtype=np.int64)
    covariance = np.full((3, 3), math.nan)
    numbers = np.array(
        [
            refined.rms_px, math.nan, outcome.log_chance, refined.scale, float(outcome.triangles),
            float(outcome.candidates),
        ]
    )  # fmt: skip
    if m == 0:
        return Answer(outcome.status, np.full(4, math.nan), covariance, detections, stars, numbers)
    filled = 0
    mean_sigma2 = 0.0
    for i in range(refined.stars.shape[0]):
        if refined.stars[i] >= 0:
            row = outcome.source[i]
            detections[filled] = row
            stars[filled] = refined.stars[i]
            mean_sigma2 += sigmas[row] * sigmas[row] / m
            filled += 1
    freedom = float(max(2 * m - unknowns, 1))
    variance = refined.variance
    if sigmas_known:
        variance = (PRIOR_FREEDOM + variance * freedom) / (PRIOR_FREEDOM + freedom)
        freedom += PRIOR_FREEDOM
    numbers[1] = math.sqrt(variance * mean_sigma2)
    if freedom > 2.0:
        variance *= freedom / (freedom - 2.0)
    for axis in range(3):
        unit = np.zeros(3)
        unit[axis] = variance
        column, _ = solve_symmetric(refined.normal, unit, 3)
        covariance[:, axis] = column
    return Answer(outcome.status, quaternion_of(refined.rotation), covariance, detections, stars, numbers)


@compiled
def identify_kernel(
    index: IndexArrays,
    params: NDArray[np.float64],
    xy: NDArray[np.float64],
    flux: NDArray[np.float64],
    sigmas: NDArray[np.float64],
    settings: NDArray[np.float64],
) -> Answer:
    """Lost in space, whole: see `starid.search.search` and `finish`."""
    outcome = search(index, params, xy, flux, sigmas, settings)
    return finish(outcome, sigmas, settings[SIGMAS_KNOWN] > 0.0, 4 if settings[SCALE_TOLERANCE] > 0.0 else 3)


@compiled
def track_kernel(
    index: IndexArrays,
    params: NDArray[np.float64],
    xy: NDArray[np.float64],
    flux: NDArray[np.float64],
    sigmas: NDArray[np.float64],
    settings: NDArray[np.float64],
    predicted: NDArray[np.float64],
    window_rad: float,
) -> Answer:
    """Tracking, whole: see `starid.tracking.track_near` and `finish`."""
    outcome = track_near(index, params, xy, flux, sigmas, settings, predicted, window_rad)
    return finish(outcome, sigmas, settings[SIGMAS_KNOWN] > 0.0, 3)
