"""Interface of the false-star filters: two frames of objects in; true stars and matches out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from starid.arithmetic.arrays import Array, Indices, Mask
from starid.errors import StaridError


class FilterError(StaridError):
    """Frames that a false-star filter cannot process."""


@dataclass(frozen=True, eq=False)
class ObservedFrame:
    """The measured objects in one frame.

    Attributes
    ----------
    brightness
        Magnitudes, (n,).
    positions
        Offsets from the centre of the frame, (n, 2), degrees.
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
                "frame: the brightness or position of an object is not finite; remove such objects first"
            )

    def __len__(self) -> int:
        return int(self.brightness.size)


@dataclass(frozen=True, eq=False)
class FilterResult:
    """Which objects are true stars, and which belong together.

    Attributes
    ----------
    true_before, true_now
        Whether each object in the earlier and in the later frame is taken for a true star.
    matches
        Pairs of objects (earlier, later) that are the same star, (m, 2).
    """

    true_before: Mask
    true_now: Mask
    matches: Indices

    @property
    def matched(self) -> Mask:
        """Which objects in the later frame are matched to one in the earlier frame."""
        return np.isin(np.arange(self.true_now.size), self.matches[:, 1])


class FalseStarFilter(Protocol):
    """A filter that separates true from false stars in two successive frames."""

    def __call__(self, before: ObservedFrame, now: ObservedFrame) -> FilterResult:
        """Compare two successive frames; without evidence every object is taken for a false star."""
        ...
