"""The radial pattern of the pole star and the radial and cyclic algorithms: rings that hold a neighbour.

The distances from a star to its neighbours, quantised into rings, form a binary vector that does not change
under rotation. A lookup table leads from each ring to the guide stars with a neighbour in it; each ring is a
vote.

own choice: 200 rings from the buffer to the pattern radius, half the width of the field (2.2 px of 937 each).
own choice: an observed neighbour has two votes for its own ring and one for each ring beside it, where noise may have
carried it; each guide star gets its votes once.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from starid.arithmetic.arrays import Array, Indices32
from starid.kernels.jit import compiled_ieee, inner
from starid.lab.classic.neighbours import grouped, neighbours_of

RINGS: Final = 200
INNER: Final = 0.05
"""Inner end of the rings as a share of the pattern radius."""

RADIUS_SHARE: Final = 0.5
"""Pattern radius as a share of the width of the field."""

MAX_NEIGHBOURS: Final = 400


@inner
def ring_of(chord: float, radius: float) -> int:
    """Ring of a distance, −1 inside the innermost one."""
    share = (chord / radius - INNER) / (1.0 - INNER)
    return min(int(share * RINGS), RINGS - 1) if share >= 0.0 else -1


@compiled_ieee
def ring_table(vectors: Array, radius: float) -> tuple[Indices32, NDArray[np.uint16]]:
    """Lookup table: first entry of each ring, and the stars that have a neighbour in it, each once."""
    polar, rows = np.empty((MAX_NEIGHBOURS, 2)), np.empty(MAX_NEIGHBOURS, dtype=np.int64)
    rings, stars = [np.int64(0) for _ in range(0)], [np.int64(0) for _ in range(0)]
    for star in range(vectors.shape[0]):
        last = -1
        for i in range(neighbours_of(vectors, star, radius, polar, rows)):
            ring = ring_of(polar[i, 0], radius)
            if ring > last:
                rings.append(np.int64(ring))
                stars.append(np.int64(star))
                last = ring
    keys, owners = np.array(rings), np.array(stars)
    start, order = grouped(keys, RINGS)
    return start, owners[order].astype(np.uint16)


@inner
def radial_votes(
    table: tuple[Indices32, NDArray[np.uint16]], polar: Array, count: int, radius: float, votes: Indices32
) -> None:
    """Count the votes of an observed star's neighbours for each guide star: two for their own ring, one beside it."""
    start, owner = table
    votes[:] = 0
    voter = np.full(votes.shape[0], -1, dtype=np.int64)
    for i in range(count):
        ring = ring_of(polar[i, 0], radius)
        for beside in (0, -1, 1):
            if ring < 0 or not 0 <= ring + beside < RINGS:
                continue
            for place in range(start[ring + beside], start[ring + beside + 1]):
                if voter[owner[place]] != i:
                    votes[owner[place]] += 2 if beside == 0 else 1
                    voter[owner[place]] = i
