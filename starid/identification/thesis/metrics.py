"""The metrics with which the thesis evaluates its algorithms."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from starid.arithmetic.arrays import Array, Indices, Mask


def boresight_error(
    ra_deg: ArrayLike, dec_deg: ArrayLike, true_ra_deg: ArrayLike, true_dec_deg: ArrayLike
) -> Array:
    """Error of the boresight ε_f = ‖f − f̃‖, eq. 2.21, degrees in the flat plane; differences in α wrap."""
    east = (np.asarray(ra_deg) - np.asarray(true_ra_deg) + 180.0) % 360.0 - 180.0
    north = np.asarray(dec_deg) - np.asarray(true_dec_deg)
    return np.asarray(np.hypot(east, north), dtype=np.float64)


def rotation_error(angle_deg: ArrayLike, true_angle_deg: ArrayLike) -> Array:
    """Error of the rotation angle ε_θ = |θ − θ̃|, eq. 2.22, degrees, 0 … 180."""
    turn = (np.asarray(angle_deg) - np.asarray(true_angle_deg) + 180.0) % 360.0 - 180.0
    return np.asarray(np.abs(turn), dtype=np.float64)


def error_colours(error: ArrayLike, largest: float) -> Array:
    """Colours of an error map, eq. 6.1: from green at 0 to red from `largest` on, RGB 0 … 1, (…, 3)."""
    share = np.clip(np.asarray(error, dtype=np.float64) / largest, 0.0, 1.0)
    return np.stack([share, 1.0 - share, np.zeros_like(share)], axis=-1)


@dataclass(frozen=True, slots=True)
class Confusion:
    """Confusion matrix of a false-star filter, and the indicators of eq. 6.2.

    Attributes
    ----------
    true_positive, false_positive
        True and false stars taken for true ones.
    false_negative, true_negative
        True and false stars taken for false ones.
    """

    true_positive: int = 0
    false_positive: int = 0
    false_negative: int = 0
    true_negative: int = 0

    def __add__(self, other: Confusion) -> Confusion:
        return Confusion(*(int(count) for count in self.counts + other.counts))

    @property
    def counts(self) -> Indices:
        """True positives, false positives, false negatives and true negatives, (4,)."""
        return np.array(dataclasses.astuple(self), dtype=np.int64)

    def percent(self, indicator: str) -> float:
        return 100.0 * float(getattr(self, indicator))

    @classmethod
    def of(cls, taken_for_true: Mask, is_star: Mask) -> Confusion:
        taken = (taken_for_true, ~taken_for_true)
        return cls(*(int(np.count_nonzero(a & b)) for a in taken for b in (is_star, ~is_star)))

    @property
    def accuracy(self) -> float:
        """Share of correct decisions."""
        right = self.true_positive + self.true_negative
        return _share(right, right + self.false_positive + self.false_negative)

    @property
    def precision(self) -> float:
        """Share of true stars among those taken for true stars."""
        return _share(self.true_positive, self.true_positive + self.false_positive)

    @property
    def recall(self) -> float:
        """Share of true stars that are taken for true stars."""
        return _share(self.true_positive, self.true_positive + self.false_negative)

    @property
    def f1(self) -> float:
        """Harmonic mean of precision and recall."""
        total = self.precision + self.recall
        return 2.0 * self.precision * self.recall / total if total > 0.0 else math.nan


def _share(part: int, whole: int) -> float:
    return part / whole if whole > 0 else math.nan
