"""What overexposed pixels do: their charge spills along the column, and traps keep some of it for later images.

Both begin where a pixel has reached its full well. A CCD without drains spills what is beyond (blooming); most CMOS
pixels drain it. Traps at the interface, which charge reaches only in a full pixel, or in the substrate release what they
keep at a rate that falls exponentially (Janesick, Scientific Charge-Coupled Devices, SPIE 2001, on residual images): after a
dazzling light, images are brighter for a while, and show spots where bright objects were.
"""

from __future__ import annotations

import numpy as np

from starid.arithmetic.arrays import Array32
from starid.arithmetic.elementary import exp

_LEAST_E = 0.01
"""Electrons in each pixel below which traps are taken for empty."""


def spill(mean_e: Array32, full_well_e: float, share: float) -> None:
    """Spill the charge (h, w) beyond the full well along the columns, in place; all but a `share` of it is drained.

    Half goes up and half goes down, each into the next pixels that can take it. What reaches the edge leaves the image.
    """
    columns = np.flatnonzero((mean_e > full_well_e).any(axis=0))
    charge = mean_e[:, columns].astype(np.float64)
    each_way = 0.5 * share * np.maximum(charge - full_well_e, 0.0)
    np.minimum(charge, full_well_e, out=charge)
    height = len(charge)
    for rows in (range(height), range(height - 1, -1, -1)):
        moving = np.zeros(columns.size)
        for row in rows:
            moving += each_way[row]
            taken = np.minimum(moving, full_well_e - charge[row])
            charge[row] += taken
            moving -= taken
    mean_e[:, columns] = charge


class Afterimage:
    """The charge that traps keep from image to image.

    A pixel that reaches its full well fills its traps with `capacity_e` electrons, which they release with a time constant.
    """

    def __init__(self, full_well_e: float, capacity_e: float, decay_s: float) -> None:
        self._full_well_e = full_well_e
        self._capacity_e = capacity_e
        self._decay_s = decay_s
        self._trapped: Array32 | None = None
        """Electrons (h, w) in the traps at `_since_s`; None if they are empty."""
        self._since_s = 0.0

    def expose(self, mean_e: Array32, begin_s: float, end_s: float) -> None:
        """Add to the electrons (h, w) of an exposure between two times what the traps release in it, and keep what they catch."""
        if self._trapped is not None:
            left, rest = (self._left(at_s) for at_s in (begin_s, end_s))
            mean_e += self._trapped * np.float32(left - rest)
            self._trapped *= np.float32(rest)
            if float(self._trapped.max()) < _LEAST_E:
                self._trapped = None
        self._since_s = end_s
        full = mean_e >= self._full_well_e
        if full.any():
            trapped = np.zeros_like(mean_e) if self._trapped is None else self._trapped
            trapped[full] = self._capacity_e
            self._trapped = trapped

    def _left(self, at_s: float) -> float:
        """Return the fraction of the charge that is still trapped at a time."""
        return exp(-max(at_s - self._since_s, 0.0) / self._decay_s)
