"""The LSI and RSI identifiers on frames of points: right or invalid; rejection of bad input."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import binom, fisher_exact

from starid.attitude import Attitude, propagate, random_attitude
from starid.camera import DEFAULT_CAMERA, Camera
from starid.catalog import load_catalog
from starid.errors import StaridError
from starid.identification.solution import Reason
from starid.identification.star_identifier import StarIdentifier, make_identifier
from starid.identification.thesis import feature_error
from starid.identification.thesis.database import DatabaseError, DatabaseParameters, build_database
from starid.identification.thesis.database_choice import obtain_database
from starid.identification.thesis.database_file import save_database
from starid.identification.thesis.feature_error import FeatureErrors
from starid.identification.thesis.lsi_identifier import LsiIdentifier
from starid.identification.thesis.parts import Parts, rotation_between
from starid.identification.thesis.rsi_identifier import RsiIdentifier
from starid.identification.tracker import Tracker

pytestmark = pytest.mark.long

RIGHT_ARCSEC = 120.0
CHANCE = 1e-3
"""Probability with which a count may fall short of a share by chance."""
FIVE_MISSING = 0.95
"""Availability of `ideal` with five missing stars that docs/identification.md states."""


@functools.cache
def lsi():
    return LsiIdentifier()


@functools.cache
def made_rsi():
    return RsiIdentifier()


def rsi():
    """One that remembers nothing."""
    made_rsi().reset()
    return made_rsi()


@functools.cache
def bright_stars():
    return load_catalog().brighter_than(6.5)


def points(rng, attitude, *, magnitude_sigma=0.1, false_stars=0):
    stars = bright_stars()
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


@pytest.mark.parametrize("algorithm", ["lsi", "rsi"])
def test_a_half_covered_field_is_identified_by_the_circles_of_a_divided_field(algorithm):
    """Of the five, three are not identified in the whole field."""
    identifier = make_identifier(algorithm, divided=True)
    rng = np.random.default_rng(14)
    for _ in range(5):
        attitude, side = random_attitude(rng), rng.uniform(0.0, 2.0 * np.pi)
        xy, flux = points(rng, attitude)
        seen = (xy - DEFAULT_CAMERA.centre_px) @ [np.cos(side), np.sin(side)] < 0.0
        solution = identifier.identify(xy[seen], flux[seen])
        assert solution.valid
        assert solution.attitude.error_to(attitude).total_arcsec < RIGHT_ARCSEC


def test_five_missing_stars_of_the_brightest_need_no_divided_field():
    rng = np.random.default_rng(12)
    valid, images = 0, 25
    for _ in range(images):
        attitude = random_attitude(rng)
        xy, flux = points(rng, attitude)
        seen = np.delete(np.argsort(-flux), rng.choice(25, 5, replace=False))
        solution = lsi().identify(xy[seen], flux[seen])
        if solution.valid:
            valid += 1
            assert solution.attitude.error_to(attitude).total_arcsec < RIGHT_ARCSEC
    assert valid >= binom.ppf(CHANCE, images, FIVE_MISSING)


@pytest.mark.parametrize(("ra", "dec"), [(0.0, 90.0), (123.0, -90.0), (0.01, 0.0), (359.99, 45.0)])
def test_lsi_at_the_poles_and_at_the_wrap(ra, dec):
    attitude = Attitude.from_radec_roll(ra, dec, 77.0)
    solution = lsi().identify(*points(np.random.default_rng(5), attitude))
    assert solution.valid
    assert solution.attitude.error_to(attitude).total_arcsec < RIGHT_ARCSEC


def test_the_scikit_learn_solver_gives_the_same_verified_answers():
    reference = make_identifier("lsi", solver="sklearn")
    rng = np.random.default_rng(8)
    attitude = random_attitude(rng)
    xy, flux = points(rng, attitude)
    ours, theirs = lsi().identify(xy, flux), reference.identify(xy, flux)
    assert theirs.valid
    assert theirs.quaternion_xyzw == pytest.approx(ours.quaternion_xyzw, abs=1e-12)


def test_errors_of_features_alone_are_measured_once_for_what_they_depend_on(tmp_path, monkeypatch, caplog):
    catalog = load_catalog()
    monkeypatch.setenv("STARHIL_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(feature_error, "FIELDS", 8)
    of_search, measured = FeatureErrors.of_search, []

    def counted(*arguments):
        measured.append(of_search(*arguments))
        return measured[-1]

    monkeypatch.setattr(FeatureErrors, "of_search", counted)
    first, again, other = (
        LsiIdentifier(
            DEFAULT_CAMERA, catalog, refinement=False, overlap=0.7, magnitude_sigma=sigma
        ).errors.arrays
        for sigma in (0.1, 0.1, 0.2)
    )
    assert len(measured) == 2
    said = "measuring the uncertainty of features in 800 simulated sequences of images, which takes tens of seconds; later "
    assert [text.partition("starts")[0] for text in caplog.messages] == [said, said]
    assert not np.array_equal(first["first_squares"], other["first_squares"])
    for arrays in (first, again):
        assert {name: values.tobytes() for name, values in arrays.items()} == {
            name: values.tobytes() for name, values in measured[0].arrays.items()
        }
    LsiIdentifier(
        DEFAULT_CAMERA,
        catalog,
        refinement=False,
        overlap=0.7,
        parts=Parts(motion=lambda then, now: rotation_between(then, now)),
    )
    assert len(measured) == 3, "other parts have other errors"


def test_an_unknown_solver_of_an_identifier_is_rejected():
    with pytest.raises(DatabaseError, match="solver must be one of exact, matlab, sklearn, not 'octave'"):
        make_identifier("lsi", solver="octave")


def sequence(seed, images=25, magnitude_sigma=0.1, false_stars=15):
    """Errors, arcseconds (NaN: invalid), of images of a turning sensor; the statistics."""
    rng = np.random.default_rng(seed)
    recursion = rsi()
    tracker = Tracker(recursion)
    attitude = random_attitude(rng)
    errors = []
    for i in range(images):
        attitude = propagate(attitude, np.radians([0.3, 0.4, 0.2]), 1.0)
        solution = tracker.update(
            *points(rng, attitude, magnitude_sigma=magnitude_sigma, false_stars=false_stars), float(i)
        )
        errors.append(solution.attitude.error_to(attitude).total_arcsec if solution.valid else np.nan)
    return np.array(errors), recursion.statistics


def test_rsi_follows_a_turning_sensor_among_false_stars():
    errors, statistics = sequence(6)
    assert (errors[1:] < RIGHT_ARCSEC).all()
    assert 2.0 <= statistics.region_sum_deg / (statistics.in_region + statistics.triggers) < 4.0


def test_errors_of_magnitudes_leave_the_region_useless():
    """Errors of 0.1 mag put stars on the wrong side of the limit of the features, those of 0.03 mag fewer."""
    tracked = 2 * 7
    small, large = (sum(sequence(seed, 8, sigma)[1].in_region for seed in (30, 31)) for sigma in (0.03, 0.1))
    table = [[small, tracked - small], [large, tracked - large]]
    assert fisher_exact(table, alternative="greater").pvalue < 0.01


def test_while_the_features_disagree_the_whole_database_is_searched():
    rng = np.random.default_rng(15)
    # the options of test_ablations, whose errors are measured already
    features_only = RsiIdentifier(refinement=False, zero_point=20.3, detected_limit=6.0, magnitude_sigma=0.03)
    attitude = random_attitude(rng)
    solution = features_only.identify(*points(rng, attitude, magnitude_sigma=0.02))
    exceeded = []
    for _ in range(20):
        exceeded.append(not (solution.valid and solution.features.error_psi <= 0.5))
        attitude = propagate(attitude, np.radians([0.3, 0.4, 0.2]), 1.0)
        solution = features_only.track(*points(rng, attitude, magnitude_sigma=0.02), attitude)
        assert (solution.features.region_deg == 0.0) == exceeded[-1]
        assert not (solution.features.triggered and exceeded[-1])
    assert 0 < sum(exceeded) < 20


def test_the_reported_motion_is_that_of_the_boresight_on_the_sphere():
    rng, recursion = np.random.default_rng(10), rsi()
    attitude = random_attitude(rng)
    recursion.identify(*points(rng, attitude))
    turned = propagate(attitude, np.radians([0.0, 2.0, 1.0]), 1.0)
    reported = recursion.identify(*points(rng, turned)).features
    motion = turned.matrix @ attitude.matrix.T
    shift = np.degrees(np.arccos(motion[2, 2]))
    turn = np.degrees(np.arctan2(motion[1, 0] - motion[0, 1], motion[0, 0] + motion[1, 1]))
    position_deg = np.degrees(
        0.2 * np.sqrt(2.0 / 40.0) / DEFAULT_CAMERA.focal_px[0]
    )  # of 40 stars, in two images
    assert reported.translation_deg == pytest.approx(shift, abs=5.0 * position_deg)
    assert reported.rotation_deg == pytest.approx(
        turn, abs=5.0 * position_deg / 0.2
    )  # 0.2 rad from the boresight


def test_rsi_with_a_wrong_prediction_searches_the_whole_sky():
    rng = np.random.default_rng(7)
    attitude = Attitude.from_radec_roll(80.0, 10.0, 0.0)
    recursion = rsi()
    recursion.identify(*points(rng, attitude))
    elsewhere = Attitude.from_radec_roll(150.0, 30.0, 0.0)  # no motion that the filter could measure
    solution = recursion.track(*points(rng, elsewhere), Attitude.from_radec_roll(250.0, -40.0, 0.0))
    assert solution.valid
    assert solution.attitude.error_to(elsewhere).total_arcsec < RIGHT_ARCSEC
    assert solution.mode == "lost_in_space"
    assert recursion.statistics.triggers == 1


def test_a_change_of_exposure_does_not_lose_the_attitude():
    xy, flux = points(np.random.default_rng(8), Attitude.from_radec_roll(80.0, 10.0, 0.0))
    lsi().reset()
    assert lsi().identify(xy, flux).valid
    before = lsi().zero_point
    assert lsi().identify(xy, 10.0 * flux).valid
    assert lsi().zero_point == pytest.approx(before + 2.5, abs=1e-6)


def test_after_a_reset_the_answer_is_the_first_one():
    rng = np.random.default_rng(8)
    before, frame = (points(rng, random_attitude(rng)) for _ in range(2))
    recursion = rsi()
    for identifier, search in ((lsi(), lsi()), (recursion, recursion.lsi)):
        reports = []
        for _ in range(2):
            identifier.reset()
            assert search.zero_point is None
            assert identifier.identify(*frame).valid
            reports.append((search.last_report.tried, search.last_report.zero_point))
            assert identifier.identify(*before).valid
        assert reports[0] == reports[1]


def test_a_given_zero_point_is_kept():
    identifier = LsiIdentifier(zero_point=20.3)
    xy, flux = points(np.random.default_rng(8), Attitude.from_radec_roll(80.0, 10.0, 0.0))
    assert identifier.identify(xy, flux).valid
    assert identifier.zero_point == 20.3
    assert not identifier.identify(xy, 10.0 * flux).valid
    identifier.reset()
    assert identifier.zero_point == 20.3


def test_both_are_star_identifiers_by_name():
    for name in ("lsi", "rsi"):
        assert isinstance(make_identifier(name), StarIdentifier)


@pytest.mark.parametrize("make", [lsi, rsi])
def test_bad_input(make):
    identifier = make()
    assert identifier.identify(np.empty((0, 2)), np.empty(0)).reason is Reason.TOO_FEW_STARS
    assert identifier.identify([[400.0, 400.0]], [1000.0]).reason is Reason.TOO_FEW_STARS
    rng = np.random.default_rng(9)
    noise = identifier.identify(rng.uniform(0.0, 936.0, (60, 2)), rng.uniform(1e4, 1e6, 60))
    assert not noise.valid
    with pytest.raises(StaridError, match="finite"):
        identifier.identify([[np.nan, 1.0]], [1.0])
    with pytest.raises(StaridError, match=r"must be \(n, 2\) and \(n,\), not "):
        identifier.identify([[1.0, 1.0]], [1.0, 2.0])


@pytest.mark.parametrize("window", [np.nan, -1.0, 0.0, np.inf])
def test_an_invalid_window_is_rejected(window):
    recursion = rsi()
    with pytest.raises(StaridError, match=r"tracking window_px: must be a positive number of pixels, not "):
        recursion.track(np.empty((0, 2)), np.empty(0), Attitude.identity(), window_px=window)


def test_a_window_wider_than_the_field_searches_the_field():
    recursion = rsi()
    recursion.track(np.empty((0, 2)), np.empty(0), Attitude.identity(), window_px=1e5)
    assert recursion.statistics.region_sum_deg == recursion.lsi.database.parameters.fov_deg


@pytest.mark.parametrize("options", [{}, {"feature_limit": 5.0}])
def test_an_empty_catalogue_is_rejected(options):
    catalog = load_catalog()
    nothing = catalog.subset(np.zeros(len(catalog), dtype=bool))
    with pytest.raises(StaridError, match="identifier catalog: contains no stars"):
        LsiIdentifier(DEFAULT_CAMERA, nothing, **options)


CAMERA_DATABASE = DatabaseParameters.for_camera(DEFAULT_CAMERA, overlap=0.5, kappa=5.0)


@pytest.mark.parametrize(
    ("parameters", "epoch", "words"),
    [
        (
            DatabaseParameters.for_camera(Camera.from_fov(30.0), overlap=0.5, kappa=5.0),
            2026.0,
            "another camera",
        ),
        (DatabaseParameters(overlap=0.5), 2026.0, "is planar"),
        (
            dataclasses.replace(CAMERA_DATABASE, direction="faintest", kappa=11.5),
            2026.0,
            "circles of the brightest",
        ),
        (dataclasses.replace(CAMERA_DATABASE, band="hp"), 2026.0, "has hp magnitudes"),
        (CAMERA_DATABASE, 1991.25, "another catalogue or epoch"),
    ],
)
def test_a_database_that_does_not_fit_is_rejected(tmp_path, parameters, epoch, words):
    save_database(build_database(load_catalog(epoch=epoch), parameters), tmp_path / "other.db")
    with pytest.raises(DatabaseError, match=rf"other\.db .*{words}"):
        LsiIdentifier(database=tmp_path / "other.db")


def test_a_database_that_fits_is_used(tmp_path):
    save_database(build_database(load_catalog(), CAMERA_DATABASE), tmp_path / "mine.db")
    assert LsiIdentifier(database=tmp_path / "mine.db").database.parameters == CAMERA_DATABASE


def test_an_unwritable_folder_only_prevents_caching_the_database(tmp_path, monkeypatch, caplog):
    catalog = load_catalog()
    (tmp_path / "file").touch()
    monkeypatch.setenv("STARHIL_CACHE_DIR", str(tmp_path / "file" / "cache"))
    assert obtain_database(catalog, CAMERA_DATABASE, cache=True).parameters == CAMERA_DATABASE
    assert "cannot be written" in caplog.text


def test_a_cached_database_that_cannot_be_read_is_built_again(tmp_path, monkeypatch, caplog):
    catalog = load_catalog()
    monkeypatch.setenv("STARHIL_CACHE_DIR", str(tmp_path))
    made = obtain_database(catalog, CAMERA_DATABASE, cache=True)
    (file,) = tmp_path.glob("features-*.bin")
    whole = file.read_bytes()
    file.write_bytes(whole[:-1])
    np.testing.assert_array_equal(
        obtain_database(catalog, CAMERA_DATABASE, cache=True).features, made.features
    )
    assert "truncated" in caplog.text
    assert file.read_bytes() == whole

    def refuse(path):
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, "is_file", refuse)
    assert obtain_database(catalog, CAMERA_DATABASE, cache=True).cells == made.cells
    assert "Permission denied" in caplog.text
