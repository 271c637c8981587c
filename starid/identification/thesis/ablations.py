"""Parts of the thesis's algorithms replaced by something useless, to measure what each of them is worth."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Literal, cast, get_args

import numpy as np

from starid.arithmetic.arrays import Array
from starid.errors import StaridError
from starid.identification.thesis.false_stars import FalseStarFilter, FilterResult, ObservedFrame
from starid.identification.thesis.feature_search import FeatureSearch
from starid.identification.thesis.features import FeatureVector
from starid.identification.thesis.lasso import LAMBDAS, lasso_path
from starid.identification.thesis.lsi import LassoPath
from starid.identification.thesis.parts import Parts, rotation_between
from starid.identification.thesis.rsi_identifier import RsiIdentifier
from starid.identification.thesis.scalable_filter import TrackFilter, TrackFilterSettings

Part = Literal["features", "weights", "filter", "motion", "region"]

ELSEWHERE_DEG: Final = (266.0, -29.0)
"""Right ascension and declination of the field whose features every image gets: the centre of the Galaxy."""

_SEED: Final = 7


def without(part: Part, intact: RsiIdentifier) -> RsiIdentifier:
    """Return an identifier like another, but with a part replaced.

    Parameters
    ----------
    part : {"features", "weights", "filter", "motion", "region"}
        Replaced are: the features of every image by those of another field; the weights of the LASSO by the same in random
        order; the filter's choice by all detections; the motion by its inverse; the answer of the region by none.
    intact : RsiIdentifier
        Its camera, catalogue and options are used.
    """
    if part == "features":
        parts = Parts(features=_features_elsewhere(intact.lsi.search))
    elif part == "weights":
        parts = Parts(weights=_shuffled_weights())
    else:
        parts = _REPLACED[part]
    return RsiIdentifier(intact.camera, intact.catalog, intact.options, parts)


def checked_part(name: str | None) -> Part | None:
    """Return the part of a name.

    Raises
    ------
    StaridError
        There is no such part.
    """
    for part in get_args(Part):
        if part == name:
            return cast("Part", part)
    if name is None:
        return None
    raise StaridError(f"ablation: no part {name!r}; there are {', '.join(get_args(Part))}")


def _features_elsewhere(search: FeatureSearch) -> Callable[[Array, Array], FeatureVector]:
    """The features of one field, with some stars fewer and more in turn, as the search asks for them."""
    brightness, offsets, _ = search.stars.stars_in_frame(*ELSEWHERE_DEG)
    features = itertools.cycle(search.doubtful_features(search.field_of(offsets, brightness)))
    return lambda _magnitudes, _offsets: next(features)


def _shuffled_weights() -> LassoPath:
    order = np.random.default_rng(_SEED)

    def weights(dictionary: Array, observation: Array) -> Array:
        path = np.empty((LAMBDAS.size, dictionary.shape[1]))
        lasso_path(dictionary, observation, LAMBDAS, path)
        return path[:, order.permutation(dictionary.shape[1])]

    return weights


@dataclass(frozen=True)
class _NothingRemoved:
    """A filter that finds the same matches as another, and keeps all objects."""

    filter: FalseStarFilter

    def __call__(self, before: ObservedFrame, now: ObservedFrame) -> FilterResult:
        return dataclasses.replace(self.filter(before, now), true_now=np.ones(len(now), dtype=np.bool_))


def _nothing_removed(settings: TrackFilterSettings) -> FalseStarFilter:
    return _NothingRemoved(TrackFilter(settings))


def _reversed_motion(then: Array, now: Array) -> Array:
    return rotation_between(then, now).T


_REPLACED: Final[dict[Part, Parts]] = {
    "filter": Parts(false_star_filter=_nothing_removed),
    "motion": Parts(motion=_reversed_motion),
    "region": Parts(region=lambda *_: None),
}
