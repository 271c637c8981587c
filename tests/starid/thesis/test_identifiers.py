"""The LSI and RSI identifiers on frames of points: right or invalid, and what they refuse."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from starid.attitude import Attitude, propagate, random_attitude
from starid.camera import DEFAULT_CAMERA, Camera
from starid.catalog import load_catalog
from starid.errors import StaridError
from starid.interface import StarIdentifier, make_identifier
from starid.solution import Reason
from starid.thesis.database import DatabaseError, DatabaseParameters, build_database
from starid.thesis.database_file import save_database
from starid.thesis.lsi_identifier import LsiIdentifier
from starid.thesis.rsi_identifier import RsiIdentifier
from starid.tracker import Tracker

RIGHT_ARCSEC = 120.0


@functools.cache
def lsi():
    return LsiIdentifier()


def points(rng, attitude, *, magnitude_sigma=0.1, false_stars=0):
    stars = load_catalog().brighter_than(6.5)
    xy, inside = DEFAULT_CAMERA.project(attitude.to_sensor(stars.vectors))
    magnitude = stars.v + rng.normal(0.0, magnitude_sigma, len(stars))
    seen = inside & (magnitude <= 6.0)
    xy = xy[seen] + rng.normal(0.0, 0.2, (int(seen.sum()), 2))
    xy = np.concatenate([xy, rng.uniform(0.0, 936.0, (false_stars, 2))])
    magnitude = np.concatenate([magnitude[seen], rng.uniform(2.0, 6.0, false_stars)])
    order = rng.permutation(len(magnitude))
    return xy[order], 10.0 ** (-0.4 * (magnitude[order] - 20.3))


@pytest.mark.parametrize("false_stars", [0, 5])
def test_lsi_is_right_or_invalid(false_stars):
    rng = np.random.default_rng(false_stars)
    valid = 0
    for _ in range(30):
        attitude = random_attitude(rng)
        solution = lsi().identify(*points(rng, attitude, false_stars=false_stars))
        if solution.valid:
            valid += 1
            assert solution.attitude.error_to(attitude).total_arcsec < RIGHT_ARCSEC
            assert solution.mode == "lost_in_space"
    assert valid >= 28


@pytest.mark.parametrize(("ra", "dec"), [(0.0, 90.0), (123.0, -90.0), (0.01, 0.0), (359.99, 45.0)])
def test_lsi_at_the_poles_and_at_the_wrap(ra, dec):
    attitude = Attitude.from_radec_roll(ra, dec, 77.0)
    solution = lsi().identify(*points(np.random.default_rng(5), attitude))
    assert solution.valid
    assert solution.attitude.error_to(attitude).total_arcsec < RIGHT_ARCSEC


def test_rsi_follows_a_turning_sensor_among_false_stars():
    rng = np.random.default_rng(6)
    recursion = RsiIdentifier()
    tracker = Tracker(recursion)
    attitude = random_attitude(rng)
    for i in range(25):
        attitude = propagate(attitude, np.radians([0.3, 0.4, 0.2]), 1.0)
        solution = tracker.update(*points(rng, attitude, false_stars=15), float(i))
        if i > 0:
            assert solution.valid
            assert solution.attitude.error_to(attitude).total_arcsec < RIGHT_ARCSEC
    statistics = recursion.statistics
    assert statistics.in_region >= 22
    assert 2.0 <= statistics.region_sum_deg / statistics.frames < 4.0


def test_rsi_with_a_wrong_prediction_asks_the_whole_sky():
    rng = np.random.default_rng(7)
    attitude = Attitude.from_radec_roll(80.0, 10.0, 0.0)
    recursion = RsiIdentifier()
    recursion.identify(*points(rng, attitude))
    solution = recursion.track(*points(rng, attitude), Attitude.from_radec_roll(250.0, -40.0, 0.0))
    assert solution.valid
    assert solution.mode == "lost_in_space"
    assert recursion.statistics.triggers == 1


def test_both_are_star_identifiers_by_name():
    for name in ("lsi", "rsi"):
        assert isinstance(make_identifier(name), StarIdentifier)


@pytest.mark.parametrize("make", [lsi, lambda: RsiIdentifier()])
def test_bad_input(make):
    identifier = make()
    assert identifier.identify(np.empty((0, 2)), np.empty(0)).reason is Reason.TOO_FEW_STARS
    assert identifier.identify([[400.0, 400.0]], [1000.0]).reason is Reason.TOO_FEW_STARS
    rng = np.random.default_rng(9)
    noise = identifier.identify(rng.uniform(0.0, 936.0, (60, 2)), rng.uniform(1e4, 1e6, 60))
    assert not noise.valid
    with pytest.raises(StaridError, match="finite"):
        identifier.identify([[np.nan, 1.0]], [1.0])
    with pytest.raises(StaridError, match="needed"):
        identifier.identify([[1.0, 1.0]], [1.0, 2.0])


def test_a_database_of_another_camera_or_geometry_is_refused(tmp_path):
    catalog = load_catalog()
    other = DatabaseParameters.for_camera(Camera.from_fov(30.0), overlap=0.95, kappa=5.0)
    save_database(build_database(catalog, other), tmp_path / "other.db")
    save_database(build_database(catalog, DatabaseParameters(overlap=0.9)), tmp_path / "planar.db")
    with pytest.raises(DatabaseError, match=r"other\.db belongs to another camera"):
        LsiIdentifier(database=tmp_path / "other.db")
    with pytest.raises(DatabaseError, match=r"planar\.db is planar"):
        LsiIdentifier(database=tmp_path / "planar.db")
