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

from starid.arrays import Array, Indices, Indices32
from starid.jit import compiled_ieee, inner
from starid.lab.classic.neighbours import MAX_TIED, add_winners
from starid.lab.classic.pairs import PairTable, chord_between, pair_range, pair_table
from starid.lab.classic.solver import ClassicIdentifier, Database, Observed

IDENTITIES: Final = 10
"""Number of identities tried for a pole."""

MIN_ACCEPTED: Final = 3
"""Least number of stars whose distances to a pole its identity explains."""

MIN_POLES: Final = 2
"""Least number of poles with which a match is accepted."""


@inner
def pole_votes(table: PairTable, seen: Array, pole: int, tolerance: float, votes: Indices32) -> None:
    """Count, for each catalogue star, the observed stars that have a partner of it at their distance to the pole."""
    votes[:] = 0
    voter = np.full(votes.shape[0], -1, dtype=np.int64)
    for other in range(seen.shape[0]):
        if other == pole:
            continue
        distance = chord_between(seen, pole, seen, other)
        start, end = pair_range(table, distance - tolerance, distance + tolerance)
        for pair in range(start, end):
            for star in (table.first[pair], table.second[pair]):
                if voter[star] != other:
                    votes[star] += 1
                    voter[star] = other


@inner
def accept(
    table: PairTable, seen: Array, pole: int, identity: int, tolerance: float, accepted: Indices32
) -> None:
    """Count a pole with this identity among the poles (n, N) that accept each match."""
    accepted[pole, identity] += 1
    for other in range(seen.shape[0]):
        if other == pole:
            continue
        distance = chord_between(seen, pole, seen, other)
        start, end = pair_range(table, distance - tolerance, distance + tolerance)
        for pair in range(start, end):
            if table.first[pair] == identity:
                accepted[other, table.second[pair]] += 1
            elif table.second[pair] == identity:
                accepted[other, table.first[pair]] += 1


@compiled_ieee
def _verified(table: PairTable, stars: int, seen: Array, tolerance: float) -> Indices:
    """Matches (m, 2) that the most poles accept, at least `MIN_POLES`."""
    n = seen.shape[0]
    votes, accepted = np.empty(stars, dtype=np.int32), np.zeros((n, stars), dtype=np.int32)
    for pole in range(n):
        pole_votes(table, seen, pole, tolerance, votes)
        for _ in range(IDENTITIES):
            identity = int(np.argmax(votes))
            if votes[identity] < MIN_ACCEPTED:
                break
            votes[identity] = 0
            accept(table, seen, pole, identity, tolerance, accepted)
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
