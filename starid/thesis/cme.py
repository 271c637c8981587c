"""Camera motion between two frames: rotation and translation of the matched stars, by maximum likelihood (MLESAC)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from starid.jit import compiled
from starid.thesis.false_stars import FilterError

MAX_TRIALS: Final = 300
"""Most pairs of stars that hypotheses are drawn from; fewer stars are tried in all pairs."""

LIKELY_FLOOR_DEG: Final = 1e-3
"""Least standard deviation assumed of a star's displacement in the likelihood, degrees."""

_EM_ROUNDS: Final = 3
_SEED: Final = 20_221_017
_OUTLIER_SPAN_DEG: Final = 42.0


@dataclass(frozen=True, eq=False)
class CameraMotion:
    """How the stars moved from the earlier frame to the later one.

    Attributes
    ----------
    matrix
        Transformation matrix H, (3, 3), of homogeneous positions in degrees: c' = H·c, eq. 3.2.
    rotation_deg
        Rotation angle γ̃ of its rotation matrix (eq. 3.12), degrees.
    translation_deg
        Translation ρ̃, (2,), degrees.
    mean_distance_deg
        Mean distance μ_d of the transformed stars from the stars, eq. 6.3, degrees.
    sigma_distance_deg
        Standard deviation σ_d of these distances, degrees; eq. 6.4 prints the variance.
    inliers
        Which of the matches the motion explains, (m,).
    """

    matrix: NDArray[np.float64]
    rotation_deg: float
    translation_deg: NDArray[np.float64]
    mean_distance_deg: float
    sigma_distance_deg: float
    inliers: NDArray[np.bool_]

    def apply(self, positions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Where objects at these positions of the earlier frame are in the later one, (n, 2)."""
        return np.asarray(positions @ self.matrix[:2, :2].T + self.matrix[:2, 2], dtype=np.float64)


@compiled
def rigid_fit(
    before: NDArray[np.float64],
    now: NDArray[np.float64],
    chosen: NDArray[np.bool_],
    motion: NDArray[np.float64],
) -> bool:
    """Least-squares rotation and translation of the chosen stars into `motion` (cos, sin, x, y); False below two."""
    count = 0
    centre = np.zeros(4)
    for i in range(chosen.size):
        if chosen[i]:
            count += 1
            centre[0] += before[i, 0]
            centre[1] += before[i, 1]
            centre[2] += now[i, 0]
            centre[3] += now[i, 1]
    if count < 2:
        return False
    centre /= count
    along = 0.0
    across = 0.0
    for i in range(chosen.size):
        if chosen[i]:
            x = before[i, 0] - centre[0]
            y = before[i, 1] - centre[1]
            u = now[i, 0] - centre[2]
            v = now[i, 1] - centre[3]
            along += x * u + y * v
            across += x * v - y * u
    length = math.hypot(along, across)
    if length <= 0.0:
        return False
    c, s = along / length, across / length
    motion[0] = c
    motion[1] = s
    motion[2] = centre[2] - c * centre[0] + s * centre[1]
    motion[3] = centre[3] - s * centre[0] - c * centre[1]
    return True


@compiled
def transform_distances(
    before: NDArray[np.float64],
    now: NDArray[np.float64],
    motion: NDArray[np.float64],
    distances: NDArray[np.float64],
) -> None:
    """Write the distance of each transformed star from where it was seen."""
    for i in range(distances.size):
        x = motion[0] * before[i, 0] - motion[1] * before[i, 1] + motion[2] - now[i, 0]
        y = motion[1] * before[i, 0] + motion[0] * before[i, 1] + motion[3] - now[i, 1]
        distances[i] = math.sqrt(x * x + y * y)


@compiled
def _negative_log_likelihood(distances: NDArray[np.float64], sigma: float) -> float:
    """Cost of a hypothesis: a mixture of a normal error and a uniform one, its share found by expectation maximisation.

    It takes the place of the sum of distances below η of eq. 3.11, which MLESAC minimises in its simplest form.
    """
    share = 0.5
    wide = 1.0 / (_OUTLIER_SPAN_DEG * _OUTLIER_SPAN_DEG)
    cost = 0.0
    for _ in range(_EM_ROUNDS):
        members = 0.0
        cost = 0.0
        for i in range(distances.size):
            near = share * math.exp(-0.5 * (distances[i] / sigma) ** 2) / (2.0 * math.pi * sigma * sigma)
            far = (1.0 - share) * wide
            members += near / (near + far)
            cost -= math.log(near + far)
        share = min(max(members / distances.size, 0.01), 0.99)
    return cost


@compiled
def mlesac(
    before: NDArray[np.float64],
    now: NDArray[np.float64],
    threshold: float,
    trials: int,
    seed: int,
    motion: NDArray[np.float64],
    inliers: NDArray[np.bool_],
) -> bool:
    """Find the rigid motion of greatest likelihood and refit it to its inliers; False if there is none.

    Parameters
    ----------
    before, now
        Matched positions, (m, 2), degrees.
    threshold
        Distance η up to which a star is an inlier, degrees.
    trials
        Most hypotheses; all pairs are tried if they are fewer.
    seed
        Of the draws.
    motion, inliers
        Output: (cos, sin, x, y) and (m,).
    """
    m = before.shape[0]
    if m < 2:
        return False
    pairs = m * (m - 1) // 2
    state = seed & 0x7FFFFFFF
    trial = np.empty(4)
    chosen = np.zeros(m, dtype=np.bool_)
    distances = np.empty(m)
    sigma = max(threshold / 3.0, LIKELY_FLOOR_DEG)
    best = math.inf
    first = 0
    second = 0
    for _ in range(min(pairs, trials)):
        if pairs <= trials:
            second += 1
            if second >= m:
                first += 1
                second = first + 1
        else:
            state = (state * 1103515245 + 12345) & 0x7FFFFFFF
            first = (state >> 8) % m
            state = (state * 1103515245 + 12345) & 0x7FFFFFFF
            second = (first + 1 + (state >> 8) % (m - 1)) % m
        chosen[:] = False
        chosen[first] = True
        chosen[second] = True
        if not rigid_fit(before, now, chosen, trial):
            continue
        transform_distances(before, now, trial, distances)
        cost = _negative_log_likelihood(distances, sigma)
        if cost < best:
            best = cost
            motion[:] = trial
    if best == math.inf:
        return False
    for _ in range(_EM_ROUNDS):
        transform_distances(before, now, motion, distances)
        for i in range(m):
            inliers[i] = distances[i] <= threshold
        if not rigid_fit(before, now, inliers, trial):
            break
        motion[:] = trial
    transform_distances(before, now, motion, distances)
    for i in range(m):
        inliers[i] = distances[i] <= threshold
    return True


def estimate_motion(
    before: NDArray[np.float64],
    now: NDArray[np.float64],
    *,
    threshold_deg: float = 1.0,
    trials: int = MAX_TRIALS,
    seed: int = _SEED,
) -> CameraMotion:
    """Estimate the camera motion from matched stars (line 5 of algorithm 2).

    Parameters
    ----------
    before, now
        Positions of the same stars in the earlier and the later frame, (m, 2), degrees.
    threshold_deg
        Distance η beyond which a match is an outlier.
    trials, seed
        Most hypotheses drawn, and the seed of the draws.

    Raises
    ------
    FilterError
        If there are fewer than two matches, or all of them fall together.
    """
    first = np.ascontiguousarray(before, dtype=np.float64)
    second = np.ascontiguousarray(now, dtype=np.float64)
    motion = np.empty(4)
    inliers = np.zeros(first.shape[0], dtype=np.bool_)
    if (
        first.shape != second.shape
        or first.ndim != 2
        or not mlesac(first, second, threshold_deg, trials, seed, motion, inliers)
    ):
        raise FilterError(
            f"motion: {first.shape[0]} matched stars; at least two in different places are needed"
        )
    distances = np.empty(first.shape[0])
    transform_distances(first, second, motion, distances)
    kept = distances[inliers] if inliers.any() else distances
    cosine, sine, x, y = motion.tolist()
    matrix = np.array([[cosine, -sine, x], [sine, cosine, y], [0.0, 0.0, 1.0]])
    return CameraMotion(
        matrix,
        math.degrees(math.atan2(sine, cosine)),
        motion[2:].copy(),
        float(kept.mean()),
        float(kept.std(ddof=1)) if kept.size > 1 else 0.0,
        inliers,
    )
