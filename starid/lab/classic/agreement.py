"""The largest group of proposed matches whose mutual distances agree with the catalogue.

Most published algorithms end by checking that the matched stars belong together: that they lie in one field,
or that they are the right distances apart. The second check, which works for every sensor, is here.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from starid.arithmetic.arrays import Array, Indices
from starid.attitude.wahba import solve_wahba
from starid.errors import StaridError
from starid.kernels.jit import compiled_ieee, inner
from starid.lab.classic.pairs import chord_between

MIN_GROUP: Final = 3
"""Smallest group that is accepted: chance produces any number of pairs."""


@inner
def compatible(directions: Array, vectors: Array, pairs: Indices, a: int, b: int, tolerance: float) -> bool:
    """Whether two matches are of different stars, at the distance that the catalogue has."""
    if pairs[a, 0] == pairs[b, 0] or pairs[a, 1] == pairs[b, 1]:
        return False
    seen = chord_between(directions, pairs[a, 0], directions, pairs[b, 0])
    return abs(seen - chord_between(vectors, pairs[a, 1], vectors, pairs[b, 1])) <= tolerance


@inner
def group_around(
    directions: Array, vectors: Array, pairs: Indices, seed: int, tolerance: float, members: Indices
) -> int:
    """Collect the matches that agree with `seed` and with each other; return their number.

    Those that agree with the most others come first; their rows are written to `members` (m,).
    """
    n, most = pairs.shape[0], 0
    support = np.zeros(n, dtype=np.int64)
    with_seed = np.zeros(n, dtype=np.bool_)
    for i in range(n):
        with_seed[i] = compatible(directions, vectors, pairs, seed, i, tolerance)
    for i in range(n):
        if with_seed[i]:
            for j in range(n):
                if with_seed[j] and compatible(directions, vectors, pairs, i, j, tolerance):
                    support[i] += 1
        most = max(most, support[i])
    members[0] = seed
    count = 1
    for number in range(most, -1, -1):
        for i in range(n):
            if not with_seed[i] or support[i] != number:
                continue
            good = True
            for k in range(1, count):
                if not compatible(directions, vectors, pairs, i, members[k], tolerance):
                    good = False
                    break
            if good:
                members[count] = i
                count += 1
    return count


@compiled_ieee
def _largest_group(directions: Array, vectors: Array, pairs: Indices, tolerance: float) -> Indices:
    """Rows of the largest group over all seeds; of equal ones, the first."""
    members, best = np.empty(pairs.shape[0], dtype=np.int64), np.empty(0, dtype=np.int64)
    for seed in range(pairs.shape[0]):
        count = group_around(directions, vectors, pairs, seed, tolerance, members)
        if count > best.shape[0]:
            best = members[:count].copy()
    return best


def largest_group(directions: Array, vectors: Array, pairs: Indices, tolerance: float) -> Indices:
    """Find the largest group of matches that all agree with each other in distance.

    Parameters
    ----------
    directions : ndarray (n, 3)
        Observed unit vectors in the sensor frame.
    vectors : ndarray (N, 3)
        Unit vectors of the guide stars.
    pairs : ndarray (m, 2)
        Proposed matches: row of an observed star, row of a guide star; a star may occur in several.
    tolerance : float
        Largest difference of two chords.

    Returns
    -------
    ndarray (k, 2)
        The group; empty if it has fewer than `MIN_GROUP` members or is a mirror image of the sky.
    """
    none = np.empty((0, 2), dtype=np.int64)
    if len(pairs) < MIN_GROUP:
        return none
    unique = np.unique(pairs, axis=0)
    group = unique[_largest_group(directions, vectors, unique, tolerance)]
    if len(group) < MIN_GROUP or not _is_not_mirrored(directions, vectors, group, tolerance):
        return none
    return group[np.argsort(group[:, 0])]


def _is_not_mirrored(directions: Array, vectors: Array, group: Indices, tolerance: float) -> bool:
    """Whether the group is not a mirror image: a rotation brings its stars onto the observed ones."""
    seen, stars = directions[group[:, 0]], vectors[group[:, 1]]
    try:
        residual = solve_wahba(seen, stars).to_sensor(stars) - seen
    except StaridError:  # collinear stars
        return False
    return bool(np.median(np.linalg.norm(residual, axis=1)) <= tolerance)
