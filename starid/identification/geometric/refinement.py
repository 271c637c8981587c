"""Refinement of a coarse attitude: match, solve, estimate the noise, repeat.

Residuals are in pixels: ``r = G (u − A c)``, where u is the direction of a detection, c the direction of the
catalogue star, and G the derivative of the pixel position with respect to direction. A small rotation v of
the sensor moves the predicted position by ``G (A c × v)``, so weighted least squares is a 3 × 3 system; if
the focal length is unknown, its logarithm is the fourth unknown. With pixel residuals weighted by the error
of each star, this is the maximum-likelihood estimate for centroid noise, also in wide fields.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from starid.arithmetic.arrays import Array, Indices
from starid.arithmetic.elementary import cos, exp, power, sin, square
from starid.identification.geometric.matching import BY_NOISE, match_detections, residual
from starid.identification.geometric.observation import (
    MAGNITUDE,
    OFFSET_U,
    OFFSET_V,
    SIGMA_U,
    SIGMA_V,
    U_X,
    U_Y,
    U_Z,
    V_X,
    V_Y,
    V_Z,
    Raw,
    Table,
    observe_scaled,
    remove_aberration,
    without_aberration,
)
from starid.identification.geometric.pattern_index import STAR_MAGNITUDE, IndexArrays
from starid.identification.geometric.settings import Settings
from starid.kernels.jit import inner
from starid.kernels.small_arrays import lower_median, zero

MAX_ROUNDS: Final = 12
"""Largest number of rounds of matching and solving."""

OUTLIER_CHANCE: Final = 3.3e-4
"""Probability that the test rejects a good star: as for a window of 4 sigma."""

MIN_GATE: Final = 0.5
"""A deviation from the expected magnitude up to this is always accepted."""

PRIOR_FREEDOM: Final = 10.0
"""Weight of the caller's errors against the residuals, in degrees of freedom."""

MAGNITUDE_FLOOR: Final = 0.1
MAGNITUDE_CEILING: Final = 1.0
_RAYLEIGH_MEDIAN: Final = 1.17741
_MAD_TO_SIGMA: Final = 1.4826

SCALE: Final = 0
"""Factor on the tangents of the directions."""
VARIANCE: Final = 1
"""Mean square, per degree of freedom, of residual over the caller's error."""
RMS: Final = 2
"""Root mean square distance of the matched stars, pixels."""
ZERO_POINT: Final = 3
"""Catalogue minus instrumental magnitude."""
SCATTER: Final = 4
"""Scatter of the zero point, magnitudes."""
SCALE_VARIANCE: Final = 5
"""Variance of the log of the scale, in units of the caller's errors; 0 if the scale is fixed."""
NUMBERS: Final = 6


@inner
def rotate_sensor(rotation: Array, vx: float, vy: float, vz: float) -> None:
    """Rotate the sensor by +v, in place: ``A ← exp(−[v]×)·A`` (Rodrigues)."""
    angle2 = vx * vx + vy * vy + vz * vz
    angle = math.sqrt(angle2)
    s, c = 1.0 - angle2 / 6.0, 0.5 - angle2 / 24.0
    if angle > 1e-4:
        s, c = sin(angle) / angle, (1.0 - cos(angle)) / angle2
    for column in range(3):
        x, y, z = rotation[0, column], rotation[1, column], rotation[2, column]
        along = c * (vx * x + vy * y + vz * z)
        keep = 1.0 - c * angle2
        rotation[0, column] = keep * x + along * vx + s * (vz * y - vy * z)
        rotation[1, column] = keep * y + along * vy + s * (vx * z - vz * x)
        rotation[2, column] = keep * z + along * vz + s * (vy * x - vx * y)


@inner
def solve_symmetric(matrix: Array, right: Array, size: int, solution: Array) -> bool:
    """Solve the leading `size` rows of a positive definite system by Cholesky; False if it is singular."""
    lower = np.zeros((4, 4))
    for i in range(size):
        for j in range(i + 1):
            value = matrix[i, j]
            for k in range(j):
                value -= lower[i, k] * lower[j, k]
            if i == j:
                if not value > 1e-12 * matrix[i, i]:
                    return False
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
    return True


