"""Motion between two frames whose objects are not yet matched: pairs of objects propose motions, which are scored."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from starid.arithmetic.arrays import Array, Indices
from starid.arithmetic.elementary import atan2, cos, sin, square
from starid.kernels.jit import compiled, inner_checked

MAX_VOTERS: Final = 48
"""Largest number of objects per frame whose pairs vote."""

_MAX_COUPLES: Final = 40_000
_MAX_HYPOTHESES: Final = 300
_MATCH_SHARE: Final = 0.45
_GATE: Final = 4.5
_MIN_PAIR: Final = 15.0


@compiled
def nearest_objects(
    positions: Array,
    brightness: Array,
    predicted: Array,
    predicted_brightness: Array,
    position_variance: Array,
    brightness_sigma: float,
    gate: float,
    partner: Indices,
) -> int:
    """Match predictions and objects that are mutual nearest neighbours within the gate; return their number.

    The distance is (Δx² + Δy²)/variance + (Δm)²/(2σ_m²); `gate` is its largest value. `partner` (n,) receives
    the object of each prediction, or −1.
    """
    n, m = predicted.shape[0], positions.shape[0]
    best_of_object = np.full(m, math.inf)
    owner = np.full(m, -1, dtype=np.int64)
    weight = 1.0 / (2.0 * brightness_sigma * brightness_sigma)
    for i in range(n):
        partner[i] = -1
        best = gate
        reach2 = gate * position_variance[i]
        for j in range(m):
            dx = positions[j, 0] - predicted[i, 0]
            square = dx * dx
            if square > reach2:
                continue
            dy = positions[j, 1] - predicted[i, 1]
            dm = brightness[j] - predicted_brightness[i]
            distance = (square + dy * dy) / position_variance[i] + dm * dm * weight
            if distance < best:
                best = distance
                partner[i] = j
            if distance < best_of_object[j]:
                best_of_object[j] = distance
                owner[j] = i
    count = 0
    for i in range(n):
        if partner[i] >= 0:
            if owner[partner[i]] == i:
                count += 1
            else:
                partner[i] = -1
    return count


@inner_checked
def _pairs(
    positions: Array, brightness: Array, least: float, separation: Array, slope: Array, members: Indices
) -> int:
    """Compute the separations and directions of all pairs, brighter object first; return their number."""
    k = 0
    for i in range(positions.shape[0]):
        for j in range(i + 1, positions.shape[0]):
            first, second = (i, j) if brightness[i] <= brightness[j] else (j, i)
            dx = positions[second, 0] - positions[first, 0]
            dy = positions[second, 1] - positions[first, 1]
            length = math.sqrt(dx * dx + dy * dy)
            if length >= least:
                separation[k] = length
                slope[k] = atan2(dy, dx)
                members[k, 0] = first
                members[k, 1] = second
                k += 1
    return k


@inner_checked
def _score(
    before: Array,
    brightness_before: Array,
    now: Array,
    brightness_now: Array,
    motion: Array,
    gate2: float,
    faint: float,
) -> float:
    """Number of objects that a motion explains, minus a small penalty for the residuals."""
    total = 0.0
    for i in range(before.shape[0]):
        x = motion[0] * before[i, 0] - motion[1] * before[i, 1] + motion[2]
        y = motion[1] * before[i, 0] + motion[0] * before[i, 1] + motion[3]
        best = gate2
        for j in range(now.shape[0]):
            dx = now[j, 0] - x
            dy = now[j, 1] - y
            square = dx * dx + dy * dy
            if square < best and abs(brightness_before[i] - brightness_now[j]) <= faint:
                best = square
        total += 1.0 - best / gate2
    return total


@inner_checked
def _pair_hypotheses(
    first: tuple[Array, Array, Indices],
    second: tuple[Array, Array, Indices],
    counts: tuple[int, int],
    brightness_before: Array,
    brightness_now: Array,
    tolerance: float,
    faint: float,
    max_rotation: float,
    couples: Indices,
) -> int:
    """List pairs of pairs similar in separation, brightness and direction, longest first."""
    order1 = np.argsort(-first[0][: counts[0]])
    order2 = np.argsort(second[0][: counts[1]])
    lengths = second[0][order2]
    count = 0
    for k in order1:
        at = np.searchsorted(lengths, first[0][k] - tolerance)
        while at < counts[1] and lengths[at] <= first[0][k] + tolerance:
            j = order2[at]
            at += 1
            turn = second[1][j] - first[1][k]
            turn -= 2.0 * math.pi * round(turn / (2.0 * math.pi))
            if abs(turn) > max_rotation:
                continue
            alike = True
            for end in range(2):
                gap = brightness_before[first[2][k, end]] - brightness_now[second[2][j, end]]
                alike = alike and abs(gap) <= faint
            if alike:
                couples[count, 0] = k
                couples[count, 1] = j
                count += 1
                if count == couples.shape[0]:
                    return count
    return count


@compiled
def find_motion(
    before: Array,
    brightness_before: Array,
    now: Array,
    brightness_now: Array,
    sigma: float,
    brightness_sigma: float,
    max_rotation: float,
    max_shift: float,
    motion: Array,
) -> float:
    """Find the rigid motion that explains most objects; return its score, about the number of objects.

    Parameters
    ----------
    before, now
        Positions of at most `MAX_VOTERS` objects in each frame, degrees; their magnitudes are separate.
    sigma, brightness_sigma
        One-sigma errors of a position per axis (degrees) and of a magnitude.
    max_rotation, max_shift
        Largest rotation in radians, and largest shift per axis in degrees.
    motion
        In: a first guess; out: cosine, sine, shift x, shift y.
    """
    gate2 = square(_GATE * sigma)
    faint = _GATE * brightness_sigma
    best = _score(before, brightness_before, now, brightness_now, motion, gate2, faint)
    sizes = (MAX_VOTERS * MAX_VOTERS, MAX_VOTERS * MAX_VOTERS)
    first = (np.empty(sizes[0]), np.empty(sizes[0]), np.empty((sizes[0], 2), dtype=np.int64))
    second = (np.empty(sizes[1]), np.empty(sizes[1]), np.empty((sizes[1], 2), dtype=np.int64))
    least = max(_MIN_PAIR * sigma, 0.05)
    counts = (
        _pairs(before, brightness_before, least, first[0], first[1], first[2]),
        _pairs(now, brightness_now, least, second[0], second[1], second[2]),
    )
    couples = np.empty((_MAX_COUPLES, 2), dtype=np.int64)
    couple_count = _pair_hypotheses(
        first, second, counts, brightness_before, brightness_now, _GATE * sigma, faint, max_rotation, couples
    )
    trial = np.empty(4)
    stride = max(couple_count / _MAX_HYPOTHESES, 1.0)
    enough = _MATCH_SHARE * min(before.shape[0], now.shape[0])
    for h in range(min(couple_count, _MAX_HYPOTHESES)):
        couple = couples[int(h * stride)]
        a, b = first[2][couple[0], 0], first[2][couple[0], 1]
        c, d = second[2][couple[1], 0], second[2][couple[1], 1]
        turn = second[1][couple[1]] - first[1][couple[0]]
        trial[0] = cos(turn)
        trial[1] = sin(turn)
        mx, my = 0.5 * (before[a, 0] + before[b, 0]), 0.5 * (before[a, 1] + before[b, 1])
        trial[2] = 0.5 * (now[c, 0] + now[d, 0]) - trial[0] * mx + trial[1] * my
        trial[3] = 0.5 * (now[c, 1] + now[d, 1]) - trial[1] * mx - trial[0] * my
        if abs(trial[2]) > max_shift or abs(trial[3]) > max_shift:
            continue
        score = _score(before, brightness_before, now, brightness_now, trial, gate2, faint)
        if score > best:
            best = score
            motion[:] = trial
            if best >= enough:
                break
    return best
