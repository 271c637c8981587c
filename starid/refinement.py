"""From a coarse attitude to the best one: match, solve, estimate the noise, match again.

Residuals are pixels: ``r = G (u − A c)``, u the direction that a detection sees, c the catalogue star, G the
derivative of the pixel position by the direction. For a turn of the sensor by a small vector v the residual
changes by ``−G (A c × v)``, which makes weighted least squares a 3 × 3 system; where the focal length is
unknown, its logarithm is the fourth unknown. Pixel residuals weighted by each star's own error make the
estimate the maximum-likelihood one for centroid noise, wide fields included.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from starid.jit import compiled
from starid.observation import Observations, rescaled
from starid.pattern_index import GRID_CELLS, GRID_MARGIN, IndexArrays
from starid.sky_grid import cell_of

MAX_ROUNDS: Final = 12
"""Rounds of matching and solving."""

FIRST_MATCHED: Final = 40
"""Detections used in the first round, the brightest, while the attitude is still coarse."""

WINDOW_SIGMAS: Final = 4.0
"""Half-width of the final matching window in units of the centroid noise."""

SMALLEST_WINDOW_PX: Final = 0.15
MAGNITUDE_FLOOR: Final = 0.1
MAGNITUDE_CEILING: Final = 1.0
_RAYLEIGH_MEDIAN: Final = 1.17741
_MAD_TO_SIGMA: Final = 1.4826


class Refined(NamedTuple):
    """Outcome of a refinement.

    Attributes
    ----------
    matched : int
        Stars matched; 0 where it failed.
    rotation : ndarray (3, 3)
        ICRS→sensor.
    scale : float
        Factor on the tangents of the directions.
    stars : ndarray (n,) int64
        Index star of each detection (in the order of the observations), −1 without.
    normal : ndarray (3, 3)
        Normal matrix of the rotation in units of the given errors (marginal over the scale where it is free).
    variance : float
        Mean square of residual over given error per degree of freedom.
    rms_px : float
        Root mean square distance of the matched stars, pixels.
    zero_point, magnitude_sigma : float
        Catalogue minus instrumental magnitude, and its scatter.
    scale_variance : float
        Variance of the logarithm of the scale in units of the given errors (0 where it is fixed).
    """

    matched: int
    rotation: NDArray[np.float64]
    scale: float
    stars: NDArray[np.int64]
    normal: NDArray[np.float64]
    variance: float
    rms_px: float
    zero_point: float
    magnitude_sigma: float
    scale_variance: float


@compiled
def nothing_refined() -> Refined:
    """Return the outcome of a refinement that never was."""
    none = math.nan
    stars = np.empty(0, dtype=np.int64)
    return Refined(
        0, np.empty((0, 0)), 1.0, stars, np.empty((0, 0)), none, none, none, none, 0.0
    )  # fmt: skip


@compiled
def turned(rotation: NDArray[np.float64], vx: float, vy: float, vz: float) -> NDArray[np.float64]:
    """Matrix after the sensor has turned by +v: ``exp(−[v]×)·A`` (Rodrigues)."""
    angle2 = vx * vx + vy * vy + vz * vz
    angle = math.sqrt(angle2)
    s = 1.0 - angle2 / 6.0 if angle < 1e-4 else math.sin(angle) / angle
    c = 0.5 - angle2 / 24.0 if angle < 1e-4 else (1.0 - math.cos(angle)) / angle2
    turn = np.empty((3, 3))
    turn[0, 0], turn[0, 1], turn[0, 2] = (
        1.0 - c * (vy * vy + vz * vz),
        s * vz + c * vx * vy,
        -s * vy + c * vx * vz,
    )
    turn[1, 0], turn[1, 1], turn[1, 2] = (
        -s * vz + c * vx * vy,
        1.0 - c * (vx * vx + vz * vz),
        s * vx + c * vy * vz,
    )
    turn[2, 0], turn[2, 1], turn[2, 2] = (
        s * vy + c * vx * vz,
        -s * vx + c * vy * vz,
        1.0 - c * (vx * vx + vy * vy),
    )
    out = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            out[i, j] = (
                turn[i, 0] * rotation[0, j] + turn[i, 1] * rotation[1, j] + turn[i, 2] * rotation[2, j]
            )
    return out


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
def residual(
    index: IndexArrays,
    observations: Observations,
    rotation: NDArray[np.float64],
    i: int,
    star: int,
) -> tuple[float, float, float, float, float]:
    """Residual (rx, ry) in pixels of detection i against a star, and the star's direction in the sensor."""
    c = index.vectors[star]
    x = rotation[0, 0] * c[0] + rotation[0, 1] * c[1] + rotation[0, 2] * c[2]
    y = rotation[1, 0] * c[0] + rotation[1, 1] * c[1] + rotation[1, 2] * c[2]
    z = rotation[2, 0] * c[0] + rotation[2, 1] * c[1] + rotation[2, 2] * c[2]
    u = observations.directions[i]
    dx, dy, dz = u[0] - x, u[1] - y, u[2] - z
    g = observations.gradients[i]
    return (
        g[0, 0] * dx + g[0, 1] * dy + g[0, 2] * dz,
        g[1, 0] * dx + g[1, 1] * dy + g[1, 2] * dz,
        x,
        y,
        z,
    )


