"""Lost in space: triangles of bright detections looked up in the index, each hit tested and refined.

Detections are taken by falling flux; triangle (i, j, k) is tried after all triangles of brighter stars, so
that few false stars among the brightest delay the answer and many do not prevent it: when the brightest are
exhausted, triangles drawn from a wider choice follow.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from starid.jit import compiled
from starid.observation import Observations, observe, rescaled
from starid.pattern_index import (
    SHORTEST_SIDE,
    SIDE_BINS,
    SIDE_STEP,
    SIDE_STEPS,
    IndexArrays,
    chord,
    handedness,
    sorted_triangle,
)
from starid.refinement import Refined, nothing_refined, refine
from starid.verification import ROTATIONS, hit_odds, log_false_probability, test_order, worth_refining

SEARCH_TOLERANCE: Final = 0
"""Largest error of a side, radians."""
MAGNITUDE_GATE: Final = 1
"""Largest deviation of a star's magnitude from what its flux says, magnitudes."""
MAX_TRIANGLES: Final = 2
"""Triangles of detections looked up before giving up."""
SCALE_TOLERANCE: Final = 3
"""Relative error of the focal length (0 where it is known)."""
WINDOW: Final = 4
"""First matching window, pixels."""
LARGEST_SIGMA: Final = 5
"""Largest centroid noise believed, pixels per axis."""
LOG_CHANCE: Final = 6
"""Logarithm of the largest probability of a false answer."""
PX_PER_RAD: Final = 7
"""Least pixels per radian in the field."""
SIGMAS_KNOWN: Final = 8
"""Not 0 where the errors of the positions are given."""
FIELD_PX: Final = 9
"""Pixels in the field."""
LOG_CHANCE_TRACKING: Final = 10
"""The same as `LOG_CHANCE` for an answer near a predicted attitude."""
TEST_WINDOW: Final = 11
"""Window of the sequential test, radians."""
SETTING_COUNT: Final = 12

SYSTEMATIC: Final = 14
"""Brightest detections of which every triangle is tried first."""

DRAWN_FROM: Final = 60
"""Brightest detections from which further triangles are drawn."""

LEAST_MATCHED: Final = 4
"""Matches that an answer needs."""

NOTHING: Final = 0
ACCEPTED: Final = 1
TOO_FEW: Final = 2
NOISY: Final = 3


class Outcome(NamedTuple):
    """Answer of a search.

    Attributes
    ----------
    status : int
        `ACCEPTED`, `NOTHING`, `TOO_FEW` or `NOISY`.
    refined : Refined
        The refined attitude (of the last candidate where not accepted).
    source : ndarray (n,)
        Row of the detection as given, for each observation.
    log_chance : float
        Logarithm of the bound on the probability of a false answer.
    triangles, candidates : int
        Work done.
    """

    status: int
    refined: Refined
    source: NDArray[np.int64]
    log_chance: float
    triangles: int
    candidates: int


@compiled
def frame_of(a: NDArray[np.float64], b: NDArray[np.float64], c: NDArray[np.float64]) -> NDArray[np.float64]:
    """Orthonormal frame (rows) of three directions: their sum, the side a − b made normal to it, the third."""
    frame = np.empty((3, 3))
    sx, sy, sz = a[0] + b[0] + c[0], a[1] + b[1] + c[1], a[2] + b[2] + c[2]
    k = 1.0 / math.sqrt(sx * sx + sy * sy + sz * sz)
    sx, sy, sz = sx * k, sy * k, sz * k
    dx, dy, dz = a[0] - b[0], a[1] - b[1], a[2] - b[2]
    along = dx * sx + dy * sy + dz * sz
    dx, dy, dz = dx - along * sx, dy - along * sy, dz - along * sz
    k = 1.0 / math.sqrt(dx * dx + dy * dy + dz * dz)
    dx, dy, dz = dx * k, dy * k, dz * k
    frame[0, 0], frame[0, 1], frame[0, 2] = sx, sy, sz
    frame[1, 0], frame[1, 1], frame[1, 2] = dx, dy, dz
    frame[2, 0], frame[2, 1], frame[2, 2] = sy * dz - sz * dy, sz * dx - sx * dz, sx * dy - sy * dx
    return frame


