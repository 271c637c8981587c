"""Lost in space: triangles of bright detections looked up in the index, each hit tested and refined.

Triangles of the brightest detections are tried first, in order of their faintest member, so that a few false
stars among the brightest only delay the solution. Random triangles from a larger set of detections follow.
Last, for fields with much clutter, each quadrant and the middle of the field are searched separately.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from starid.arithmetic.arrays import Array, Indices, Records
from starid.camera.parameter_array import CX, CY, HEIGHT, MODEL, WIDTH
from starid.identification.geometric.answer import (
    Answer,
    Candidate,
    make_answer,
    new_candidate,
    test_and_refine,
)
from starid.identification.geometric.lookup import find_triangles
from starid.identification.geometric.observation import (
    MAGNITUDE,
    SOURCE,
    Raw,
    Table,
    X,
    Y,
    Z,
    observe,
    scaled,
)
from starid.identification.geometric.pattern_index import (
    DEEP_LONGEST,
    DEEP_SHORTEST,
    SHORTEST_SIDE,
    SIDE_STEP,
    SIDE_STEPS,
    STAR_MAGNITUDE,
    IndexArrays,
    chord,
    handedness,
    sorted_triangle,
)
from starid.identification.geometric.refinement import SCALE, ZERO_POINT
from starid.identification.geometric.settings import ACCEPTED, NOTHING, TOO_FEW, Settings
from starid.identification.geometric.verification import hit_odds, test_order
from starid.kernels.jit import compiled_ieee, inlined, inner
from starid.kernels.small_arrays import zero

SYSTEMATIC: Final = 14
"""Number of detections, brightest first, whose triangles are all tried first."""

TRIANGLE_STARS: Final = 200
"""Number of detections, brightest first, from which random triangles are drawn."""

STRICT_TOLERANCE: Final = 0.5
"""Side tolerance of random triangles relative to the first stage: there are many, so each must be cheap."""

STRICT_GATE: Final = 0.6
"""Magnitude gate of random triangles relative to the first stage."""

PARTS: Final = 5
"""Number of parts of the field: four quadrants and the middle."""

MAX_FOUND: Final = 4096
"""Largest number of index triangles tried for one triangle of detections."""

_SEED: Final = 88172645463325252


@inner
def copy_corner(table: Array, source: int, model: float, scale: float, frame: Table, row: int) -> None:
    """Copy a unit vector, for a focal length divided by `scale`, to a row of a frame."""
    frame[row, 0], frame[row, 1], frame[row, 2] = scaled(
        model, table[source, X], table[source, Y], table[source, Z], scale
    )


@inner
def make_triad(frame: Table) -> None:
    """Replace three unit vectors (rows) by a triad: sum, orthogonalised second − third, cross product."""
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
def set_sensor_triad(
    observed: Table, detections: tuple[int, int, int], model: float, scale: float, frames: Array
) -> None:
    """Fill ``frames[0]`` with the frame of three detections.

    Parameters
    ----------
    model, scale : float
        Camera model, and the divisor of its focal length.
    """
    for row in range(3):
        copy_corner(observed, detections[row], model, scale, frames[0], row)
    make_triad(frames[0])


@inner
def set_rotation(star_table: Array, stars: tuple[int, int, int], frames: Array) -> None:
    """Fill ``frames[2]`` with the ICRS→sensor matrix from three stars to the detections of ``frames[0]``.

    The second and third should be far apart, because they determine the roll. ``frames[1]`` is workspace.
    """
    sensor, sky = frames[0], frames[1]
    for row in range(3):
        for axis in range(3):
            sky[row, axis] = star_table[stars[row], axis]
    make_triad(sky)
    for i in range(3):
        for j in range(3):
            frames[2, i, j] = sensor[0, i] * sky[0, j] + sensor[1, i] * sky[1, j] + sensor[2, i] * sky[2, j]


@inlined
def _try_patterns(
    index: IndexArrays,
    raw: Raw,
    observed: Table,
    settings: Settings,
    candidate: Candidate,
    tests: tuple[Array, Indices],
    corners: tuple[int, int, int],
    longest_side: float,
    patterns: Indices,
    count: int,
    gate: float,
    min_matched: int,
    prior: tuple[float, float],
) -> float:
    """Try the index triangles found for one triangle of detections.

    Returns the bound of the first one accepted, which is left in `candidate`, or 0.
    """
    stars, sides, corner_stars = index.stars, index.sides, index.corners
    frames, numbers = candidate.frames, candidate.numbers
    i, j, k = corners
    spread = settings.scale_tolerance
    mi, mj, mk = observed[i, MAGNITUDE], observed[j, MAGNITUDE], observed[k, MAGNITUDE]
    numbers[SCALE] = 1.0
    framed = False
    for n in range(count):
        pattern = patterns[n]
        a = int(np.int64(index.pattern_stars[corner_stars[pattern, 0]]))
        b = int(np.int64(index.pattern_stars[corner_stars[pattern, 1]]))
        c = int(np.int64(index.pattern_stars[corner_stars[pattern, 2]]))
        da, db, dc = (
            stars[a, STAR_MAGNITUDE] - mi,
            stars[b, STAR_MAGNITUDE] - mj,
            stars[c, STAR_MAGNITUDE] - mk,
        )
        zero_point = (da + db + dc) / 3.0
        if abs(da - zero_point) > gate or abs(db - zero_point) > gate or abs(dc - zero_point) > gate:
            continue
        numbers[ZERO_POINT] = zero_point
        if spread > 0.0:
            numbers[SCALE] = sides[pattern, 0] * index.numbers[SIDE_STEP] / longest_side
        if spread > 0.0 or not framed:
            set_sensor_triad(observed, corners, raw.params[MODEL], numbers[SCALE], frames)
            framed = True
        set_rotation(stars, (a, b, c), frames)
        _, bound = test_and_refine(
            index, raw, observed, settings, candidate, tests, corners, min_matched, prior
        )
        if bound < settings.log_chance:
            return bound
    return 0.0


@inner
def _draw_three(state: np.uint64, choice: int) -> tuple[np.uint64, int, int, int]:
    """Advance a xorshift generator and draw three numbers below `choice` from it (16 bits each)."""
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


@inner
def _worth_looking_up(observed: Table, i: int, j: int, k: int, bounds: tuple[float, float, float]) -> bool:
    """Whether a triangle of detections has sides within the bounds and is not too flat."""
    c0, c1, c2 = chord(observed, j, k), chord(observed, i, k), chord(observed, i, j)
    shortest, longest = min(c0, c1, c2), max(c0, c1, c2)
    return shortest >= bounds[0] and longest <= bounds[1] and c0 + c1 + c2 - 2.0 * longest >= bounds[2]


@inner
def _detections_in_part(raw: Raw, observed: Table, part: int) -> Indices:
    """Detections in one of the `PARTS` of the field, four quadrants and the middle, brightest first."""
    half_width, half_height = 0.25 * raw.params[WIDTH], 0.25 * raw.params[HEIGHT]
    members = np.empty(observed.shape[0], dtype=np.int64)
    count = 0
    for i in range(observed.shape[0]):
        row = int(np.int64(observed[i, SOURCE]))
        u, v = raw.xy[row, 0] - raw.params[CX], raw.xy[row, 1] - raw.params[CY]
        if part == PARTS - 1:
            inside = abs(u) < half_width and abs(v) < half_height
        else:
            inside = (u < 0.0) == (part % 2 == 0) and (v < 0.0) == (part < 2)
        if inside:
            members[count] = i
            count += 1
    return members[:count]


@inner
def _next_triangle(i: int, j: int, k: int) -> tuple[int, int, int]:
    """Next triangle i < j < k in the order (0, 1, 2), (0, 1, 3), (0, 2, 3), (1, 2, 3), (0, 1, 4)."""
    if i + 1 < j:
        return i + 1, j, k
    if j + 1 < k:
        return 0, j + 1, k
    return 0, 1, k + 1


@compiled_ieee
def identify_kernel(
    index: IndexArrays,
    params: Array,
    xy: Array,
    flux: Array,
    sigmas: Array,
    records: Records,
    min_matched: int,
    prior: tuple[float, float],
) -> Answer:
    """Find the attitude of a set of detections without prior knowledge.

    Stage 0 tries the triangles of the brightest detections, stage 1 random triangles of more detections, and
    each further stage the triangles of the brightest detections in one part of the field. In that stage the
    sequential test uses only detections in the part, so that clutter elsewhere does not count; a candidate is
    still refined and verified on the whole field.

    Parameters
    ----------
    records : ndarray (1,) of SETTINGS
    min_matched : int
        Least number of matches for an answer.
    prior : (float, float)
        See `starid.identification.geometric.verification.log_false_probability`.
    """
    raw = Raw(params, xy, flux, sigmas)
    settings: Settings = records[0]
    observed = observe(raw)
    n = observed.shape[0]
    candidate = new_candidate(n)
    odds, order = hit_odds(index, settings.test_window), test_order(n)
    patterns = np.empty(MAX_FOUND, dtype=np.int64)
    spread, limit, numbers = settings.scale_tolerance, settings.max_triangles, index.numbers
    tolerance, gate = settings.search_tolerance, settings.magnitude_gate
    widest = numbers[SIDE_STEP] * SIDE_STEPS / (1.0 - spread)
    bounds = (numbers[SHORTEST_SIDE] / (1.0 + spread), widest, tolerance)
    members, draws, state = np.arange(min(n, SYSTEMATIC)), 0, np.uint64(_SEED)
    stage, i, j, k = 0, 0, 0, 1
    triangles, candidates, bound = zero(), zero(), 0.0
    while n >= min_matched:
        if stage == 1:
            draws += 1
            state, a, b, c = _draw_three(state, min(n, TRIANGLE_STARS))
            over = triangles >= limit or draws > 4 * limit
        else:
            i, j, k = _next_triangle(i, j, k)
            over = k >= members.shape[0] or (stage == 0 and triangles >= limit)
            if not over:
                a, b, c = members[i], members[j], members[k]
        if over:
            stage, i, j, k = stage + 1, 0, 0, 1
            if stage == 1:
                bounds = (
                    numbers[DEEP_SHORTEST] / (1.0 + spread),
                    numbers[DEEP_LONGEST] / (1.0 - spread),
                    tolerance * STRICT_TOLERANCE,
                )
                gate *= STRICT_GATE
            if n <= SYSTEMATIC or stage > 1 + PARTS or (stage > 1 and settings.part_stars < 3):
                break
            if stage > 1:
                members = _detections_in_part(raw, observed, stage - 2)
                order = members[test_order(members.shape[0])]
                members = members[: settings.part_stars]
            continue
        if a in (b, c) or b == c or not _worth_looking_up(observed, a, b, c, bounds):
            continue
        s0, s1, s2, a, b, c = sorted_triangle(
            chord(observed, b, c), chord(observed, a, c), chord(observed, a, b), a, b, c
        )
        hand = handedness(observed, a, b, c)
        count = find_triangles(index, (s0, s1, s2), hand, bounds[2], spread, patterns)
        triangles += 1
        candidates += count
        if count > 0:
            bound = _try_patterns(
                index, raw, observed, settings, candidate, (odds, order), (a, b, c), s0, patterns, count, gate,
                min_matched, prior,
            )  # fmt: skip
            if bound < 0.0:
                break
    status = ACCEPTED if bound < 0.0 else (TOO_FEW if n < min_matched else NOTHING)
    return make_answer(status, observed, candidate, settings, bound, triangles, candidates)
