"""False-star filters and camera motion, against scikit-learn and the truth of simulated frames."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from sklearn.cluster import DBSCAN

from starid.identification.thesis.cme import estimate_motion
from starid.identification.thesis.false_stars import FilterError, ObservedFrame
from starid.identification.thesis.fsf import (
    ClusterFilter,
    density_clusters,
    disparity_list,
    pair_count,
    pair_features,
)
from starid.identification.thesis.metrics import Confusion
from starid.identification.thesis.scalable_filter import TrackFilter, TrackFilterSettings
from starid.lab.simulation import PIXEL_DEG, NoiseModel, moved_frames, turned

pytestmark = pytest.mark.long

RADIUS = 21.0


def seven_stars():
    positions = np.array(
        [[-19.6, -4.7], [-12.7, 10.4], [-9.0, 4.3], [3.4, -3.9], [5.2, 19.8], [6.4, -6.9], [7.9, 15.9]]
    )
    return np.array([0.5, 2.91, 1.93, 2.85, 1.58, 0.46, 1.29]), positions


@pytest.mark.parametrize("seed", range(6))
def test_clusters_match_scikit_learn(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(3, 9))
    brightness, positions = rng.uniform(0.0, 3.0, n), rng.uniform(-20.0, 20.0, (n, 2))
    before, now = np.empty((pair_count(n), 3)), np.empty((pair_count(n), 3))
    members = np.empty((pair_count(n), 2), dtype=np.int64)
    pair_features(brightness, positions, before, members)
    pair_features(brightness, turned(positions, 2.0) + rng.normal(0.0, 0.1, (n, 2)), now, members)
    disparities = np.empty((pair_count(n) ** 2, 3))
    disparity_list(before, now, disparities)
    least = 0.5 * n
    expected = DBSCAN(eps=0.4, min_samples=int(np.ceil(least))).fit(disparities).labels_
    np.testing.assert_array_equal(density_clusters(disparities, 0.4, least), expected)


@pytest.mark.parametrize("spread", [0.01, 0.3, 5.0, 500.0])
def test_clusters_of_any_extent_match_scikit_learn(spread):
    points = np.random.default_rng(8).normal(0.0, spread, (400, 3))
    points[::3] = np.round(points[::3] / 0.4) * 0.4
    expected = DBSCAN(eps=0.4, min_samples=3).fit(points).labels_
    np.testing.assert_array_equal(density_clusters(points, 0.4, 3.0), expected)


def test_no_points_give_no_clusters():
    assert density_clusters(np.empty((0, 3)), 0.4, 3.0).size == 0


@pytest.mark.parametrize("false_stars", [0, 3, 5])
def test_without_noise_all_stars_are_found_and_the_motion_is_exact(false_stars):
    noise = NoiseModel(false_stars=false_stars, magnitude_range=(-1.5, 3.0))
    rng = np.random.default_rng(4)
    frames = moved_frames(rng, *seven_stars(), noise, count=60, radius_deg=RADIUS)
    first, total = next(frames), Confusion()
    cluster = ClusterFilter()
    distances = []
    for frame in frames:
        result = cluster(first.observed, frame.observed)
        total += Confusion.of(result.true_now, frame.is_star)
        motion = estimate_motion(
            first.observed.positions[result.matches[:, 0]], frame.observed.positions[result.matches[:, 1]]
        )
        distances.append(motion.mean_distance_deg)
        assert motion.rotation_deg == pytest.approx(frame.rotation_deg, abs=1e-9)
        np.testing.assert_allclose(motion.translation_deg, frame.shift_deg, atol=1e-9)
    assert total.recall == 1.0
    assert total.precision > 0.98
    assert np.median(distances) < 1e-13


def test_scalable_filter_at_the_largest_published_noise():
    noise = NoiseModel.of("both", 5.0, false_stars=5, magnitude_range=(-1.5, 3.0))
    settings = TrackFilterSettings(
        position_sigma_deg=5.0 * PIXEL_DEG,
        brightness_sigma=5.0 * noise.magnitude_per_unit,
        max_rotation_deg=6.0,
        max_shift_deg=2.5,
    )
    track, total = TrackFilter(settings), Confusion()
    frames = moved_frames(np.random.default_rng(8), *seven_stars(), noise, count=400, radius_deg=RADIUS)
    track.update(next(frames).observed)
    for frame in frames:
        total += Confusion.of(track.update(frame.observed).true_now, frame.is_star)
    assert total.recall >= 0.99
    assert total.precision >= 0.998


@pytest.mark.parametrize("kind", ["transient", "stationary", "drifting"])
def test_scalable_filter_with_150_true_and_50_false_stars(kind):
    rng = np.random.default_rng(11)
    sky, magnitude = rng.uniform(-30.0, 30.0, (306, 2)), rng.uniform(0.0, 5.5, 306)
    hot, hot_magnitude = rng.uniform(-20.0, 20.0, (50, 2)), rng.uniform(0.0, 5.5, 50)
    drift = rng.normal(0.0, 0.3, (50, 2))
    sigma = 0.01
    track, total = TrackFilter(TrackFilterSettings(position_sigma_deg=sigma)), Confusion()
    for t in range(40):
        turn, shift = 1.0 * t, np.array([0.15, -0.1]) * t
        stars = turned(sky, turn) + shift
        false = {
            "transient": rng.uniform(-20.0, 20.0, (50, 2)),
            "stationary": hot,
            "drifting": turned(hot + drift * t, turn) + shift,
        }[kind]
        places = np.concatenate([stars, false]) + rng.normal(0.0, sigma, (356, 2))
        values = np.concatenate([magnitude, hot_magnitude]) + rng.normal(0.0, 0.05, 356)
        inside = np.abs(places).max(axis=1) <= 21.0
        is_star = (np.arange(356) < 306)[inside]
        result = track.update(ObservedFrame(values[inside], places[inside]))
        if t >= 4:
            total += Confusion.of(result.true_now, is_star)
    assert total.recall >= 0.98
    assert total.precision >= 0.998


def test_objects_are_followed_through_successive_frames():
    noise = NoiseModel(false_stars=3, magnitude_range=(-1.5, 3.0))
    frames = [
        f.observed
        for f in moved_frames(np.random.default_rng(2), *seven_stars(), noise, count=4, radius_deg=RADIUS)
    ]
    track = TrackFilter(TrackFilterSettings(max_shift_deg=3.0))
    results = [track(before, now) for before, now in itertools.pairwise(frames)]
    assert all(result.true_now.sum() >= 5 for result in results)
    assert all(np.array_equal(np.flatnonzero(r.true_before), np.sort(r.matches[:, 0])) for r in results)


@pytest.mark.parametrize("count", [0, 1])
def test_too_few_objects_are_not_taken_for_stars(count):
    frame = ObservedFrame(np.ones(count), np.zeros((count, 2)))
    for chosen in (ClusterFilter(), TrackFilter()):
        result = chosen(frame, frame)
        assert not result.true_now.any()
        assert result.matches.shape == (0, 2)


def test_invalid_input_is_rejected():
    many = ObservedFrame(np.ones(49), np.random.default_rng(0).uniform(-10.0, 10.0, (49, 2)))
    with pytest.raises(FilterError, match="scalable"):
        ClusterFilter()(many, many)
    with pytest.raises(FilterError, match="not finite"):
        ObservedFrame(np.array([np.nan]), np.zeros((1, 2)))
    with pytest.raises(FilterError, match="at least two"):
        estimate_motion(np.zeros((1, 2)), np.zeros((1, 2)))
    with pytest.raises(FilterError, match="positive"):
        TrackFilterSettings(position_sigma_deg=0.0)


def test_motion_is_robust_to_outliers():
    rng = np.random.default_rng(5)
    before = rng.uniform(-20.0, 20.0, (40, 2))
    now = turned(before, 3.0) + np.array([0.5, -0.2])
    now[:12] = rng.uniform(-20.0, 20.0, (12, 2))
    motion = estimate_motion(before, now, threshold_deg=0.1)
    assert motion.rotation_deg == pytest.approx(3.0, abs=1e-9)
    assert motion.inliers[12:].all()
    np.testing.assert_allclose(motion.apply(before[12:]), now[12:], atol=1e-9)


def affine(positions):
    return positions @ np.array([[1.02, -0.03], [0.05, 0.97]]).T + np.array([0.5, -0.2])


def test_an_affine_motion_is_found_exactly_and_is_robust_to_outliers():
    rng = np.random.default_rng(6)
    before = rng.uniform(-20.0, 20.0, (30, 2))
    now = affine(before)
    now[:6] = rng.uniform(-20.0, 20.0, (6, 2))
    motion = estimate_motion(before, now, threshold_deg=0.1, model="affine")
    assert motion.inliers[6:].all()
    np.testing.assert_allclose(motion.apply(before[6:]), now[6:], atol=1e-9)
    assert motion.mean_distance_deg < 1e-9


def test_an_affine_motion_follows_the_noise_closer_than_a_rigid_one():
    rng = np.random.default_rng(7)
    before = seven_stars()[1]
    ratio = []
    for _ in range(200):
        now = turned(before, 2.0) + rng.normal(0.0, 0.05, before.shape)
        rigid, free = (estimate_motion(before, now, model=model) for model in ("rigid", "affine"))
        ratio.append(free.mean_distance_deg / rigid.mean_distance_deg)
    # residuals scale with the remaining degrees of freedom: 14 − 3 and 14 − 6
    assert np.mean(ratio) == pytest.approx(np.sqrt((14 - 6) / (14 - 3)), abs=0.03)


@pytest.mark.parametrize("before", [np.zeros((2, 2)), np.outer(np.arange(5.0), [1.0, 2.0])])
def test_an_affine_motion_needs_three_stars_in_a_triangle(before):
    with pytest.raises(FilterError, match="three in a triangle"):
        estimate_motion(before, before, model="affine")


def test_an_unknown_model_of_motion_is_rejected():
    with pytest.raises(FilterError, match="model must be rigid or affine"):
        estimate_motion(np.eye(2), np.eye(2), model="projective")


def sky_in_motion(rng, rate_deg, frames):
    """Gnomonic positions, degrees, and magnitudes of the stars of a field of 42° that turns about x; all are true."""
    directions = rng.normal(size=(3000, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    brightness = rng.uniform(0.0, 5.0, len(directions))
    for i in range(frames):
        angle = np.radians(rate_deg * i)
        turn = np.array(
            [
                [1.0, 0.0, 0.0],
                [0.0, np.cos(angle), -np.sin(angle)],
                [0.0, np.sin(angle), np.cos(angle)],
            ]
        )
        seen = directions @ turn.T
        inside = seen[:, 2] > np.cos(np.radians(RADIUS))
        places = np.degrees(seen[inside, :2] / seen[inside, 2:]) + rng.normal(0.0, 0.01, (inside.sum(), 2))
        yield ObservedFrame(brightness[inside], places)


def test_stars_far_from_the_centre_of_a_turning_sphere_are_true():
    removed, removed_in_plane = [], []
    for geometry, counts in (("spherical", removed), ("planar", removed_in_plane)):
        settings = TrackFilterSettings(position_sigma_deg=0.02, max_shift_deg=3.0, geometry=geometry)
        track = TrackFilter(settings)
        frames = list(sky_in_motion(np.random.default_rng(12), 0.5, 15))
        results = [track.update(frame) for frame in frames]
        counts += [float(np.mean(~result.true_now)) for result in results[5:]]
    assert max(removed) < 0.12  # those that have just come into the field
    assert np.mean(removed_in_plane) > 2.0 * np.mean(removed)