@compiled
def match_detections(
    index: IndexArrays,
    observations: Observations,
    rotation: NDArray[np.float64],
    count: int,
    reach_px: float,
    sigma: float,
    zero_point: float,
    magnitude_sigma: float,
    magnitude_gate: float,
    px_per_rad: float,
    stars: NDArray[np.int64],
    costs: NDArray[np.float64],
    owners: NDArray[np.int64],
) -> int:
    """Match each of the first `count` detections to the likeliest star in its window; return how many.

    The likeliest has the least ``(r/σ)² + (Δm/σ_m)²``. A star claimed twice stays with the cheaper claim.

    Parameters
    ----------
    reach_px : float
        Window, pixels; 0 for `WINDOW_SIGMAS` times each detection's noise.
    sigma : float
        Noise of a detection of unit error, pixels (all of them equal while the window is).
    zero_point, magnitude_sigma, magnitude_gate : float
        Catalogue minus instrumental magnitude, its scatter, and the largest deviation from it.
    px_per_rad : float
        Least pixels per radian in the field, for the first coarse test.
    stars, costs : ndarray (n,)
        Filled: index star or −1, and its cost.
    owners : ndarray of a power of two, > 2·count
        Workspace.
    """
    n = int(index.numbers[GRID_CELLS])
    mask = owners.shape[0] - 1
    owners[:] = -1
    matched = 0
    for i in range(observations.directions.shape[0]):
        stars[i] = -1
    for i in range(count):
        error = reach_px / 3.0 if reach_px > 0.0 else sigma * observations.sigmas[i]
        reach = reach_px if reach_px > 0.0 else max(WINDOW_SIGMAS * error, SMALLEST_WINDOW_PX)
        limit = min(reach / px_per_rad, index.numbers[GRID_MARGIN])
        limit2 = limit * limit
        x, y, z = to_sky(rotation, observations.directions[i])
        expected = observations.magnitudes[i] + zero_point
        cell = cell_of(x, y, z, n)
        best = -1
        best_cost = math.inf
        for entry in range(index.grid_start[cell], index.grid_start[cell + 1]):
            star = index.grid_stars[entry]
            deviation = index.magnitudes[star] - expected
            if deviation > magnitude_gate:
                break
            if deviation < -magnitude_gate:
                continue
            dx = index.vectors[star, 0] - x
            dy = index.vectors[star, 1] - y
            dz = index.vectors[star, 2] - z
            if dx * dx + dy * dy + dz * dz > limit2:
                continue
            rx, ry, _, _, _ = residual(index, observations, rotation, i, star)
            distance2 = rx * rx + ry * ry
            if distance2 > reach * reach:
                continue
            cost = distance2 / (error * error) + (deviation / magnitude_sigma) ** 2
            if cost < best_cost:
                best, best_cost = star, cost
        if best < 0:
            continue
        slot = (best * 40503) & mask
        while owners[slot] >= 0 and stars[owners[slot]] != best:
            slot = (slot + 1) & mask
        rival = owners[slot]
        if rival < 0:
            matched += 1
        elif costs[rival] <= best_cost:
            continue
        else:
            stars[rival] = -1
        owners[slot] = i
        stars[i] = best
        costs[i] = best_cost
    return matched