@compiled
def rotation_between(sensor: NDArray[np.float64], sky: NDArray[np.float64]) -> NDArray[np.float64]:
    """ICRS→sensor matrix that carries one frame (rows) into the other: sensorᵀ · sky."""
    rotation = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            rotation[i, j] = sensor[0, i] * sky[0, j] + sensor[1, i] * sky[1, j] + sensor[2, i] * sky[2, j]
    return rotation


@compiled
def judged(
    index: IndexArrays,
    observations: Observations,
    refined: Refined,
    prior_volume: float,
    settings: NDArray[np.float64],
) -> float:
    """`log_false_probability` of a refined attitude under the settings."""
    if refined.matched == 0 or refined.rms_px > math.sqrt(2.0) * settings[LARGEST_SIGMA]:
        return 0.0
    seen = rescaled(observations, refined.scale) if refined.scale != 1.0 else observations
    spread = 2.0 * settings[SCALE_TOLERANCE]
    return log_false_probability(
        index, seen, refined, settings[SIGMAS_KNOWN] > 0.0, prior_volume, spread, settings[FIELD_PX]
    )


@compiled
def _try_triangle(
    index: IndexArrays,
    observations: Observations,
    corners: tuple[int, int, int],
    odds: NDArray[np.float64],
    order: NDArray[np.int64],
    settings: NDArray[np.float64],
    work: NDArray[np.int64],
) -> tuple[Refined, float, bool]:
    """Look a triangle of detections up; refine what passes the sequential test.

    `work` counts triangles and candidates. Returns the last refinement, its bound, and whether it stands.
    """
    directions = observations.directions
    none = nothing_refined()
    i, j, k = corners
    c0, c1, c2 = chord(directions, j, k), chord(directions, i, k), chord(directions, i, j)
    s0, s1, s2, i, j, k = sorted_triangle(c0, c1, c2, i, j, k)
    step = index.numbers[SIDE_STEP]
    tolerance = settings[SEARCH_TOLERANCE]
    spread = settings[SCALE_TOLERANCE]
    longest = step * SIDE_STEPS
    if s2 * (1.0 + spread) < index.numbers[SHORTEST_SIDE] or s0 * (1.0 - spread) > longest:
        return none, 0.0, False
    if s1 + s2 - s0 < tolerance:
        return none, 0.0, False
    work[0] += 1
    bins = int(index.numbers[SIDE_BINS])
    hand = handedness(directions, i, j, k)
    low0, high0 = s0 * (1.0 - spread) - tolerance, min(s0 * (1.0 + spread) + tolerance, longest)
    first_bin = max(int(low0 / longest * bins), 0)
    last_bin = min(int(high0 / longest * bins), bins - 1)
    mean_magnitude = (
        observations.magnitudes[i] + observations.magnitudes[j] + observations.magnitudes[k]
    ) / 3.0
    gate = settings[MAGNITUDE_GATE]
    sensor_frame = frame_of(directions[i], directions[j], directions[k])
    for bin0 in range(first_bin, last_bin + 1):
        ratio_low = max(bin0 * longest / bins - tolerance, low0) / s0 if spread > 0.0 else 1.0
        ratio_high = min((bin0 + 1) * longest / bins + tolerance, high0) / s0 if spread > 0.0 else 1.0
        low1 = max(int((s1 * ratio_low - tolerance) / longest * bins), 0)
        high1 = min(int((s1 * ratio_high + tolerance) / longest * bins), bins - 1)
        row = (hand * bins + bin0) * bins
        for entry in range(index.bin_start[row + low1], index.bin_start[row + high1 + 1]):
            p0 = index.sides[entry, 0] * step
            if p0 < low0 or p0 > high0:
                continue
            scale = p0 / s0 if spread > 0.0 else 1.0
            if abs(index.sides[entry, 1] * step - s1 * scale) > tolerance:
                continue
            if abs(index.sides[entry, 2] * step - s2 * scale) > tolerance:
                continue
            work[1] += 1
            a = index.pattern_stars[index.corners[entry, 0]]
            b = index.pattern_stars[index.corners[entry, 1]]
            c = index.pattern_stars[index.corners[entry, 2]]
            zero_point = (
                index.magnitudes[a] + index.magnitudes[b] + index.magnitudes[c]
            ) / 3.0 - mean_magnitude
            if (
                abs(index.magnitudes[a] - observations.magnitudes[i] - zero_point) > gate
                or abs(index.magnitudes[b] - observations.magnitudes[j] - zero_point) > gate
                or abs(index.magnitudes[c] - observations.magnitudes[k] - zero_point) > gate
            ):
                continue
            if spread > 0.0:
                sensor_frame = _scaled_frame(directions, i, j, k, scale)
            rotation = rotation_between(
                sensor_frame, frame_of(index.vectors[a], index.vectors[b], index.vectors[c])
            )
            if not worth_refining(
                index,
                observations,
                rotation,
                scale,
                zero_point + gate,
                settings[TEST_WINDOW],
                odds,
                order,
                (i, j, k),
            ):
                continue
            refined = refine(
                index, observations, rotation, scale, spread > 0.0, settings[WINDOW],
                zero_point, gate, settings[PX_PER_RAD], LEAST_MATCHED,
            )  # fmt: skip
            bound = judged(index, observations, refined, ROTATIONS, settings)
            if bound < settings[LOG_CHANCE]:
                return refined, bound, True
    return none, 0.0, False


