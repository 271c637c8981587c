"""From a coarse boresight to matched stars: the stars vote for the roll and are then paired.

A cell of the database gives the boresight to within half a cell, and no reliable roll. The distance of a star
from the centre does not depend on roll, so every pair of an observed and a catalogue star with similar
distance and brightness votes for the roll between them. The true cell has a peak.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from starid.arithmetic.arrays import Array, Indices
from starid.arithmetic.elementary import atan2, cos, hypot, sin, square
from starid.identification.thesis.frame_sky import SkyArrays, stars_near
from starid.kernels.jit import compiled, inner_checked

MAX_STARS: Final = 256
"""Largest number of catalogue stars considered per cell."""

ROLL_BINS: Final = 180
"""Number of bins, 2° wide, for the votes for the roll."""

_REFITS: Final = 4
_INNERMOST: Final = 4.0


@inner_checked
def vote_roll(
    observed: Array,
    polar: Array,
    near: Array,
    count: int,
    offset_px: float,
    magnitude_gate: float,
    votes: Array,
) -> tuple[float, float]:
    """Find the rotation from catalogue to image with the most votes, radians; return it and its votes.

    Parameters
    ----------
    observed, polar
        Observed stars: x, y, magnitude (n, 3), and distance and angle from the centre (n, 2).
    near, count
        Catalogue stars with north up, from `stars_near`.
    offset_px
        Largest error of the boresight, pixels.
    magnitude_gate
        Largest difference of magnitudes.
    votes
        Workspace (`ROLL_BINS`,).
    """
    votes[:] = 0.0
    width = 2.0 * math.pi / ROLL_BINS
    for j in range(count):
        r = math.sqrt(square(near[j, 0]) + square(near[j, 1]))
        angle = atan2(near[j, 1], near[j, 0])
        for i in range(observed.shape[0]):
            if abs(polar[i, 0] - r) > offset_px or polar[i, 0] < _INNERMOST * offset_px:
                continue
            if abs(observed[i, 2] - near[j, 2]) > magnitude_gate:
                continue
            bin_of = math.floor((polar[i, 1] - angle) / width) % ROLL_BINS
            votes[bin_of] += 1.0
    best = -1.0
    peak = 0
    for b in range(ROLL_BINS):
        total = votes[b - 1] + votes[b] + votes[(b + 1) % ROLL_BINS]
        if total > best:
            best = total
            peak = b
    shift = votes[(peak + 1) % ROLL_BINS] - votes[peak - 1]
    turn = (peak + 0.5 + shift / max(best, 1.0)) * width
    return turn, best


@inner_checked
def pair_stars(
    observed: Array,
    near: Array,
    count: int,
    turn: float,
    tolerance_px: float,
    magnitude_gate: float,
    pairs: Indices,
) -> int:
    """Pair observed and catalogue stars, refitting rotation and shift; return the number of pairs.

    `pairs` (n, 2) receives the observed star and the index in `near`.
    """
    c, s, x, y = cos(turn), sin(turn), 0.0, 0.0
    pair_count = 0
    tolerance = tolerance_px
    for _ in range(_REFITS):
        pair_count = 0
        sums = np.zeros(4)
        along = 0.0
        across = 0.0
        for i in range(observed.shape[0]):
            best = tolerance * tolerance
            partner = -1
            for j in range(count):
                if abs(observed[i, 2] - near[j, 2]) > magnitude_gate:
                    continue
                dx = c * near[j, 0] - s * near[j, 1] + x - observed[i, 0]
                dy = s * near[j, 0] + c * near[j, 1] + y - observed[i, 1]
                square = dx * dx + dy * dy
                if square < best:
                    best = square
                    partner = j
            if partner >= 0:
                pairs[pair_count, 0] = i
                pairs[pair_count, 1] = partner
                sums[0] += near[partner, 0]
                sums[1] += near[partner, 1]
                sums[2] += observed[i, 0]
                sums[3] += observed[i, 1]
                pair_count += 1
        if pair_count < 3:
            return pair_count
        sums /= pair_count
        for k in range(pair_count):
            u = near[pairs[k, 1], 0] - sums[0]
            v = near[pairs[k, 1], 1] - sums[1]
            p = observed[pairs[k, 0], 0] - sums[2]
            q = observed[pairs[k, 0], 1] - sums[3]
            along += u * p + v * q
            across += u * q - v * p
        length = hypot(along, across)
        if length <= 0.0:
            return 0
        c, s = along / length, across / length
        x = sums[2] - c * sums[0] + s * sums[1]
        y = sums[3] - s * sums[0] - c * sums[1]
        tolerance = max(0.55 * tolerance, 0.15 * tolerance_px)
    return pair_count


@compiled
def next_candidate(
    sky: SkyArrays,
    observed: Array,
    candidates: Array,
    start: int,
    settings: Array,
    matched: Indices,
) -> tuple[int, int]:
    """Find the next candidate, from `start` on, with enough votes; return its index or −1, and its pairs.

    Parameters
    ----------
    sky
        Stars of a spherical database.
    observed
        x, y in pixels and magnitude of the observed stars, (n, 3).
    candidates
        Right ascension and declination, degrees, (k, 2).
    settings
        Largest error of a boresight in pixels, largest difference of magnitudes, and the share and the number
        of stars that must vote for one rotation.
    matched
        Output (n, 2): observed star, and row in the table of stars.
    """
    n = observed.shape[0]
    polar = np.empty((n, 2))
    for i in range(n):
        polar[i, 0] = math.sqrt(square(observed[i, 0]) + square(observed[i, 1]))
        polar[i, 1] = atan2(observed[i, 1], observed[i, 0])
    near = np.empty((MAX_STARS, 3))
    rows = np.empty(MAX_STARS, dtype=np.int64)
    votes = np.empty(ROLL_BINS)
    offset, gate, share, fewest = settings[0], settings[1], settings[2], settings[3]
    for place in range(start, candidates.shape[0]):
        count = stars_near(sky, candidates[place, 0], candidates[place, 1], offset, near, rows)
        need = max(fewest, share * min(n, count))
        if min(n, count) < fewest:
            continue
        turn, best = vote_roll(observed, polar, near, count, offset, gate, votes)
        if best < need:
            continue
        pair_count = pair_stars(observed, near, count, turn, 2.5 * offset, gate, matched)
        if pair_count >= need:
            for k in range(pair_count):
                matched[k, 1] = rows[matched[k, 1]]
            return place, pair_count
    return -1, 0