@compiled
def solve_symmetric(
    matrix: NDArray[np.float64], right: NDArray[np.float64], size: int
) -> tuple[NDArray[np.float64], bool]:
    """Solve a positive definite system of the leading `size` rows by Cholesky; False where it is singular."""
    lower = np.zeros((size, size))
    solution = np.empty(size)
    for i in range(size):
        for j in range(i + 1):
            value = matrix[i, j]
            for k in range(j):
                value -= lower[i, k] * lower[j, k]
            if i == j:
                if value <= 1e-12 * matrix[i, i]:
                    return solution, False
                lower[i, i] = math.sqrt(value)
            else:
                lower[i, j] = value / lower[j, j]
    for i in range(size):
        value = right[i]
        for k in range(i):
            value -= lower[i, k] * solution[k]
        solution[i] = value / lower[i, i]
    for i in range(size - 1, -1, -1):
        value = solution[i]
        for k in range(i + 1, size):
            value -= lower[k, i] * solution[k]
        solution[i] = value / lower[i, i]
    return solution, True


@compiled
def normal_equations(
    index: IndexArrays,
    observations: Observations,
    rotation: NDArray[np.float64],
    count: int,
    stars: NDArray[np.int64],
    normal: NDArray[np.float64],
    right: NDArray[np.float64],
) -> float:
    """Fill the normal matrix (4, 4) and right side (4,) over the matches; return Σ (r/σ)².

    Unknowns: turn of the sensor v (3), then the change of the logarithm of the scale.
    """
    normal[:] = 0.0
    right[:] = 0.0
    chi2 = 0.0
    slopes = np.empty((2, 4))
    for i in range(count):
        if stars[i] < 0:
            continue
        rx, ry, x, y, z = residual(index, observations, rotation, i, stars[i])
        g = observations.gradients[i]
        u = observations.directions[i]
        lateral2 = u[0] * u[0] + u[1] * u[1]
        for axis in range(2):
            # predicted position moves by G (c × v) for a turn v, by −G du/dln(scale) for the scale
            slopes[axis, 0] = g[axis, 1] * z - g[axis, 2] * y
            slopes[axis, 1] = g[axis, 2] * x - g[axis, 0] * z
            slopes[axis, 2] = g[axis, 0] * y - g[axis, 1] * x
            slopes[axis, 3] = -(
                (g[axis, 0] * u[0] + g[axis, 1] * u[1]) * (1.0 - lateral2) - g[axis, 2] * u[2] * lateral2
            )
        weight = 1.0 / (observations.sigmas[i] * observations.sigmas[i])
        chi2 += weight * (rx * rx + ry * ry)
        for a in range(4):
            right[a] += weight * (slopes[0, a] * rx + slopes[1, a] * ry)
            for b in range(a + 1):
                normal[a, b] += weight * (slopes[0, a] * slopes[0, b] + slopes[1, a] * slopes[1, b])
    for a in range(4):
        for b in range(a):
            normal[b, a] = normal[a, b]
    return chi2


@compiled
def _median(values: NDArray[np.float64], count: int) -> float:
    return float(np.median(values[:count]))


@compiled
def photometry(
    index: IndexArrays,
    observations: Observations,
    count: int,
    stars: NDArray[np.int64],
    scratch: NDArray[np.float64],
) -> tuple[float, float]:
    """Zero point (catalogue minus instrumental magnitude) and its scatter, robust, over the matches."""
    m = 0
    for i in range(count):
        if stars[i] >= 0:
            scratch[m] = index.magnitudes[stars[i]] - observations.magnitudes[i]
            m += 1
    zero_point = _median(scratch, m)
    for k in range(m):
        scratch[k] = abs(scratch[k] - zero_point)
    scatter = _MAD_TO_SIGMA * _median(scratch, m)
    return zero_point, min(max(scatter, MAGNITUDE_FLOOR), MAGNITUDE_CEILING)


@compiled
def typical_distance(
    index: IndexArrays,
    observations: Observations,
    rotation: NDArray[np.float64],
    count: int,
    stars: NDArray[np.int64],
    scratch: NDArray[np.float64],
) -> float:
    """Noise of a star of unit error from the median distance of the matches (Rayleigh), pixels."""
    m = 0
    for i in range(count):
        if stars[i] >= 0:
            rx, ry, _, _, _ = residual(index, observations, rotation, i, stars[i])
            scratch[m] = math.sqrt(rx * rx + ry * ry) / observations.sigmas[i]
            m += 1
    return _median(scratch, m) / _RAYLEIGH_MEDIAN


@compiled
def _same(stars: NDArray[np.int64], previous: NDArray[np.int64]) -> bool:
    """Whether the matches stand still; `previous` is brought up to date."""
    same = True
    for i in range(stars.shape[0]):
        if stars[i] != previous[i]:
            same = False
            previous[i] = stars[i]
    return same


