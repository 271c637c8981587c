"""What false-star filters share: two frames of objects in, which objects are true stars and which belong together out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from starid.arrays import Array, Indices, Mask
from starid.errors import StaridError


class FilterError(StaridError):
    """Frames that a false-star filter cannot work on."""


@dataclass(frozen=True, eq=False)
class ObservedFrame:
    """The objects of one frame as they were measured.

    Attributes
    ----------
    brightness
        Magnitudes, (n,).
    positions
        Offsets from the frame's centre, (n, 2), degrees.
    """

    brightness: Array
    positions: Array

    def __post_init__(self) -> None:
        if self.brightness.ndim != 1 or self.positions.shape != (self.brightness.size, 2):
            raise FilterError(
                f"frame: {self.brightness.shape} brightness values for positions {self.positions.shape}; "
                "give (n,) and (n, 2)"
            )
        if not (np.isfinite(self.brightness).all() and np.isfinite(self.positions).all()):
            raise FilterError(
                "frame: an object's brightness or position is not finite; drop such objects first"
            )

    def __len__(self) -> int:
        return int(self.brightness.size)


@dataclass(frozen=True, eq=False)
class FilterResult:
    """Which objects are true stars.

    Attributes
    ----------
    true_before, true_now
        For each object of the earlier and of the later frame whether it is taken for a true star.
    matches
        Pairs of objects (earlier, later) that are the same star, (m, 2).
    """

    true_before: Mask
    true_now: Mask
    matches: Indices

    @property
    def matched(self) -> Mask:
        """Which objects of the later frame belong to one of the earlier."""
        return np.isin(np.arange(self.true_now.size), self.matches[:, 1])


class FalseStarFilter(Protocol):
    """What separates true stars from false ones in two successive frames."""

    def __call__(self, before: ObservedFrame, now: ObservedFrame) -> FilterResult:
        """Compare two successive frames; with nothing to go by every object is taken for a false star."""
        ...
