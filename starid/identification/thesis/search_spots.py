"""Spots of the sky, each of which the refinement tries once, whichever cells of the database lie in it.

The cells nearest to a feature vector cluster in the sky, far closer to each other than a vote needs.
"""

from __future__ import annotations

from typing import Final, NamedTuple, Self

import numpy as np

from starid.arithmetic.arrays import Array, Indices, elementwise
from starid.arithmetic.elementary import cos
from starid.identification.thesis.frame_grid import GridArrays, cell_centre
from starid.kernels.jit import compiled, inner_checked

_NOT_TRIED: Final = -1
_TRIED: Final = -2
"""States of a spot; a number from 0 is its place among those that a call finds."""


class Spots(NamedTuple):
    """Spots of about equal area in bands of declination.

    Attributes
    ----------
    height_deg
        Height of a band, degrees.
    band_start
        First spot of each band, from the south pole, (bands + 1,).
    """

    height_deg: float
    band_start: Indices

    @classmethod
    def of_side(cls, side_deg: float) -> Self:
        """Divide the sky into spots of at most about this side, degrees."""
        bands = int(np.ceil(180.0 / side_deg))
        height_deg = 180.0 / bands
        middle = np.radians((np.arange(bands) + 0.5) * height_deg - 90.0)
        columns = np.maximum(np.rint(360.0 * elementwise(cos, middle) / side_deg), 1.0).astype(np.int64)
        return cls(height_deg, np.concatenate([[0], np.cumsum(columns)]))

    def none_tried(self) -> Indices:
        """The state of all spots, (spots,), before a search."""
        return np.full(int(self.band_start[-1]), _NOT_TRIED, dtype=np.int64)


@inner_checked
def _spot_of(spots: Spots, ra_deg: float, dec_deg: float) -> int:
    band = min(int((dec_deg + 90.0) / spots.height_deg), spots.band_start.size - 2)
    columns = spots.band_start[band + 1] - spots.band_start[band]
    return int(spots.band_start[band] + min(int(ra_deg / 360.0 * columns), columns - 1))


@compiled
def places_not_tried(
    grid: GridArrays, spots: Spots, distances: Array, cells: Indices, state: Indices, places: Array
) -> int:
    """Write the centre of the nearest cell in each spot not tried before to `places`, nearest first; return their number.

    Parameters
    ----------
    distances, cells
        Distances of features, and cells, (n,), in any order; −1 for none.
    state
        States of the spots, (spots,), updated.
    places
        Output (n, 2): right ascension and declination, degrees.
    """
    best = np.empty(cells.size, dtype=np.int64)
    count = 0
    for i in range(cells.size):
        if cells[i] < 0:
            continue
        ra, dec = cell_centre(grid, cells[i])
        spot = _spot_of(spots, ra % 360.0, dec)
        if state[spot] == _NOT_TRIED:
            state[spot] = count
            best[count] = i
            count += 1
        elif state[spot] != _TRIED:
            other = best[state[spot]]
            if (distances[i], cells[i]) < (distances[other], cells[other]):
                best[state[spot]] = i
    best = best[:count]
    order = best[np.argsort(distances[best], kind="mergesort")]
    for rank in range(count):
        ra, dec = cell_centre(grid, cells[order[rank]])
        places[rank, 0] = ra % 360.0
        places[rank, 1] = dec
        state[_spot_of(spots, ra % 360.0, dec)] = _TRIED
    return count
