"""Algorithm 3: when the region is searched and when the whole database, which answer is kept, and how it relates to the last one.

`RsiIdentifier` follows these rules on images, and `feature_error` on simulated ones, where it measures the errors of each kind of
answer by features alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, Literal, TypeAlias

import numpy as np

from starid.arithmetic.matrices import length
from starid.attitude import Attitude
from starid.identification.solution import Solution
from starid.identification.thesis.feature_search import FeatureAnswer

RIGHT_DEG: Final = 1.5
"""Error of the boresight up to which an answer is at the right place of the sky, degrees."""

AnswerKind = Literal["first", "elsewhere", "region", "again"]
Search: TypeAlias = Callable[[], FeatureAnswer | None]


@dataclass(frozen=True, eq=False)
class KeptAnswer:
    """The answer to one image.

    Attributes
    ----------
    answer
        Where the features are in the sky.
    kind
        "first": of the whole database, to the first image. "region": of a region that fits. After a region that did not fit,
        "again" at the place of the last answer nevertheless, and "elsewhere" away from it.
    images
        Number of answers in a row at the same place, this one included; 0 if it is away from the last one.
    valid
        False if ε_ψ is so large that there is no attitude.
    """

    answer: FeatureAnswer
    kind: AnswerKind
    images: int
    valid: bool


class AnswerSequence:
    """The answers to the images of a sequence.

    Parameters
    ----------
    threshold
        Largest ε_ψ with which a region fits, τ.
    largest
        Largest ε_ψ of an attitude, K·τ.
    """

    def __init__(self, threshold: float, largest: float) -> None:
        self._threshold = threshold
        self._largest = largest
        self.reset()

    def reset(self) -> None:
        """Start again with the next image as the first."""
        self._exceeded = False
        self._images = 0

    @property
    def exceeded(self) -> bool:
        """Whether the next image is searched in the whole database at once: the last answer was not good enough (section 6.3.2)."""
        return self._exceeded

    def next(
        self,
        local: FeatureAnswer | None,
        everywhere: Sequence[Search],
        last: Attitude | None,
        *,
        first: bool,
    ) -> KeptAnswer | None:
        """Choose between the answers to the next image; None if there is none.

        Parameters
        ----------
        local
            Answer of the region of search, if it was searched.
        everywhere
            Searches of the whole database in order: none is made if the region fits, and none after the first with an attitude.
        last
            Attitude of the last answer, carried by the motion; None if either is unknown.
        first
            Whether the image is the first of a sequence.
        """
        if local is not None and local.error_psi <= self._threshold:
            answer, kind = local, self._in_region()
        else:
            best = self._best(local, everywhere)
            if best is None:
                self._exceeded, self._images = True, 0
                return None
            answer, kind = best, self._after_region(best, last, first=first)
        valid = answer.error_psi <= self._largest
        kept = KeptAnswer(answer, kind, self._images, valid)
        self._exceeded = not valid or answer.error_psi > self._threshold
        if not valid:
            self._images = 0
        return kept

    def next_refined(self, local: Solution | None, everywhere: Callable[[], Solution]) -> Solution:
        """Return the verified solution of the region or, without one, that of a search of the whole database.

        With refinement a verified answer counts as one with ε_ψ ≤ τ, and any other as one above.
        """
        solution = everywhere() if local is None else local
        self._exceeded = not solution.valid
        return solution

    def _best(self, local: FeatureAnswer | None, everywhere: Sequence[Search]) -> FeatureAnswer | None:
        best = local
        for search in everywhere:
            answer = search()
            if answer is not None and (best is None or answer.error_psi < best.error_psi):
                best = answer
            if best is not None and best.error_psi <= self._largest:
                break
        return best

    def _in_region(self) -> AnswerKind:
        self._images += 1
        return "region"

    def _after_region(self, answer: FeatureAnswer, last: Attitude | None, *, first: bool) -> AnswerKind:
        if first:
            self._images = 0
            return "first"
        if last is None or _off_deg(answer.attitude, last) > RIGHT_DEG:
            self._images = 0
            return "elsewhere"
        self._images += 1
        return "again"


def _off_deg(attitude: Attitude, other: Attitude) -> float:
    """Angle between two boresights, degrees."""
    return float(np.degrees(length(attitude.error_to(other).rotation_vector_rad[:2])))
