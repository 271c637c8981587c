"""Camera motion between two frames, fitted to the matched stars by maximum likelihood (MLESAC).

The thesis fits an affine transformation, which has six degrees of freedom. The motion of a camera has three,
so the default is a rigid transformation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from starid.arithmetic.arrays import Array, Indices, Mask
from starid.arithmetic.elementary import atan2, exp, hypot, log, square
from starid.arithmetic.matrices import product
from starid.identification.thesis.false_stars import FilterError, ObservedFrame
from starid.kernels.jit import compiled, inner_checked

MotionModel = Literal["rigid", "affine"]

MAX_TRIALS: Final = 300
"""Largest number of hypotheses: random pairs (affine: triples) of stars, or all pairs if there are fewer."""

LIKELY_FLOOR_DEG: Final = 1e-3
"""Smallest standard deviation of a star's displacement assumed in the likelihood, degrees."""

_EM_ROUNDS: Final = 3
_SEED: Final = 20_221_017
_OUTLIER_SPAN_DEG: Final = 42.0
_AFFINE_SAMPLE: Final = 3
_COLLINEARITY: Final = 1e-12


@dataclass(frozen=True, eq=False)
class CameraMotion:
    """Motion of the stars from the earlier frame to the later one.

    Attributes
    ----------
    matrix
        Transformation matrix H, (3, 3), of homogeneous positions in degrees: c' = H·c, eq. 3.2.
    rotation_deg
        Rotation angle γ̃ (eq. 3.12), degrees; for an affine transformation, of the nearest rotation matrix.
    translation_deg
        Translation ρ̃, (2,), degrees.
    mean_distance_deg
        Mean distance μ_d of the transformed stars from the stars, eq. 6.3, degrees.
    sigma_distance_deg
        Standard deviation σ_d of these distances, degrees; eq. 6.4 is printed for the variance.
    inliers
        The matches that the motion explains, (m,).
    """

    matrix: Array
    rotation_deg: float
    translation_deg: Array
    mean_distance_deg: float
    sigma_distance_deg: float
    inliers: Mask

    def apply(self, positions: Array) -> Array:
        """Transform positions (n, 2) in the earlier frame to positions in the later one."""
        return np.asarray(product(positions, self.matrix[:2, :2].T) + self.matrix[:2, 2], dtype=np.float64)


@inner_checked
def _mean_positions(before: Array, now: Array, sample: Mask, centre: Array) -> int:
    """Fill in the mean positions (x, y before; x, y now) of the chosen stars; return their number."""
    count = 0
    for i in range(sample.size):
        if sample[i]:
            count += 1
            centre[0] += before[i, 0]
            centre[1] += before[i, 1]
            centre[2] += now[i, 0]
            centre[3] += now[i, 1]
    if count > 0:
        centre /= count
    return count


@compiled
def rigid_fit(before: Array, now: Array, sample: Mask, motion: Array) -> bool:
    """Fit a rigid motion (cos, sin, x, y) to the chosen stars; False if there are fewer than two."""
    centre = np.zeros(4)
    if _mean_positions(before, now, sample, centre) < 2:
        return False
    along = 0.0
    across = 0.0
    for i in range(sample.size):
        if sample[i]:
            x = before[i, 0] - centre[0]
            y = before[i, 1] - centre[1]
            u = now[i, 0] - centre[2]
            v = now[i, 1] - centre[3]
            along += x * u + y * v
            across += x * v - y * u
    length = hypot(along, across)
    if length <= 0.0:
        return False
    c, s = along / length, across / length
    motion[0] = c
    motion[1] = s
    motion[2] = centre[2] - c * centre[0] + s * centre[1]
    motion[3] = centre[3] - s * centre[0] - c * centre[1]
    return True