@inner
def _slopes(detections: Table, i: int, x: float, y: float, z: float, slopes: Array) -> None:
    """Fill (2, 4) with the derivatives of the predicted position of detection i by rotation and scale.

    A rotation v of the sensor moves it by G (c × v), where c = (x, y, z) is the star in the sensor frame; a
    larger scale, that is, a shorter focal length, moves it towards the centre.
    """
    ux, uy, uz = detections[i, U_X], detections[i, U_Y], detections[i, U_Z]
    vx, vy, vz = detections[i, V_X], detections[i, V_Y], detections[i, V_Z]
    slopes[0, 0], slopes[0, 1], slopes[0, 2] = uy * z - uz * y, uz * x - ux * z, ux * y - uy * x
    slopes[1, 0], slopes[1, 1], slopes[1, 2] = vy * z - vz * y, vz * x - vx * z, vx * y - vy * x
    slopes[0, 3], slopes[1, 3] = -detections[i, OFFSET_U], -detections[i, OFFSET_V]


@inner
def _outlier(
    star_table: Array,
    detections: Table,
    rotation: Array,
    stars: Indices,
    normal: Array,
    chi2: float,
    freedom: int,
    settings: Settings,
) -> int:
    """Find the match most inconsistent with the others; −1 if that may be chance.

    Leaving match i out lowers χ² by ``r' (1 − H)⁻¹ r``, where H is its block of the hat matrix. The ratio of
    this drop to the remaining χ² is F(2, ν − 2)-distributed, with the tail ``(1 + 2F/(ν − 2))^(1 − ν/2)``.
    """
    rest = float(freedom - 2)
    prior_freedom = PRIOR_FREEDOM if settings.sigmas_known else 0.0
    if rest + prior_freedom < 1.0:
        return -1
    unknowns = 4 if settings.scale_tolerance > 0.0 else 3
    slopes, unit, column = np.empty((2, 4)), np.empty(4), np.empty(4)
    worst, least = -1, OUTLIER_CHANCE
    for i in range(stars.shape[0]):
        if stars[i] < 0:
            continue
        r0, r1, x, y, z = residual(star_table, detections, rotation, i, stars[i])
        _slopes(detections, i, x, y, z, slopes)
        su, sv = detections[i, SIGMA_U], detections[i, SIGMA_V]
        r0, r1 = r0 / su, r1 / sv
        for k in range(4):
            slopes[0, k] /= su
            slopes[1, k] /= sv
        block = np.zeros((2, 2))
        for a in range(2):
            for k in range(unknowns):
                unit[k] = slopes[a, k]
            solve_symmetric(normal, unit, unknowns, column)
            for b in range(2):
                for k in range(unknowns):
                    block[a, b] += slopes[b, k] * column[k]
        h00, h01, h11 = 1.0 - block[0, 0], -block[0, 1], 1.0 - block[1, 1]
        determinant = h00 * h11 - h01 * h01
        if not determinant > 1e-9:
            continue
        drop = (h11 * r0 * r0 - 2.0 * h01 * r0 * r1 + h00 * r1 * r1) / determinant
        others = max(chi2 - drop, 0.0) + prior_freedom
        tail = power(1.0 + drop / max(others, 1e-12), -0.5 * (rest + prior_freedom))
        if tail < least:
            worst, least = i, tail
    return worst


@inner
def normal_equations(
    star_table: Array,
    detections: Table,
    rotation: Array,
    stars: Indices,
    unknowns: int,
    normal: Array,
    right: Array,
) -> float:
    """Fill the normal matrix (4, 4) and right side (4,) over the matches; return Σ (r/σ)².

    The unknowns are the rotation v of the sensor (3) and, if there are 4, the change of log scale.
    """
    for a in range(4):
        right[a] = 0.0
        for b in range(4):
            normal[a, b] = 0.0
    chi2 = 0.0
    slopes = np.empty((2, 4))
    for i in range(stars.shape[0]):
        if stars[i] < 0:
            continue
        r0, r1, x, y, z = residual(star_table, detections, rotation, i, stars[i])
        _slopes(detections, i, x, y, z, slopes)
        weight_u, weight_v = 1.0 / square(detections[i, SIGMA_U]), 1.0 / square(detections[i, SIGMA_V])
        chi2 += weight_u * r0 * r0 + weight_v * r1 * r1
        for a in range(unknowns):
            at_u, at_v = weight_u * slopes[0, a], weight_v * slopes[1, a]
            right[a] += at_u * r0 + at_v * r1
            for b in range(a + 1):
                normal[a, b] += at_u * slopes[0, b] + at_v * slopes[1, b]
    for a in range(4):
        for b in range(a):
            normal[b, a] = normal[a, b]
    return chi2


