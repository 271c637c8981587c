"""The thesis's filter as its program ran it, against OpenCV and a published confusion matrix."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from starid.identification.thesis.cme import matched_motion
from starid.identification.thesis.false_stars import ObservedFrame
from starid.identification.thesis.matlab_filter import MatlabFilter, affine_inliers, trials_needed
from starid.identification.thesis.metrics import Confusion
from starid.lab.simulation import PIXEL_DEG, NoiseModel, moved_frames, turned

pytestmark = pytest.mark.long

MAGNITUDES = np.array([0.5, 2.91, 1.93, 2.85, 1.58, 0.46, 1.29])
POSITIONS = np.array(
    [[-19.6, -4.7], [-12.7, 10.4], [-9.0, 4.3], [3.4, -3.9], [5.2, 19.8], [6.4, -6.9], [7.9, 15.9]]
)


@pytest.mark.parametrize("seed", range(5))
def test_outliers_are_those_of_opencv(seed):
    rng = np.random.default_rng(seed)
    before = rng.uniform(-400.0, 400.0, (30, 2))
    now = before @ np.array([[0.99, 0.04], [-0.05, 1.01]]).T + [12.0, -7.0]
    now[:9] += rng.choice([-1.0, 1.0], (9, 2)) * rng.uniform(5.0, 300.0, (9, 2))
    inliers = np.zeros(30, dtype=np.bool_)
    assert affine_inliers(before, now, 1.5, seed, inliers)
    _, expected = cv2.estimateAffine2D(before, now, method=cv2.RANSAC, ransacReprojThreshold=1.5)
    np.testing.assert_array_equal(inliers, expected.ravel() > 0)
    assert inliers.sum() == 21


@pytest.mark.parametrize(("inliers", "matches", "trials"), [(7, 7, 0), (5, 7, 11), (3, 6, 35), (3, 12, 293)])
def test_number_of_trials_at_99_percent_confidence(inliers, matches, trials):
    """⌈log(0.01)/log(1 − (inliers/matches)³)⌉."""
    assert trials_needed(inliers, matches) == trials


@pytest.mark.parametrize("matches", [0, 2])
def test_fewer_than_three_matches_have_no_motion(matches):
    inliers = np.ones(matches, dtype=np.bool_)
    assert not affine_inliers(POSITIONS[:matches], POSITIONS[:matches], 1.5, 1, inliers)
    assert not inliers.any()


def test_matches_in_a_line_have_no_motion():
    line = np.column_stack([np.arange(5.0), 2.0 * np.arange(5.0)])
    inliers = np.ones(5, dtype=np.bool_)
    assert not affine_inliers(line, line, 1.5, 1, inliers)
    assert not inliers.any()


def test_a_star_two_pixels_off_is_not_a_true_star():
    now = turned(POSITIONS, 1.0) + np.array([0.5, -0.3])
    now[3, 0] += 2.0 * PIXEL_DEG
    before, later = ObservedFrame(MAGNITUDES, POSITIONS), ObservedFrame(MAGNITUDES, now)
    result = MatlabFilter(PIXEL_DEG)(before, later)
    assert np.flatnonzero(~result.true_now).tolist() == [3]
    motion = matched_motion(before, later, result.matches, model="affine")
    assert motion is not None
    assert motion.rotation_deg == pytest.approx(1.0, abs=1e-9)


def test_a_frame_with_more_objects_in_the_cluster_than_the_other_is_lost():
    """The false object of the first frame is a copy of a star at the same place: its cluster has eight objects."""
    double = ObservedFrame(np.append(MAGNITUDES, 0.46), np.vstack([POSITIONS, POSITIONS[5]]))
    later = ObservedFrame(MAGNITUDES, turned(POSITIONS, 1.0))
    assert not MatlabFilter(PIXEL_DEG)(double, later).true_now.any()
    assert MatlabFilter(PIXEL_DEG, loses_unequal=False)(double, later).true_now.all()


@pytest.mark.parametrize(("factor", "negatives"), [(1, 213), (3, 888), (5, 1341)])
def test_recall_of_table_a_2(factor, negatives):
    """Position noise without false stars: 6 620 stars in 1 000 frames, 3 standard errors of the difference."""
    noise = NoiseModel(position_sigma_px=np.sqrt(factor) / 3.0, whole_pixels=True)
    frames = moved_frames(np.random.default_rng(1), MAGNITUDES, POSITIONS, noise, count=1000, radius_deg=21.0)
    first = next(frames)
    found = MatlabFilter(PIXEL_DEG)
    lost = []
    for frame in frames:
        counts = Confusion.of(found(first.observed, frame.observed).true_now, frame.is_star)
        lost.append(counts.false_negative)
    error = np.std(lost) * np.sqrt(2.0 * len(lost))
    assert abs(sum(lost) - negatives) < 3.0 * error