@inner_checked
def affine_fit(before: Array, now: Array, sample: Mask, matrix: Array) -> bool:
    """Fit an affine transformation, `matrix` (2, 3), to the chosen stars; False if too few or collinear."""
    centre = np.zeros(4)
    if _mean_positions(before, now, sample, centre) < _AFFINE_SAMPLE:
        return False
    xx = xy = yy = xu = yu = xv = yv = 0.0
    for i in range(sample.size):
        if sample[i]:
            x = before[i, 0] - centre[0]
            y = before[i, 1] - centre[1]
            u = now[i, 0] - centre[2]
            v = now[i, 1] - centre[3]
            xx += x * x
            xy += x * y
            yy += y * y
            xu += x * u
            yu += y * u
            xv += x * v
            yv += y * v
    determinant = xx * yy - xy * xy
    if determinant <= _COLLINEARITY * square(xx + yy):
        return False
    matrix[0, 0] = (xu * yy - yu * xy) / determinant
    matrix[0, 1] = (yu * xx - xu * xy) / determinant
    matrix[1, 0] = (xv * yy - yv * xy) / determinant
    matrix[1, 1] = (yv * xx - xv * xy) / determinant
    for row in range(2):
        matrix[row, 2] = centre[2 + row] - matrix[row, 0] * centre[0] - matrix[row, 1] * centre[1]
    return True


@inner_checked
def fit(before: Array, now: Array, sample: Mask, affine: bool, matrix: Array) -> bool:
    """Fit a rigid or affine transformation, `matrix` (2, 3), to the chosen stars; False if too few."""
    if affine:
        return affine_fit(before, now, sample, matrix)
    motion = np.empty(4)
    if not rigid_fit(before, now, sample, motion):
        return False
    matrix[0, 0] = motion[0]
    matrix[0, 1] = -motion[1]
    matrix[1, 0] = motion[1]
    matrix[1, 1] = motion[0]
    matrix[0, 2] = motion[2]
    matrix[1, 2] = motion[3]
    return True


@compiled
def transform_distances(before: Array, now: Array, matrix: Array, distances: Array) -> None:
    """Fill in the distance of each transformed star from its observed position."""
    for i in range(distances.size):
        x = matrix[0, 0] * before[i, 0] + matrix[0, 1] * before[i, 1] + matrix[0, 2] - now[i, 0]
        y = matrix[1, 0] * before[i, 0] + matrix[1, 1] * before[i, 1] + matrix[1, 2] - now[i, 1]
        distances[i] = math.sqrt(x * x + y * y)


@inner_checked
def _negative_log_likelihood(distances: Array, sigma: float) -> float:
    """Cost of a hypothesis: a mixture of normal and uniform errors, its share found by EM.

    It replaces the sum of distances below η of eq. 3.11, which MLESAC in its simplest form minimises.
    """
    share = 0.5
    wide = 1.0 / (_OUTLIER_SPAN_DEG * _OUTLIER_SPAN_DEG)
    cost = 0.0
    for _ in range(_EM_ROUNDS):
        members = 0.0
        cost = 0.0
        for i in range(distances.size):
            near = share * exp(-0.5 * square(distances[i] / sigma)) / (2.0 * math.pi * sigma * sigma)
            far = (1.0 - share) * wide
            members += near / (near + far)
            cost -= log(near + far)
        share = min(max(members / distances.size, 0.01), 0.99)
    return cost


@inner_checked
def _draw(stars: int, affine: bool, every: bool, trial: int, state: int, sample: Mask) -> int:
    """Choose the stars of a hypothesis, in order or at random; return the state of the generator."""
    sample[:] = False
    if every:
        first = 0
        left = trial
        while left >= stars - 1 - first:
            left -= stars - 1 - first
            first += 1
        sample[first] = True
        sample[first + 1 + left] = True
        return state
    wanted = _AFFINE_SAMPLE if affine else 2
    count = 0
    while count < wanted:
        state = (state * 1103515245 + 12345) & 0x7FFFFFFF
        pick = (state >> 8) % stars
        if not sample[pick]:
            sample[pick] = True
            count += 1
    return state