@inner
def photometry(star_table: Array, detections: Table, stars: Indices, scratch: Array) -> tuple[float, float]:
    """Robust zero point (catalogue minus instrumental magnitude) of the matches, and its scatter."""
    m = zero()
    for i in range(stars.shape[0]):
        if stars[i] >= 0:
            scratch[m] = star_table[stars[i], STAR_MAGNITUDE] - detections[i, MAGNITUDE]
            m += 1
    zero_point = lower_median(scratch, m)
    for k in range(m):
        scratch[k] = abs(scratch[k] - zero_point)
    scatter = _MAD_TO_SIGMA * lower_median(scratch, m)
    return zero_point, min(max(scatter, MAGNITUDE_FLOOR), MAGNITUDE_CEILING)


@inner
def distances(
    star_table: Array, detections: Table, rotation: Array, stars: Indices, scratch: Array
) -> tuple[float, float]:
    """Noise for unit error, from the median distance of the matches (Rayleigh); their RMS distance, px."""
    m = zero()
    total = 0.0
    for i in range(stars.shape[0]):
        if stars[i] >= 0:
            r0, r1, _, _, _ = residual(star_table, detections, rotation, i, stars[i])
            scratch[m] = math.sqrt(square(r0 / detections[i, SIGMA_U]) + square(r1 / detections[i, SIGMA_V]))
            total += r0 * r0 + r1 * r1
            m += 1
    return lower_median(scratch, m) / _RAYLEIGH_MEDIAN, math.sqrt(total / max(m, 1))


@inner
def _same(stars: Indices, previous: Indices) -> bool:
    """Whether the matches are unchanged; `previous` is updated."""
    same = True
    for i in range(stars.shape[0]):
        if stars[i] != previous[i]:
            same = False
            previous[i] = stars[i]
    return same


@inner
def _marginalise(normal: Array, scratch: Array) -> float:
    """Marginalise over the scale: the leading block becomes the normal matrix of the rotation alone.

    Returns the marginal variance of the logarithm of the scale.
    """
    solve_symmetric(normal, normal[3], normal.shape[0] - 1, scratch)
    weight = normal[3, 3]
    for a in range(3):
        weight -= normal[3, a] * scratch[a]
    for a in range(3):
        for b in range(3):
            normal[a, b] -= normal[a, 3] * normal[3, b] / normal[3, 3]
    return float(1.0 / weight)


@inner
def directions_depend_on_solution(settings: Settings) -> bool:
    """Whether the directions of the detections change with the solution: with its scale or by aberration."""
    return bool(settings.scale_tolerance > 0.0) or _observer_moves(settings)


@inner
def _observer_moves(settings: Settings) -> bool:
    return bool(settings.beta_x != 0.0 or settings.beta_y != 0.0 or settings.beta_z != 0.0)


@inner
def _observe_with(
    raw: Raw, observed: Table, settings: Settings, rotation: Array, scale: float, detections: Table
) -> None:
    """Fill `detections` with the detections for the refined scale, corrected for aberration."""
    if settings.scale_tolerance > 0.0:
        observe_scaled(raw, observed, scale, detections)
    if _observer_moves(settings):
        beta = (settings.beta_x, settings.beta_y, settings.beta_z)
        remove_aberration(
            detections if settings.scale_tolerance > 0.0 else observed, beta, rotation, detections
        )


