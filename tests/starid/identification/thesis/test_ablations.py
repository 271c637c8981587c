"""The thesis's parts decide: each of them, taken away or made wrong, costs availability or accuracy."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest

from starid.attitude import Attitude, propagate, random_attitude
from starid.camera import DEFAULT_CAMERA
from starid.catalog import load_catalog
from starid.identification.thesis.feature_search import FeatureSearch
from starid.identification.thesis.lsi_identifier import LsiIdentifier
from starid.identification.thesis.rsi_identifier import RsiIdentifier

ZERO_POINT = 20.3
LIMIT = 6.0
SENSOR = {"zero_point": ZERO_POINT, "detected_limit": LIMIT, "magnitude_sigma": 0.03}
FRAMES = 30
RIGHT_DEG = 1.5
WRONG_DEG = 0.1


def image(rng, attitude, false_stars=0):
    """Positions and fluxes of the stars to V 6, with noise and false stars."""
    stars = load_catalog().brighter_than(6.5)
    xy, inside = DEFAULT_CAMERA.project(attitude.to_sensor(stars.vectors))
    magnitude = stars.v + rng.normal(0.0, 0.02, len(stars))
    seen = inside & (magnitude <= LIMIT)
    xy = xy[seen] + rng.normal(0.0, 0.2, (int(seen.sum()), 2))
    xy = np.concatenate([xy, rng.uniform(0.0, 936.0, (false_stars, 2))])
    magnitude = np.concatenate([magnitude[seen], rng.uniform(1.0, 4.0, false_stars)])
    return xy, 10.0 ** (-0.4 * (magnitude - ZERO_POINT))


@functools.cache
def identifier(kind, refinement, filter_false_stars=True):
    options = {"filter_false_stars": filter_false_stars} if kind is RsiIdentifier else {}
    return kind(refinement=refinement, **SENSOR, **options)


def lost_in_space(refinement=True):
    """Errors of the boresight in degrees at random attitudes; NaN if invalid."""
    rng, lsi = np.random.default_rng(41), identifier(LsiIdentifier, refinement)
    errors = []
    for _ in range(FRAMES):
        attitude = random_attitude(rng)
        solution = lsi.identify(*image(rng, attitude))
        errors.append(error_deg(solution, attitude))
    return np.array(errors)


def error_deg(solution, attitude):
    return solution.attitude.error_to(attitude).cross_boresight_arcsec / 3600.0 if solution.valid else np.nan


def slew(rate_deg, false_stars=0, **options):
    """Errors of the boresight, degrees, and share of frames answered from the region, through sequences."""
    rsi = identifier(RsiIdentifier, True, **options)  # noqa: FBT003 (refinement)
    errors, in_region = [], 0
    for seed in range(2):
        rng = np.random.default_rng((42, seed))
        attitude = random_attitude(rng)
        rsi.reset()
        predicted = None
        for _ in range(FRAMES // 2):
            attitude = propagate(attitude, np.radians([0.0, rate_deg, 0.0]), 1.0)
            xy, flux = image(rng, attitude, false_stars)
            solution = rsi.identify(xy, flux) if predicted is None else rsi.track(xy, flux, predicted)
            predicted = solution.attitude if solution.valid else None
            errors.append(error_deg(solution, attitude))
            in_region += solution.features.search == "rsi" and solution.valid
    return np.array(errors), in_region / FRAMES


def valid_share(errors):
    assert not (errors > WRONG_DEG).any()
    return float(np.isfinite(errors).mean())


def of_another_image(method):
    """The method of a search with the stars of the image before, so that features do not belong to the image."""
    last = []

    def with_last(self, field):
        last.append(field)
        return method(self, last[-2] if len(last) > 2 else field)

    return with_last


def test_features_of_another_image_find_nothing(monkeypatch):
    assert valid_share(lost_in_space()) >= 0.97
    for name in ("features", "doubtful_features"):
        monkeypatch.setattr(FeatureSearch, name, of_another_image(getattr(FeatureSearch, name)))
    assert valid_share(lost_in_space()) <= 0.5  # the neighbours of any features cover a part of the sky


def test_features_of_another_part_of_the_sky_leave_the_region_useless(monkeypatch):
    _, in_region = slew(0.5)
    assert in_region >= 0.8
    elsewhere = identifier(LsiIdentifier, True).search.field_stars(  # noqa: FBT003
        *image(np.random.default_rng(5), Attitude.from_radec_roll(266.0, -29.0, 0.0)), ZERO_POINT
    )
    features, doubtful = FeatureSearch.features, FeatureSearch.doubtful_features
    monkeypatch.setattr(FeatureSearch, "features", lambda self, _field: features(self, elsewhere))
    monkeypatch.setattr(FeatureSearch, "doubtful_features", lambda self, _field: doubtful(self, elsewhere))
    errors, in_region = slew(0.5)
    assert in_region <= 0.1
    assert valid_share(errors) <= 0.3


def test_shuffled_weights_of_the_lasso_double_the_error(monkeypatch):
    def median_of_right():
        errors = lost_in_space(refinement=False)
        return float(np.median(errors[errors < RIGHT_DEG]))

    ordered = median_of_right()
    answer = FeatureSearch._answer
    rng = np.random.default_rng(7)

    def shuffled(self, solution, features):
        weights = solution.weights[:, rng.permutation(9)]
        places = np.radians([self.database.grid.centre(cell) for cell in solution.cells.tolist()])
        ra, dec = places.T
        directions = np.column_stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
        results = solution.results.copy()
        results[:, 6:9] = weights @ directions
        results[:, 6:9] /= np.linalg.norm(results[:, 6:9], axis=1)[:, None]
        results[:, 9:12] -= results[:, 6:9] * np.sum(results[:, 6:9] * results[:, 9:12], axis=1)[:, None]
        results[:, 9:12] /= np.linalg.norm(results[:, 9:12], axis=1)[:, None]
        return answer(self, dataclasses.replace(solution, weights=weights, results=results), features)

    monkeypatch.setattr(FeatureSearch, "_answer", shuffled)
    assert median_of_right() >= 2.0 * ordered


def test_without_the_filter_twenty_false_stars_cost_most_attitudes():
    filtered, in_region = slew(0.5, false_stars=20)
    assert valid_share(filtered) >= 0.85
    assert in_region >= 0.6
    unfiltered, in_region = slew(0.5, false_stars=20, filter_false_stars=False)
    assert valid_share(unfiltered) <= 0.3
    assert in_region <= 0.1


def test_a_reversed_motion_loses_the_region(monkeypatch):
    _, in_region = slew(2.0)
    assert in_region >= 0.7
    preprocess = RsiIdentifier._preprocess

    def reversed_motion(self, xy, flux):
        known = preprocess(self, xy, flux)
        return known if known.rotation is None else dataclasses.replace(known, rotation=known.rotation.T)

    monkeypatch.setattr(RsiIdentifier, "_preprocess", reversed_motion)
    _, in_region = slew(2.0)
    assert in_region <= 0.25


@pytest.mark.parametrize("algorithm", [LsiIdentifier, RsiIdentifier])
def test_the_features_alone_state_the_error_that_they_have(algorithm):
    rng, features_only = np.random.default_rng(43), identifier(algorithm, False)  # noqa: FBT003
    squares = []
    for _ in range(90):
        attitude = random_attitude(rng)
        features_only.reset()
        solution = features_only.identify(*image(rng, attitude))
        if solution.valid:
            error = solution.attitude.error_to(attitude).rotation_vector_rad
            squares.append(float(np.mean(error**2 / np.diag(solution.covariance))))
            assert solution.cross_boresight_sigma_arcsec > 600.0
            assert not solution.features.refined
    assert len(squares) >= 80
    assert 0.5 <= np.mean(squares) <= 2.0
