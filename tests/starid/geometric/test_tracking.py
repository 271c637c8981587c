"""Tracking: near a prediction, through outliers and losses, and missing stars."""

from __future__ import annotations

import math

import numpy as np
import pytest

from starid.attitude import Attitude, propagate, random_attitude
from starid.camera import DEFAULT_CAMERA
from starid.errors import StaridError
from starid.geometric.identifier import Effort, Identifier
from starid.missing import missing_stars
from starid.solution import Reason, Solution
from starid.tracker import Tracker
from tests.starid.geometric.sky_points import identifier, sky

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
def test_a_prediction_elsewhere_is_lost(off_deg: float) -> None:
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


def test_verifying_asks_more_than_tracking() -> None:
    xy, flux, _ = sky(AT)
    tracked = identifier().track(xy, flux, AT, window_px=12.0)
    verified = identifier().verify(xy, flux, AT, window_px=12.0)
    assert verified.quaternion_xyzw == pytest.approx(tracked.quaternion_xyzw, abs=1e-12)
    assert verified.probability_false >= tracked.probability_false
    few = xy[:4], flux[:4], AT
    loose = identifier().verify(*few, window_px=12.0).probability_false
    between = math.sqrt(loose * identifier().track(*few, window_px=12.0).probability_false)
    strict = Identifier(effort=Effort(max_false_probability=between, max_false_probability_tracking=between))
    assert strict.track(*few, window_px=12.0).valid
    assert not strict.verify(*few, window_px=12.0).valid


def test_outliers_are_dropped() -> None:
    xy, flux, hip = sky(AT, sigma_px=0.1)
    rng = np.random.default_rng(4)
    spoiled = xy.copy()
    spoiled[:5] += rng.uniform(3.0, 6.0, (5, 2))
    solution = identifier().track(spoiled, flux, AT)
    assert solution.attitude.error_to(AT).cross_boresight_arcsec < 6.0 * solution.cross_boresight_sigma_arcsec
    right = solution.hip == hip[solution.detection_index]
    assert not np.isin(solution.detection_index[right], np.arange(5)).any()


def test_an_outlier_among_few_stars_is_dropped() -> None:
    xy, flux, _ = sky(AT, limit=3.6, sigma_px=0.1)
    spoiled = xy[:14].copy()
    spoiled[3] += 2.5
    solution = identifier().track(spoiled, flux[:14], AT)
    assert solution.valid
    assert 3 not in solution.detection_index


def test_tracker_knows_the_rate_and_follows() -> None:
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


def test_tracker_falls_back_to_lost_in_space_and_takes_up_the_track_again() -> None:
    tracker = Tracker(identifier())
    jumped = AT.rotated([0.0, 1.0, 0.3])
    modes = []
    for i, attitude in enumerate([AT, AT, jumped, jumped, jumped]):
        solution = tracker.update(*sky(attitude, i)[:2], float(i))
        assert solution.attitude.error_to(attitude).total_arcsec < RIGHT_ARCSEC
        modes.append(solution.mode)
    # the jump also spoils the rate, which costs one more frame
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


def test_tracker_takes_a_rate_from_elsewhere() -> None:
    tracker = Tracker(identifier())
    tracker.update(*sky(AT, 1)[:2], 0.0)
    turned = propagate(AT, RATE, 4.0)
    solution = tracker.update(*sky(turned, 2)[:2], 4.0, rate_hint_rad_s=RATE)
    assert solution.mode == "tracking"
    assert solution.attitude.error_to(turned).total_arcsec < RIGHT_ARCSEC


def test_tracker_refuses_a_gap_that_is_none() -> None:
    with pytest.raises(StaridError, match="longest_gap_s"):
        Tracker(identifier(), longest_gap_s=0.0)


def test_missing_stars_are_named_and_no_others() -> None:
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