@compiled
def mlesac(
    before: Array,
    now: Array,
    threshold: float,
    trials: int,
    seed: int,
    affine: bool,
    matrix: Array,
    inliers: Mask,
) -> bool:
    """Find the most likely transformation and refit it to its inliers; False if there is none.

    Parameters
    ----------
    before, now
        Matched positions, (m, 2), degrees.
    threshold
        Distance η up to which a star is an inlier, degrees.
    trials
        Largest number of hypotheses; all pairs are tried if there are fewer.
    seed
        Seed of the random choices.
    affine
        Fit an affine transformation (at least three stars) instead of a rigid one (at least two).
    matrix, inliers
        Output: transformation (2, 3), and mask of inliers (m,).
    """
    m = before.shape[0]
    if m < (_AFFINE_SAMPLE if affine else 2):
        return False
    pairs = m * (m - 1) // 2
    every = not affine and pairs <= trials
    state = seed & 0x7FFFFFFF
    trial = np.empty((2, 3))
    sample = np.zeros(m, dtype=np.bool_)
    distances = np.empty(m)
    sigma = max(threshold / 3.0, LIKELY_FLOOR_DEG)
    best = math.inf
    for number in range(pairs if every else trials):
        state = _draw(m, affine, every, number, state, sample)
        if not fit(before, now, sample, affine, trial):
            continue
        transform_distances(before, now, trial, distances)
        cost = _negative_log_likelihood(distances, sigma)
        if cost < best:
            best = cost
            matrix[:] = trial
    if best == math.inf:
        return False
    for _ in range(_EM_ROUNDS):
        transform_distances(before, now, matrix, distances)
        for i in range(m):
            inliers[i] = distances[i] <= threshold
        if not fit(before, now, inliers, affine, trial):
            break
        matrix[:] = trial
    transform_distances(before, now, matrix, distances)
    for i in range(m):
        inliers[i] = distances[i] <= threshold
    return True


def estimate_motion(
    before: Array,
    now: Array,
    *,
    threshold_deg: float = 1.0,
    model: MotionModel = "rigid",
) -> CameraMotion:
    """Estimate the camera motion from matched stars (line 5 of algorithm 2).

    Parameters
    ----------
    before, now
        Positions of the same stars in the earlier and in the later frame, (m, 2), degrees.
    threshold_deg
        Distance η beyond which a match is an outlier.
    model
        "rigid": rotation and translation. "affine": any 2×2 matrix and translation, as in the thesis.

    Raises
    ------
    FilterError
        There are fewer than two matches (affine: three), or all coincide (affine: are collinear).
    """
    if model not in ("rigid", "affine"):
        raise FilterError(f"motion: model must be rigid or affine, not {model!r}")
    first = np.ascontiguousarray(before, dtype=np.float64)
    second = np.ascontiguousarray(now, dtype=np.float64)
    matrix = np.empty((2, 3))
    inliers = np.zeros(first.shape[0], dtype=np.bool_)
    if (
        first.shape != second.shape
        or first.ndim != 2
        or not mlesac(first, second, threshold_deg, MAX_TRIALS, _SEED, model == "affine", matrix, inliers)
    ):
        needed = "three in a triangle" if model == "affine" else "two in different places"
        raise FilterError(f"motion: {first.shape[0]} matched stars; at least {needed} are needed")
    distances = np.empty(first.shape[0])
    transform_distances(first, second, matrix, distances)
    kept = distances[inliers] if inliers.any() else distances
    return CameraMotion(
        np.vstack([matrix, [0.0, 0.0, 1.0]]),
        math.degrees(atan2(matrix[1, 0] - matrix[0, 1], matrix[0, 0] + matrix[1, 1])),
        matrix[:, 2].copy(),
        float(kept.mean()),
        float(kept.std(ddof=1)) if kept.size > 1 else 0.0,
        inliers,
    )


def matched_motion(
    before: ObservedFrame,
    now: ObservedFrame,
    matches: Indices,
    *,
    threshold_deg: float = 1.0,
    model: MotionModel = "rigid",
) -> CameraMotion | None:
    """Estimate the camera motion from the matches (m, 2) of two frames; None if there are too few."""
    first, second = before.positions[matches[:, 0]], now.positions[matches[:, 1]]
    try:
        return estimate_motion(first, second, threshold_deg=threshold_deg, model=model)
    except FilterError:
        return None
