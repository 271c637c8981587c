"""Parts of the thesis's algorithms replaced by something useless, to measure what each of them is worth."""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Callable, Iterator
from typing import Any, Final, Literal, cast, get_args
from unittest.mock import patch

import numpy as np

from starid.arrays import Array
from starid.errors import StaridError
from starid.identification.thesis.feature_search import FeatureAnswer, FeatureSearch, FieldStars
from starid.identification.thesis.features import FeatureVector
from starid.identification.thesis.lsi import BORESIGHT, DEC, POINTER, RA, LostInSpace, LsiSolution
from starid.identification.thesis.rsi_identifier import Preprocessed, RsiIdentifier

Part = Literal["features", "weights", "filter", "motion", "region"]

ELSEWHERE_DEG: Final = (266.0, -29.0)
"""Right ascension and declination of the field whose features every image gets: the centre of the Galaxy."""

_SEED: Final = 7


@contextlib.contextmanager
def without(part: Part | None) -> Iterator[None]:
    """Take a part away from all identifiers `lsi` and `rsi` within the context.

    Parameters
    ----------
    part : {"features", "weights", "filter", "motion", "region"}, optional
        Replaced are: the features of every image by those of another field; the weights of the LASSO by the same in random
        order; the filter's choice by all detections; the motion by its inverse; the nearest cell of the region of search by
        nothing. None takes nothing away.
    """
    with contextlib.ExitStack() as stack:
        for owner, name, replacement in _REPLACED[part] if part else ():
            stack.enter_context(patch.object(owner, name, replacement))
        yield


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


def _field_elsewhere(search: FeatureSearch) -> FieldStars:
    brightness, offsets, _ = search.stars.stars_in_frame(*ELSEWHERE_DEG)
    return search.field_of(offsets, brightness)


_features = FeatureSearch.features
_doubtful = FeatureSearch.doubtful_features
_answer = FeatureSearch.answer_of
_preprocess = RsiIdentifier.preprocess
_order = np.random.default_rng(_SEED)


def _features_elsewhere(search: FeatureSearch, _field: FieldStars) -> FeatureVector | None:
    return _features(search, _field_elsewhere(search))


def _doubtful_elsewhere(search: FeatureSearch, _field: FieldStars) -> list[FeatureVector]:
    return _doubtful(search, _field_elsewhere(search))


def _shuffled_answer(search: FeatureSearch, solution: LsiSolution, features: FeatureVector) -> FeatureAnswer:
    """The answer with the boresight that the weights give in random order, and a pointer across it."""
    weights = solution.weights[:, _order.permutation(solution.weights.shape[1])]
    ra, dec = np.radians([search.database.grid.centre(cell) for cell in solution.cells.tolist()]).T
    directions = np.column_stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
    boresights = _unit(weights @ directions)
    results = solution.results.copy()
    pointers = results[:, POINTER : POINTER + 3]
    results[:, POINTER : POINTER + 3] = _unit(
        pointers - boresights * np.sum(boresights * pointers, axis=1)[:, None]
    )
    results[:, BORESIGHT : BORESIGHT + 3] = boresights
    results[:, RA] = np.degrees(np.arctan2(boresights[:, 1], boresights[:, 0])) % 360.0
    results[:, DEC] = np.degrees(np.arcsin(np.clip(boresights[:, 2], -1.0, 1.0)))
    return _answer(search, dataclasses.replace(solution, weights=weights, results=results), features)


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1)[:, None], dtype=np.float64)


def _nothing_removed(identifier: RsiIdentifier, xy: Array, flux: Array) -> Preprocessed:
    known = _preprocess(identifier, xy, flux)
    return dataclasses.replace(known, true_stars=np.ones(flux.size, dtype=np.bool_))


def _reversed_motion(identifier: RsiIdentifier, xy: Array, flux: Array) -> Preprocessed:
    known = _preprocess(identifier, xy, flux)
    return known if known.rotation is None else dataclasses.replace(known, rotation=known.rotation.T)


def _nothing_found(*_: Any, **__: Any) -> tuple[int, float, int]:
    return -1, math.inf, 0


_REPLACED: Final[dict[Part, list[tuple[type, str, Callable[..., Any]]]]] = {
    "features": [
        (FeatureSearch, "features", _features_elsewhere),
        (FeatureSearch, "doubtful_features", _doubtful_elsewhere),
    ],
    "weights": [(FeatureSearch, "answer_of", _shuffled_answer)],
    "filter": [(RsiIdentifier, "preprocess", _nothing_removed)],
    "motion": [(RsiIdentifier, "preprocess", _reversed_motion)],
    "region": [(LostInSpace, "nearest_in_region", _nothing_found)],
}
"""Part → owner, name and replacement of each method."""
