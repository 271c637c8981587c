"""Tracking: near a prediction, through outliers and losses, and missing stars."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from starid.attitude import Attitude, propagate, random_attitude
from starid.camera import DEFAULT_CAMERA
from starid.errors import StaridError
from starid.identification.geometric.identifier import Effort
from starid.identification.solution import Reason, Solution
from starid.identification.tracker import Tracker
from starid.identification.undetected import missing_stars
from starid.lab.leaderboard.scenes import SceneSettings
from tests.starid.identification.geometric.sky_points import identifier, maker, sky

RIGHT_ARCSEC = 60.0
AT = Attitude.from_radec_roll(80.0, 10.0, 30.0)
RATE = np.radians([0.3, -0.4, 0.5])
PIXEL = DEFAULT_CAMERA.pixel_scale_rad


@pytest.mark.parametrize("offset_px", [(0.0, 0.0), (10.0, 0.0), (0.0, -15.0)])
@pytest.mark.parametrize("roll_deg", [0.0, 1.0])
def test_a_prediction_within_the_window_is_followed(offset_px: tuple[float, float], roll_deg: float) -> None:
    xy, flux, _ = sky(AT)
    predicted = AT.rotated([offset_px[0] * PIXEL, offset_px[1] * PIXEL, math.radians(roll_deg)])
    solution = identifier().track(xy, flux, predicted)
    assert solution.mode == "tracking"
    assert solution.attitude.error_to(AT).total_arcsec < RIGHT_ARCSEC
    same = identifier().track(xy, flux, predicted.quaternion_xyzw)
    assert same.quaternion_xyzw == pytest.approx(solution.quaternion_xyzw, abs=1e-12)


@pytest.mark.parametrize("off_deg", [5.0, 90.0, 180.0])
def test_a_prediction_outside_the_window_is_invalid(off_deg: float) -> None:
    xy, flux, _ = sky(AT)
    solution = identifier().track(xy, flux, AT.rotated([math.radians(off_deg), 0.0, 0.0]))
    assert (solution.valid, solution.reason) == (False, Reason.PREDICTION_LOST)


def test_a_wide_window_follows_a_jump() -> None:
    xy, flux, _ = sky(AT)
    predicted = AT.rotated([70.0 * PIXEL, 0.0, 0.0])
    assert not identifier().track(xy, flux, predicted).valid
    solution = identifier().track(xy, flux, predicted, window_px=100.0)
    assert solution.attitude.error_to(AT).total_arcsec < RIGHT_ARCSEC


def test_random_points_are_not_tracked() -> None:
    rng = np.random.default_rng(3)
    for _ in range(100):
        n = int(rng.integers(30, 151))
        points, flux = rng.uniform(0.0, 936.0, (n, 2)), 10.0 ** rng.uniform(0.0, 1.5, n)
        assert not identifier().track(points, flux, random_attitude(rng)).valid


def test_verification_requires_more_than_tracking() -> None:
    xy, flux, _ = sky(AT)
    tracked = identifier().track(xy, flux, AT, window_px=12.0)
    verified = identifier().verify(xy, flux, AT, window_px=12.0)
    assert verified.quaternion_xyzw == pytest.approx(tracked.quaternion_xyzw, abs=1e-12)
    assert verified.probability_false >= tracked.probability_false
    few = xy[:4], flux[:4], AT
    loose = identifier().verify(*few, window_px=12.0).probability_false
    between = math.sqrt(loose * identifier().track(*few, window_px=12.0).probability_false)
    strict = identifier().with_camera(
        DEFAULT_CAMERA,
        effort=Effort(max_false_probability=between, max_false_probability_tracking=between),
    )
    assert strict.track(*few, window_px=12.0).valid
    assert not strict.verify(*few, window_px=12.0).valid


def test_outliers_are_rejected() -> None:
    xy, flux, hip = sky(AT, sigma_px=0.1)
    rng = np.random.default_rng(4)
    spoiled = xy.copy()
    spoiled[:5] += rng.uniform(3.0, 6.0, (5, 2))
    solution = identifier().track(spoiled, flux, AT)
    assert solution.attitude.error_to(AT).cross_boresight_arcsec < 6.0 * solution.cross_boresight_sigma_arcsec
    right = solution.hip == hip[solution.detection_index]
    assert not np.isin(solution.detection_index[right], np.arange(5)).any()


def test_an_outlier_among_few_stars_is_rejected() -> None:
    xy, flux, _ = sky(AT, limit=3.6, sigma_px=0.1)
    spoiled = xy[:14].copy()
    spoiled[3] += 2.5
    solution = identifier().track(spoiled, flux[:14], AT)
    assert solution.valid
    assert 3 not in solution.detection_index


def test_tracker_estimates_the_rate_and_follows() -> None:
    tracker = Tracker(identifier())
    attitude = AT
    modes = []
    for i in range(20):
        solution = tracker.update(*sky(attitude, i)[:2], 0.5 * i)
        assert solution.attitude.error_to(attitude).total_arcsec < RIGHT_ARCSEC
        modes.append(solution.mode)
        attitude = propagate(attitude, RATE, 0.5)
    assert modes[0] == "lost_in_space"
    assert set(modes[2:]) == {"tracking"}
    assert tracker.rate_rad_s == pytest.approx(RATE, abs=5e-4)


def test_tracker_falls_back_to_lost_in_space_and_resumes_tracking() -> None:
    tracker = Tracker(identifier())
    jumped = AT.rotated([0.0, 1.0, 0.3])
    modes = []
    for i, attitude in enumerate([AT, AT, jumped, jumped, jumped]):
        solution = tracker.update(*sky(attitude, i)[:2], float(i))
        assert solution.attitude.error_to(attitude).total_arcsec < RIGHT_ARCSEC
        modes.append(solution.mode)
    # the jump also affects the rate, which costs one more frame
    assert modes == ["lost_in_space", "tracking", "lost_in_space", "lost_in_space", "tracking"]


def test_tracker_is_invalid_at_once_and_valid_again_after_a_blind_frame() -> None:
    tracker = Tracker(identifier())
    rng = np.random.default_rng(6)
    assert tracker.update(*sky(AT, 1)[:2], 0.0).valid
    assert tracker.update(*sky(AT, 2)[:2], 1.0).mode == "tracking"
    blind = tracker.update(rng.uniform(0.0, 936.0, (60, 2)), np.ones(60), 2.0)
    assert not blind.valid
    assert blind.rate_rad_s is None
    after = tracker.update(*sky(AT, 3)[:2], 3.0)
    assert (after.valid, after.mode) == (True, "tracking")


def test_tracker_forgets_after_the_longest_gap_and_on_reset() -> None:
    tracker = Tracker(identifier(), longest_gap_s=5.0)
    tracker.update(*sky(AT, 1)[:2], 0.0)
    assert tracker.predict(5.0) is not None
    assert tracker.predict(5.1) is None
    assert tracker.predict(-0.1) is None
    tracker.reset()
    assert tracker.predict(1.0) is None


def test_tracker_accepts_a_rate_from_another_source() -> None:
    tracker = Tracker(identifier())
    tracker.update(*sky(AT, 1)[:2], 0.0)
    turned = propagate(AT, RATE, 4.0)
    solution = tracker.update(*sky(turned, 2)[:2], 4.0, rate_hint_rad_s=RATE)
    assert solution.mode == "tracking"
    assert solution.attitude.error_to(turned).total_arcsec < RIGHT_ARCSEC


def test_tracker_rejects_an_invalid_longest_gap() -> None:
    with pytest.raises(StaridError, match="longest_gap_s"):
        Tracker(identifier(), longest_gap_s=0.0)


def test_missing_stars_are_reported_and_no_others() -> None:
    xy, flux, hip = sky(AT, limit=5.5)
    inner = np.flatnonzero((np.minimum(xy, 936.0 - xy) > 20.0).all(axis=1))
    apart = np.linalg.norm(xy[inner, None] - xy, axis=2)
    lost = inner[np.sort(apart, axis=1)[:, 1] > 15.0][[2, 5, 9]]
    kept = np.setdiff1d(np.arange(len(hip)), lost)
    solution = identifier().identify(xy[kept], flux[kept])
    found = missing_stars(solution, DEFAULT_CAMERA, identifier().stars, xy[kept])
    assert found.hip.tolist() == hip[lost].tolist()
    assert found.xy_px == pytest.approx(xy[lost], abs=2.0)
    assert 5.0 <= found.complete_to <= 5.5
    complete = missing_stars(identifier().identify(xy, flux), DEFAULT_CAMERA, identifier().stars, xy)
    assert complete.hip.size == 0


def test_missing_stars_need_a_valid_solution_and_a_radius() -> None:
    xy, flux, _ = sky(AT)
    stars = identifier().stars
    with pytest.raises(StaridError, match="no_match"):
        missing_stars(Solution.invalid(Reason.NO_MATCH), DEFAULT_CAMERA, stars, xy)
    with pytest.raises(StaridError, match="radius_px"):
        missing_stars(identifier().identify(xy, flux), DEFAULT_CAMERA, stars, xy, radius_px=0.0)


def test_the_attitude_weights_errors_along_and_across_a_trail_by_their_covariance() -> None:
    """Compared with weighted least squares by `scipy.optimize`."""
    xy, flux, _ = sky(AT, limit=4.5)
    rng = np.random.default_rng(12)
    angle, count = rng.uniform(0.0, math.pi, len(xy)), len(xy)
    axes = np.stack([np.cos(angle), np.sin(angle), -np.sin(angle), np.cos(angle)], axis=1).reshape(-1, 2, 2)
    sigma = np.column_stack([rng.uniform(0.5, 1.0, count), rng.uniform(0.02, 0.1, count)])
    measured = xy + np.einsum("nij,ni->nj", axes, sigma * rng.standard_normal((count, 2)))
    covariance = np.einsum("nij,ni,nik->njk", axes, sigma**2, axes)
    solution = identifier().track(measured, flux, AT, covariance)
    used, stars = solution.detection_index, identifier().stars
    icrs = stars.vectors[stars.index_of(solution.hip)]

    def residuals(turn: np.ndarray) -> np.ndarray:
        off = measured[used] - DEFAULT_CAMERA.project(AT.rotated(turn).to_sensor(icrs))[0]
        return (np.einsum("nij,nj->ni", axes[used], off) / sigma[used]).ravel()

    best = least_squares(residuals, np.zeros(3), x_scale=1e-6, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    assert len(used) > 0.9 * count
    assert solution.attitude.error_to(AT.rotated(best.x)).total_arcsec < 0.05
    given = identifier().verify(measured, flux, AT, covariance, window_px=12.0)
    assert given.quaternion_xyzw == pytest.approx(solution.quaternion_xyzw, abs=1e-12)


def test_a_covariance_that_is_not_positive_is_named() -> None:
    xy, flux, _ = sky(AT)
    errors = np.tile([[1.0, 2.0], [2.0, 1.0]], (len(xy), 1, 1))
    with pytest.raises(StaridError, match="finite and positive"):
        identifier().track(xy, flux, AT, errors)


FEW = 150
SCENE = SceneSettings(5.5, 0.5)


def tracked(
    settings: SceneSettings, prediction_px: float, *, with_errors: bool = True, window_px: float | None = None
) -> list[tuple[Solution, float]]:
    """Solutions of scenes near a prediction, and the error of each in units of its own covariance."""
    rng = np.random.default_rng(17)
    answers = []
    for _ in range(FEW):
        scene = maker().scene(settings, rng)
        predicted = scene.attitude.rotated(prediction_px * PIXEL * rng.standard_normal(3))
        errors = np.full(len(scene.flux), settings.sigma_px) if with_errors else None
        solution = identifier().track(scene.xy_px, scene.flux, predicted, errors, window_px=window_px)
        off = math.nan
        if solution.valid:
            error = solution.attitude.error_to(scene.attitude).rotation_vector_rad
            off = math.sqrt(float(error @ np.linalg.solve(solution.covariance, error)))
        answers.append((solution, off))
    return answers


@pytest.mark.parametrize("with_errors", [False, True])
def test_three_stars_near_a_prediction_are_enough(with_errors: bool) -> None:
    answers = tracked(replace(SCENE, kept=3), 3.0, with_errors=with_errors)
    assert sum(solution.valid for solution, _ in answers) >= 0.95 * FEW
    right = [off for solution, off in answers if solution.valid]
    # a Student distribution with 3 degrees of freedom has long tails, with 13 it does not
    assert max(right) < (30.0 if not with_errors else 7.0)
    assert all(solution.star_count == 3 for solution, _ in answers if solution.valid)


def test_two_stars_are_enough_if_errors_and_window_are_small() -> None:
    found = tracked(replace(SCENE, sigma_px=0.05, kept=2), 0.3, window_px=2.0)
    assert sum(solution.valid for solution, _ in found) >= 0.5 * FEW
    assert max(off for solution, off in found if solution.valid) < 7.0


def test_two_stars_in_a_wide_window_or_of_unknown_error_are_not_enough() -> None:
    wide = tracked(replace(SCENE, kept=2), 3.0)
    assert not any(solution.valid for solution, _ in wide)
    assert {solution.reason for solution, _ in wide} == {Reason.PREDICTION_LOST}
    unknown = tracked(replace(SCENE, sigma_px=0.05, kept=2), 0.3, with_errors=False, window_px=2.0)
    assert {solution.reason for solution, _ in unknown} == {Reason.TOO_FEW_STARS}


@pytest.mark.parametrize(("true", "false"), [(0, 3), (1, 2), (1, 1), (0, 2)])
@pytest.mark.parametrize(("sigma_px", "prediction_px", "window_px"), [(0.5, 3.0, 20.0), (0.05, 0.3, 2.0)])
def test_false_stars_do_not_make_an_answer_with_one_true_star(
    true: int, false: int, sigma_px: float, prediction_px: float, window_px: float
) -> None:
    settings = SceneSettings(5.5, sigma_px, kept=max(true, 1), missing_stars=1 - true, false_stars=false)
    found = tracked(settings, prediction_px, window_px=window_px)
    assert not any(solution.valid for solution, _ in found)


@pytest.mark.parametrize(("least", "most", "answered"), [(0.0, 0.05, False), (1.0, 1.2, True)])
def test_a_pair_that_fits_both_ways_round_is_not_identified(
    least: float, most: float, answered: bool
) -> None:
    lenient = identifier().with_camera(DEFAULT_CAMERA, effort=Effort(max_false_probability_tracking=1e-3))
    stars = identifier().stars.brighter_than(4.0)
    separation_px = np.arccos(np.clip(stars.vectors @ stars.vectors.T, -1.0, 1.0)) / PIXEL
    unlike = np.abs(stars.v[:, None] - stars.v[None, :])
    near = (separation_px > 110.0) & (separation_px < 130.0)
    answers = []
    for pair in np.argwhere(near & (unlike >= least) & (unlike <= most))[:10]:
        x, y, z = stars.vectors[pair].sum(axis=0)
        ra, dec = math.degrees(math.atan2(y, x)), math.degrees(math.atan2(z, math.hypot(x, y)))
        attitude = Attitude.from_radec_roll(ra, dec, 0.0)
        xy, _ = DEFAULT_CAMERA.project(attitude.to_sensor(stars.vectors[pair]))
        flux, errors = 10.0 ** (-0.4 * stars.v[pair]), np.full(2, 1e-4)
        # within 140 px each star could be the other
        answers.append(lenient.track(xy, flux, attitude, errors, window_px=140.0).valid)
    assert len(answers) >= 6
    assert sum(answers) >= 0.8 * len(answers) if answered else not any(answers)


def test_three_stars_are_not_enough_lost_in_space() -> None:
    scene = maker().scene(replace(SCENE, sigma_px=0.05, kept=3), np.random.default_rng(2))
    errors = np.full(3, 0.05)
    assert identifier().identify(scene.xy_px, scene.flux, errors).reason is Reason.TOO_FEW_STARS
    few = identifier().verify(scene.xy_px, scene.flux, scene.attitude, errors, window_px=12.0)
    assert few.reason is Reason.TOO_FEW_STARS
    assert identifier().track(scene.xy_px, scene.flux, scene.attitude, errors).valid


def test_a_narrower_window_lowers_the_probability_of_chance_agreement() -> None:
    scene = maker().scene(replace(SCENE, kept=3), np.random.default_rng(2))
    errors = np.full(3, 0.5)
    bounds = [
        identifier()
        .track(scene.xy_px, scene.flux, scene.attitude, errors, window_px=window)
        .probability_false
        for window in (5.0, 10.0, 20.0)
    ]
    assert 0.0 < bounds[0] < bounds[1] < bounds[2] < 1e-5
