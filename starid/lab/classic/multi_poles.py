"""MP, the multi-poles algorithm.

V. Schiattarella, D. Spiller, F. Curti, "A novel star identification technique robust to high presence of false
objects: The Multi-Poles Algorithm", Advances in Space Research 59(8), 2133–2147, 2017. Abstract: in fields of 20°
with 1024 px, 100 % with up to six false objects for each catalogue star in the image, 66 % with fifteen.

An observed star is the pole. The k-vector gives the catalogue pairs for its distance to every other star; the
catalogue star that occurs for most of them is its identity, and the partners of that star are accepted as the
identities of the others. What is accepted with one pole is verified by cross-checking it with the stars accepted with
another. The distances between the verified stars confirm them.

own choice: every observed star is a pole, and up to ten identities, those with the most votes, are tried for each:
among hundreds of false objects the true one has not always the most. A match needs the acceptance of two poles; of
the matches of one star, those accepted by the most poles are kept.
own choice: the confirmation is the agreement of all distances, as for all algorithms here, of four stars at least.
"""

from __future__ import annotations

from typing import ClassVar, Final

import numpy as np

from starid.arithmetic.arrays import Array, Indices
from starid.kernels.jit import compiled_ieee
from starid.lab.classic.neighbours import MAX_TIED, add_winners
from starid.lab.classic.pairs import PairTable, pair_table, pole_partners
from starid.lab.classic.solver import ClassicIdentifier, Database, Observed

IDENTITIES: Final = 10
"""Number of identities tried for a pole."""

MIN_ACCEPTED: Final = 3
"""Least number of stars whose distances to a pole its identity explains."""

MIN_POLES: Final = 2
"""Least number of poles with which a match is accepted."""


@compiled_ieee
def _verified(table: PairTable, stars: int, directions: Array, tolerance: float) -> Indices:
    """Matches (m, 2) that the most poles accept, at least `MIN_POLES`."""
    n = directions.shape[0]
    partners = [(0, 0, 0)]
    votes, accepted = np.empty(stars, dtype=np.int64), np.zeros((n, stars), dtype=np.int32)
    for pole in range(n):
        pole_partners(table, directions, pole, tolerance, partners, votes)
        for _ in range(IDENTITIES):
            identity = int(np.argmax(votes))
            if votes[identity] < MIN_ACCEPTED:
                break
            votes[identity] = 0
            accepted[pole, identity] += 1
            for candidate, other, star in partners:
                if candidate == identity:
                    accepted[other, star] += 1
    matches = np.empty((n * MAX_TIED, 2), dtype=np.int64)
    filled = 0
    for star in range(n):
        filled = add_winners(accepted[star], MIN_POLES, star, matches, filled)
    return matches[:filled]


class MultiPolesIdentifier(ClassicIdentifier):
    """The multi-poles algorithm behind the common interface of all identifiers."""

    sigmas: ClassVar[float] = 2.0
    tolerance_px: ClassVar[float] = 2.0
    stars_per_field: ClassVar[float] = 15.0
    clutter: ClassVar[float] = 16.0
    min_group: ClassVar[int] = 4
    min_stars: ClassVar[int] = 4

    def _build(self) -> Database:
        self.pairs = pair_table(self.guide.vectors, self.longest_chord)
        return tuple(self.pairs)

    def _match(self, observed: Observed) -> Indices:
        return _verified(self.pairs, len(self.guide), observed.directions, observed.tolerance)