@inner
def _rotate_by_aberration(settings: Settings, rotation: Array) -> None:
    """Rotate an attitude derived from aberrated directions by the aberration at the boresight, in place."""
    bx, by, bz = settings.beta_x, settings.beta_y, settings.beta_z
    x, y, _ = without_aberration(
        0.0,
        0.0,
        1.0,
        rotation[0, 0] * bx + rotation[0, 1] * by + rotation[0, 2] * bz,
        rotation[1, 0] * bx + rotation[1, 1] * by + rotation[1, 2] * bz,
        rotation[2, 0] * bx + rotation[2, 1] * by + rotation[2, 2] * bz,
    )
    rotate_sensor(rotation, y, -x, 0.0)


@inner
def refine(
    index: IndexArrays,
    raw: Raw,
    observed: Table,
    settings: Settings,
    min_matched: int,
    detections: Table,
    rotation: Array,
    stars: Indices,
    normal: Array,
    numbers: Array,
) -> int:
    """Match and solve until the matches no longer change.

    Parameters
    ----------
    raw, observed
        The detections from the caller, and the same sorted (`observe`).
    min_matched : int
        The refinement fails with fewer matches.
    detections : Table
        Where `directions_depend_on_solution`, a copy of `observed`, filled with the detections for the
        refined focal length and attitude; otherwise `observed`.
    rotation : ndarray (3, 3)
        ICRS→sensor; coarse on entry, refined on return.
    stars : ndarray (n,) int64
        Filled with the index star of each detection, or −1.
    normal : ndarray (4, 4)
        Filled with the normal matrix of the rotation in units of the caller's errors (leading 3 × 3).
    numbers : ndarray (`NUMBERS`,)
        `SCALE` and `ZERO_POINT` on entry; all values on return.

    Returns
    -------
    int
        Number of stars matched; 0 if the refinement failed.
    """
    n = observed.shape[0]
    star_table = index.stars
    previous, costs, scratch = np.empty(n, dtype=np.int64), np.empty(n), np.empty(max(n, 4))
    size = 16
    while size < 4 * n:
        size *= 2
    owners, excluded = np.empty(size, dtype=np.int64), np.zeros(n, dtype=np.bool_)
    right, step = np.empty(4), np.zeros(4)
    free_scale = settings.scale_tolerance > 0.0
    unknowns = 4 if free_scale else 3
    if _observer_moves(settings):
        _rotate_by_aberration(settings, rotation)
    _observe_with(raw, observed, settings, rotation, numbers[SCALE], detections)
    gate, numbers[SCATTER] = settings.magnitude_gate, settings.magnitude_gate
    reach, sigma = settings.window, 1.0
    matched = 0
    for number in range(MAX_ROUNDS):
        matched = match_detections(
            index, detections, rotation, excluded, (reach, sigma, gate, settings.px_per_rad),
            numbers[ZERO_POINT], numbers[SCATTER], stars, costs, owners,
        )  # fmt: skip
        if matched < min_matched:
            return 0
        stable = _same(stars, previous) and number > 0
        chi2 = normal_equations(star_table, detections, rotation, stars, unknowns, normal, right)
        if not solve_symmetric(normal, right, unknowns, step):
            return 0
        for k in range(unknowns):
            chi2 -= right[k] * step[k]
        rotate_sensor(rotation, step[0], step[1], step[2])
        if free_scale:
            numbers[SCALE] *= exp(step[3])
        _observe_with(raw, observed, settings, rotation, numbers[SCALE], detections)
        freedom = max(2 * matched - unknowns, 1)
        numbers[VARIANCE] = max(chi2, 1e-12) / freedom
        if stable:
            worst = _outlier(star_table, detections, rotation, stars, normal, chi2, freedom, settings)
            if worst < 0:
                break
            excluded[worst] = True
        sigma = math.sqrt(numbers[VARIANCE])
        if number == 0:
            # robust estimates, because the first matches may be wrong
            sigma, _ = distances(star_table, detections, rotation, stars, scratch)
            sigma *= math.sqrt(2.0 * matched / freedom)
            numbers[ZERO_POINT], numbers[SCATTER] = photometry(star_table, detections, stars, scratch)
            gate = min(gate, max(5.0 * numbers[SCATTER], MIN_GATE))
            reach = BY_NOISE
    _, numbers[RMS] = distances(star_table, detections, rotation, stars, scratch)
    numbers[SCALE_VARIANCE] = _marginalise(normal, scratch) if free_scale else 0.0
    return matched