@compiled
def _rms(
    index: IndexArrays, observations: Observations, rotation: NDArray[np.float64], stars: NDArray[np.int64]
) -> float:
    """Root mean square distance of the matched detections from their stars, pixels."""
    total, count = 0.0, 0
    for i in range(stars.shape[0]):
        if stars[i] >= 0:
            rx, ry, _, _, _ = residual(index, observations, rotation, i, stars[i])
            total += rx * rx + ry * ry
            count += 1
    return math.sqrt(total / max(count, 1))


@compiled
def _marginal(normal: NDArray[np.float64], free_scale: bool) -> NDArray[np.float64]:
    """Normal matrix (3, 3) of the rotation, whatever the scale is."""
    marginal = normal[:3, :3].copy()
    if free_scale:
        for a in range(3):
            for b in range(3):
                marginal[a, b] -= normal[a, 3] * normal[3, b] / normal[3, 3]
    return marginal


@compiled
def _scale_weight(normal: NDArray[np.float64]) -> float:
    """Weight of the logarithm of the scale, marginal over the rotation."""
    unit = normal[:3, 3].copy()
    shift, _ = solve_symmetric(normal, unit, 3)
    return float(normal[3, 3] - shift[0] * unit[0] - shift[1] * unit[1] - shift[2] * unit[2])


@compiled
def refine(
    index: IndexArrays,
    given: Observations,
    rotation: NDArray[np.float64],
    scale: float,
    free_scale: bool,
    reach_px: float,
    zero_point: float,
    magnitude_gate: float,
    px_per_rad: float,
    least_matched: int,
) -> Refined:
    """Match and solve until the matches stand still.

    Parameters
    ----------
    given : Observations
        With the nominal focal length.
    rotation, scale
        Where to begin.
    free_scale : bool
        Whether the scale is an unknown.
    reach_px : float
        Window of the first matching, pixels.
    zero_point, magnitude_gate : float
        First guess of catalogue minus instrumental magnitude, and the largest deviation from it.
    px_per_rad : float
        Least pixels per radian in the field.
    least_matched : int
        Fewer matches are a failure.
    """
    n = given.directions.shape[0]
    stars, previous = np.full(n, -1, dtype=np.int64), np.full(n, -1, dtype=np.int64)
    costs, scratch = np.empty(n), np.empty(n)
    size = 16
    while size < 4 * n:
        size *= 2
    owners = np.empty(size, dtype=np.int64)
    normal, right = np.empty((4, 4)), np.empty(4)
    unknowns = 4 if free_scale else 3
    observations = rescaled(given, scale) if scale != 1.0 else given
    count = min(FIRST_MATCHED, n)
    sigma = 1.0
    magnitude_sigma = magnitude_gate
    matched = 0
    variance = math.nan
    for step in range(MAX_ROUNDS):
        matched = match_detections(
            index, observations, rotation, count, reach_px, sigma, zero_point, magnitude_sigma, magnitude_gate,
            px_per_rad, stars, costs, owners,
        )  # fmt: skip
        if matched < least_matched:
            return nothing_refined()
        stable = _same(stars, previous) and step > 0
        chi2 = normal_equations(index, observations, rotation, count, stars, normal, right)
        step_vector, solved = solve_symmetric(normal, right, unknowns)
        if not solved:
            return nothing_refined()
        for k in range(unknowns):
            chi2 -= right[k] * step_vector[k]
        rotation = turned(rotation, step_vector[0], step_vector[1], step_vector[2])
        if free_scale:
            scale *= math.exp(step_vector[3])
            observations = rescaled(given, scale)
        freedom = max(2 * matched - unknowns, 1)
        variance = max(chi2, 1e-12) / freedom
        sigma = math.sqrt(variance)
        if step == 0:
            # wrong pairs may be among the first matches: robust estimates
            sigma = typical_distance(index, observations, rotation, count, stars, scratch)
            sigma *= math.sqrt(2.0 * matched / freedom)
            zero_point, magnitude_sigma = photometry(index, observations, count, stars, scratch)
            magnitude_gate = min(magnitude_gate, max(5.0 * magnitude_sigma, 0.75))
            reach_px = 0.0
        if stable:
            break
        count = n
    return Refined(
        matched, rotation, scale, stars, _marginal(normal, free_scale), variance,
        _rms(index, observations, rotation, stars), zero_point, magnitude_sigma,
        1.0 / _scale_weight(normal) if free_scale else 0.0,
    )  # fmt: skip
