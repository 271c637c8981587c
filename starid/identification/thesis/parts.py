"""The parts of the thesis's algorithms that can be replaced: each is a function, and the thesis's by default."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from starid.arithmetic.arrays import Array
from starid.attitude import Attitude
from starid.attitude.wahba import solve_wahba
from starid.identification.thesis.false_stars import FalseStarFilter
from starid.identification.thesis.feature_search import FeatureAnswer, FeatureSearch
from starid.identification.thesis.features import FeatureVector, extract_features
from starid.identification.thesis.lsi import LassoPath
from starid.identification.thesis.scalable_filter import TrackFilter, TrackFilterSettings


def rotation_between(then: Array, now: Array) -> Array:
    """Rotation of the sky in the sensor frame, (3, 3), by least squares from directions (m, 3) of the same stars."""
    return solve_wahba(now, then).matrix


@dataclass(frozen=True)
class Parts:
    """The parts of LSI and RSI.

    Attributes
    ----------
    features
        Features of magnitudes (n,) and offsets from the boresight (n, 2), pixels: algorithm 1, lines 1 and 2.
    weights
        LASSO of line 11 (see `LostInSpace`); by default that of `LsiOptions.solver`.
    false_star_filter
        Makes the filter (FSF) for a sensor: algorithm 2.
    motion
        Rotation of the sky from the last image to this one, (3, 3), by directions of the same stars then and now, (m, 3): CME,
        line 5 of algorithm 2.
    region
        Answer of the nearest cell in a square region, by features, its centre and its side in degrees: algorithm 3, line 10;
        None if there is none.
    """

    features: Callable[[Array, Array], FeatureVector] = extract_features
    weights: LassoPath | None = None
    false_star_filter: Callable[[TrackFilterSettings], FalseStarFilter] = TrackFilter
    motion: Callable[[Array, Array], Array] = rotation_between
    region: Callable[[FeatureSearch, FeatureVector, Attitude, float], FeatureAnswer | None] = (
        FeatureSearch.answer_in_region
    )
