"""Lost in space: triangles of bright detections looked up in the index, each hit tested and refined.

Detections are taken by falling flux; triangle (i, j, k) is tried after all triangles of brighter stars, so
that few false stars among the brightest delay the answer and many do not prevent it: when the brightest are
exhausted, triangles drawn from a wider choice follow.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from starid.geometric.answer import (
    LEAST_MATCHED,
    Answer,
    Candidate,
    finish,
    judged,
    new_candidate,
)
from starid.geometric.jit_kernels import entry, inner
from starid.geometric.observation import MAGNITUDE, Raw, Table, X, Y, Z, observe, scaled
from starid.geometric.pattern_index import (
    DEEP_LONGEST,
    DEEP_SHORTEST,
    SHORTEST_SIDE,
    SIDE_BINS,
    SIDE_STEP,
    SIDE_STEPS,
    STAR_MAGNITUDE,
    IndexArrays,
    chord,
    handedness,
    sorted_triangle,
)
from starid.geometric.refinement import SCALE, ZERO_POINT
from starid.geometric.settings import (
    ACCEPTED,
    LOG_CHANCE,
    MAGNITUDE_GATE,
    MAX_TRIANGLES,
    NOTHING,
    SCALE_TOLERANCE,
    SEARCH_TOLERANCE,
    TEST_WINDOW,
    TOO_FEW,
)
from starid.geometric.verification import ROTATIONS, hit_odds, test_order
from starid.projection import MODEL

SYSTEMATIC: Final = 14
"""Brightest detections of which every triangle is tried first."""

DRAWN_FROM: Final = 120
"""Brightest detections from which further triangles are drawn."""

DRAWN_TOLERANCE: Final = 0.5
"""Tolerance of their sides as a share of that of the first: they are many, and each must be cheap."""

MOST_FOUND: Final = 4096
"""Triangles of the index tried for one of detections."""

_SEED: Final = 88172645463325252


@inner
def copy_corner(
    table: NDArray[np.float64], source: int, model: float, scale: float, frame: Table, row: int
) -> None:
    """Copy a unit vector to a row of a frame, as seen with the focal length divided by `scale`."""
    frame[row, 0], frame[row, 1], frame[row, 2] = scaled(
        model, table[source, X], table[source, Y], table[source, Z], scale
    )


@inner
def make_frame(frame: Table) -> None:
    """Turn three unit vectors (rows) into an orthonormal frame: sum, second − third made normal to it, normal."""
    along, square_sum, square_side = 0.0, 0.0, 0.0
    for axis in range(3):
        total = frame[0, axis] + frame[1, axis] + frame[2, axis]
        frame[1, axis] = frame[1, axis] - frame[2, axis]
        frame[0, axis] = total
        square_sum += total * total
        along += total * frame[1, axis]
    for axis in range(3):
        frame[1, axis] -= along / square_sum * frame[0, axis]
        square_side += frame[1, axis] * frame[1, axis]
    long, side = 1.0 / math.sqrt(square_sum), 1.0 / math.sqrt(square_side)
    for axis in range(3):
        frame[0, axis] *= long
        frame[1, axis] *= side
    frame[2, 0] = frame[0, 1] * frame[1, 2] - frame[0, 2] * frame[1, 1]
    frame[2, 1] = frame[0, 2] * frame[1, 0] - frame[0, 0] * frame[1, 2]
    frame[2, 2] = frame[0, 0] * frame[1, 1] - frame[0, 1] * frame[1, 0]


@inner
def set_rotation(
    given: Table,
    detections: tuple[int, int, int],
    model: float,
    scale: float,
    star_table: NDArray[np.float64],
    stars: tuple[int, int, int],
    frames: NDArray[np.float64],
) -> None:
    """Fill ``frames[2]`` with the ICRS→sensor matrix that carries three stars into three detections.

    The second and the third should be far apart: they give the roll.

    Parameters
    ----------
    model, scale : float
        Model of the camera, and by what its focal length is to be divided.
    frames : ndarray (3, 3, 3)
        The other two are workspace: the frame of the detections, and that of the stars.
    """
    sensor, sky = frames[0], frames[1]
    for row in range(3):
        copy_corner(given, detections[row], model, scale, sensor, row)
        copy_corner(star_table, stars[row], model, 1.0, sky, row)
    make_frame(sensor)
    make_frame(sky)
    for i in range(3):
        for j in range(3):
            frames[2, i, j] = sensor[0, i] * sky[0, j] + sensor[1, i] * sky[1, j] + sensor[2, i] * sky[2, j]


@inner
def _look_up(
    patterns: NDArray[np.uint16],
    bin_start: NDArray[np.int32],
    numbers: NDArray[np.float64],
    triangle: tuple[float, float, float],
    hand: int,
    tolerance: float,
    spread: float,
    found: NDArray[np.int64],
) -> int:
    """Fill in the index's triangles with the given sides, longest first; return how many.

    With a `spread` the sides may all be longer or shorter by one factor within 1 ± spread.
    """
    s0, s1, s2 = triangle
    bins, step = int(numbers[SIDE_BINS]), numbers[SIDE_STEP]
    longest = step * SIDE_STEPS
    per_side = bins / longest
    low0, high0 = s0 * (1.0 - spread) - tolerance, min(s0 * (1.0 + spread) + tolerance, longest)
    first_bin = max(int(low0 * per_side), 0)
    last_bin = min(int(high0 * per_side), bins - 1)
    ratio_low, ratio_high, scale = 1.0, 1.0, 1.0
    count = 0
    for bin0 in range(first_bin, last_bin + 1):
        if spread > 0.0:
            ratio_low = max(bin0 / per_side - tolerance, low0) / s0
            ratio_high = min((bin0 + 1) / per_side + tolerance, high0) / s0
        low1 = max(int((s1 * ratio_low - tolerance) * per_side), 0)
        high1 = min(int((s1 * ratio_high + tolerance) * per_side), bins - 1)
        low2 = max(int((s2 * ratio_low - tolerance) * per_side), 0)
        high2 = min(int((s2 * ratio_high + tolerance) * per_side), bins - 1)
        for bin1 in range(low1, high1 + 1):
            row = ((hand * bins + bin0) * bins + bin1) * bins
            for pattern in range(bin_start[row + low2], bin_start[row + high2 + 1]):
                p0 = patterns[pattern, 0] * step
                if p0 < low0 or p0 > high0:
                    continue
                if spread > 0.0:
                    scale = p0 / s0
                if abs(patterns[pattern, 1] * step - s1 * scale) > tolerance:
                    continue
                if abs(patterns[pattern, 2] * step - s2 * scale) > tolerance:
                    continue
                found[count] = pattern
                count += 1
                if count == found.shape[0]:
                    return count
    return count


@inner
def _try_patterns(
    index: IndexArrays,
    raw: Raw,
    given: Table,
    settings: NDArray[np.float64],
    candidate: Candidate,
    tests: tuple[NDArray[np.float64], NDArray[np.int64]],
    corners: tuple[int, int, int],
    longest_side: float,
    found: NDArray[np.int64],
    count: int,
) -> float:
    """Try the index's triangles found for one of detections.

    Returns the bound of the first that stands, left in `candidate`, or 0.
    """
    stars, patterns, pattern_stars = index.stars, index.patterns, index.pattern_stars
    frames, numbers = candidate.frames, candidate.numbers
    i, j, k = corners
    spread, gate = settings[SCALE_TOLERANCE], settings[MAGNITUDE_GATE]
    mi, mj, mk = given[i, MAGNITUDE], given[j, MAGNITUDE], given[k, MAGNITUDE]
    for n in range(count):
        pattern = found[n]
        a = int(np.int64(pattern_stars[patterns[pattern, 3]]))
        b = int(np.int64(pattern_stars[patterns[pattern, 4]]))
        c = int(np.int64(pattern_stars[patterns[pattern, 5]]))
        da, db, dc = (
            stars[a, STAR_MAGNITUDE] - mi,
            stars[b, STAR_MAGNITUDE] - mj,
            stars[c, STAR_MAGNITUDE] - mk,
        )
        zero_point = (da + db + dc) / 3.0
        if abs(da - zero_point) > gate or abs(db - zero_point) > gate or abs(dc - zero_point) > gate:
            continue
        numbers[ZERO_POINT], numbers[SCALE] = zero_point, 1.0
        if spread > 0.0:
            numbers[SCALE] = patterns[pattern, 0] * index.numbers[SIDE_STEP] / longest_side
        set_rotation(given, corners, raw.params[MODEL], numbers[SCALE], stars, (a, b, c), frames)
        _, bound = judged(index, raw, given, settings, candidate, tests, corners, ROTATIONS)
        if bound < settings[LOG_CHANCE]:
            return bound
    return 0.0


@inner
def chord_table(given: Table, count: int) -> NDArray[np.float64]:
    """Chords (count, count) between the first detections."""
    table = np.zeros((count, count))
    for i in range(count):
        for j in range(i):
            table[i, j] = chord(given, i, j)
            table[j, i] = table[i, j]
    return table


@inner
def _next_triangle(i: int, j: int, k: int) -> tuple[int, int, int]:
    """Next of the triangles i < j < k in the order (0, 1, 2), (0, 1, 3), (0, 2, 3), (1, 2, 3), (0, 1, 4)."""
    if i + 1 < j:
        return i + 1, j, k
    if j + 1 < k:
        return 0, j + 1, k
    return 0, 1, k + 1


@inner
def _drawn(state: np.uint64, choice: int) -> tuple[np.uint64, int, int, int]:
    """Step of a xorshift generator, and three numbers below `choice` from it (16 bits each)."""
    state ^= state << np.uint64(13)
    state ^= state >> np.uint64(7)
    state ^= state << np.uint64(17)
    mask, bits = np.uint64(0xFFFF), np.uint64(16)
    return (
        state,
        int(np.int64(((state & mask) * np.uint64(choice)) >> bits)),
        int(np.int64(((state >> bits) & mask) * np.uint64(choice)) >> bits),
        int(np.int64((((state >> np.uint64(32)) & mask) * np.uint64(choice)) >> bits)),
    )


@entry
def identify_kernel(
    index: IndexArrays,
    params: NDArray[np.float64],
    xy: NDArray[np.float64],
    flux: NDArray[np.float64],
    sigmas: NDArray[np.float64],
    settings: NDArray[np.float64],
) -> Answer:
    """Find the attitude of a set of detections without knowing anything of it."""
    raw = Raw(params, xy, flux, sigmas)
    given = observe(raw)
    n = given.shape[0]
    candidate = new_candidate(n)
    tests = (hit_odds(index, settings[TEST_WINDOW]), test_order(n))
    found = np.empty(MOST_FOUND, dtype=np.int64)
    spread, tolerance = settings[SCALE_TOLERANCE], settings[SEARCH_TOLERANCE]
    shortest = index.numbers[SHORTEST_SIDE] / (1.0 + spread)
    longest = index.numbers[SIDE_STEP] * SIDE_STEPS / (1.0 - spread)
    limit = int(settings[MAX_TRIANGLES])
    systematic, choice = min(n, SYSTEMATIC), min(n, DRAWN_FROM)
    chords = chord_table(given, systematic)
    i, j, k = 0, 0, 1
    drawing = False
    state = np.uint64(_SEED)
    triangles, candidates = 0, 0
    status, bound = NOTHING, 0.0
    if n < LEAST_MATCHED:
        status, limit = TOO_FEW, 0
    for _ in range(4 * limit):
        if not drawing:
            i, j, k = _next_triangle(i, j, k)
            if k == systematic:
                if choice <= systematic:
                    break
                drawing = True
                tolerance *= DRAWN_TOLERANCE
                shortest = index.numbers[DEEP_SHORTEST] / (1.0 + spread)
                longest = index.numbers[DEEP_LONGEST] / (1.0 - spread)
                chords = chord_table(given, choice)
        if drawing:
            state, i, j, k = _drawn(state, choice)
            if i in (j, k) or j == k:
                continue
        s0, s1, s2, a, b, c = sorted_triangle(chords[j, k], chords[i, k], chords[i, j], i, j, k)
        if s2 < shortest or s0 > longest or s1 + s2 - s0 < tolerance:
            continue
        triangles += 1
        hand = handedness(given, a, b, c)
        count = _look_up(
            index.patterns, index.bin_start, index.numbers, (s0, s1, s2), hand, tolerance, spread, found
        )
        if count > 0:
            candidates += count
            bound = _try_patterns(index, raw, given, settings, candidate, tests, (a, b, c), s0, found, count)
            if bound < 0.0:
                status = ACCEPTED
                break
        if triangles >= limit:
            break
    return finish(status, given, candidate, settings, bound, triangles, candidates)