@compiled
def _scaled_frame(
    directions: NDArray[np.float64], i: int, j: int, k: int, scale: float
) -> NDArray[np.float64]:
    """`frame_of` three detections seen with the focal length divided by `scale`."""
    scaled = np.empty((3, 3))
    for row, source in enumerate((i, j, k)):
        x, y, z = directions[source, 0] * scale, directions[source, 1] * scale, directions[source, 2]
        norm = math.sqrt(x * x + y * y + z * z)
        scaled[row, 0], scaled[row, 1], scaled[row, 2] = x / norm, y / norm, z / norm
    return frame_of(scaled[0], scaled[1], scaled[2])


@compiled
def search(
    index: IndexArrays,
    params: NDArray[np.float64],
    xy: NDArray[np.float64],
    flux: NDArray[np.float64],
    sigmas: NDArray[np.float64],
    settings: NDArray[np.float64],
) -> Outcome:
    """Find the attitude of a set of detections without knowing anything of it."""
    observations = observe(params, xy, flux, sigmas)
    n = observations.directions.shape[0]
    refined = nothing_refined()
    work = np.zeros(2, dtype=np.int64)
    if n < 4:
        return Outcome(TOO_FEW, refined, observations.source, 0.0, 0, 0)
    odds, order = hit_odds(index, settings[TEST_WINDOW]), test_order(n)
    limit = int(settings[MAX_TRIANGLES])
    systematic = min(n, SYSTEMATIC)
    for k in range(2, systematic):
        for j in range(1, k):
            for i in range(j):
                refined, bound, found = _try_triangle(
                    index, observations, (i, j, k), odds, order, settings, work
                )
                if found:
                    return Outcome(ACCEPTED, refined, observations.source, bound, work[0], work[1])
                if work[0] >= limit:
                    return Outcome(NOTHING, refined, observations.source, 0.0, work[0], work[1])
    choice = min(n, DRAWN_FROM)
    if choice <= systematic:
        return Outcome(NOTHING, refined, observations.source, 0.0, work[0], work[1])
    state = np.uint64(88172645463325252)
    for _ in range(8 * limit):
        drawn = np.empty(3, dtype=np.int64)
        for corner in range(3):
            state ^= state << np.uint64(13)
            state ^= state >> np.uint64(7)
            state ^= state << np.uint64(17)
            drawn[corner] = int(state % np.uint64(choice))
        if drawn[0] == drawn[1] or drawn[0] == drawn[2] or drawn[1] == drawn[2]:
            continue
        refined, bound, found = _try_triangle(
            index, observations, (drawn[0], drawn[1], drawn[2]), odds, order, settings, work
        )
        if found:
            return Outcome(ACCEPTED, refined, observations.source, bound, work[0], work[1])
        if work[0] >= limit:
            break
    return Outcome(NOTHING, refined, observations.source, 0.0, work[0], work[1])
