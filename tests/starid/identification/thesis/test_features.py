"""Features against the published worked example, and their behaviour at the edges."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from starid.errors import StaridError
from starid.identification.thesis.database import DatabaseParameters, sky_of
from starid.identification.thesis.features import FeatureError, extract_features
from tests.starid.identification.thesis.thesis_sky import thesis_catalog

pytestmark = pytest.mark.long

PRINTED = 0.005
"""The published numbers have two decimals."""


@pytest.mark.parametrize(
    ("corner", "expected", "theta"),
    [
        ((95.0, -85.0), (26, 11.96, 2.95, 0.37, 5.35), 40.72),
        ((94.4, -85.2), (26, 11.96, 3.54, 0.37, 5.39), 36.84),
        ((92.8, -86.8), (24, 11.99, 5.07, 0.38, 4.80), 29.10),
        ((96.0, -83.6), (26, 11.96, 1.34, 0.37, 5.23), 23.00),
        ((92.8, -83.6), (27, 11.97, 3.42, 0.36, 5.60), 34.76),
    ],
)
def test_published_vectors(corner, expected, theta):
    sky = sky_of(thesis_catalog(), DatabaseParameters())
    vector = sky.features(corner[0] + 20.0, corner[1] + 20.0)
    assert vector.n == expected[0]
    np.testing.assert_allclose(vector.vector[1:], expected[1:], atol=2.0 * PRINTED)
    assert vector.theta_deg == pytest.approx(theta, abs=0.2)


def test_the_sky_and_a_list_of_stars_give_the_same_features():
    sky = sky_of(thesis_catalog(), DatabaseParameters())
    brightness, offsets, source = sky.stars_in_frame(115.0, -65.0)
    direct = extract_features(brightness, offsets)
    np.testing.assert_allclose(direct.vector, sky.features(115.0, -65.0).vector, rtol=1e-12)
    np.testing.assert_array_equal(thesis_catalog().hp[source], brightness)


stars = st.lists(
    st.tuples(st.floats(1.0, 14.0), st.floats(-30.0, 30.0), st.floats(-30.0, 30.0)), min_size=2, max_size=30
)


@settings(deadline=None, derandomize=True, max_examples=30)
@given(stars, st.floats(0.0, 360.0))
def test_rotating_the_frame_changes_only_theta(values, angle):
    a, x, y = np.array(values).T
    turn = math.radians(angle)
    xy = np.column_stack([x, y])
    turned = np.column_stack(
        [math.cos(turn) * x - math.sin(turn) * y, math.sin(turn) * x + math.cos(turn) * y]
    )
    before, after = extract_features(a, xy), extract_features(a, turned)
    rounding = 60.0 * math.sqrt(
        np.finfo(float).eps
    )  # of a standard deviation that is 0, at 60 degrees from the centre
    np.testing.assert_allclose(before.vector, after.vector, atol=rounding)
    if before.r > 1e-3:
        assert (after.theta_rad - before.theta_rad - turn + math.pi) % (2.0 * math.pi) == pytest.approx(
            math.pi, abs=1e-6
        )


@settings(deadline=None, derandomize=True, max_examples=60)
@given(stars)
def test_against_the_definitions_written_with_numpy(values):
    a, x, y = np.array(values).T
    vector = extract_features(a, np.column_stack([x, y]))
    r = np.hypot(x, y)
    assert vector.n == len(a)
    expected = [a.mean(), math.hypot((a * x).sum(), (a * y).sum()) / a.sum(), a.std(ddof=1), r.std(ddof=1)]
    np.testing.assert_allclose(vector.vector[1:], expected, atol=1e-6)


def test_circle_and_square():
    a = np.array([5.0, 5.0, 5.0])
    xy = np.array([[0.0, 9.0], [9.0, 9.0], [11.0, 0.0]])
    assert extract_features(a, xy, half_width=10.0).n == 1
    assert extract_features(a, xy, half_width=10.0, full_field=True).n == 2


def test_one_star_has_no_spread():
    vector = extract_features(np.array([3.0]), np.array([[1.0, 1.0]]))
    assert (vector.n, vector.sigma_A, vector.sigma_r) == (1, 0.0, 0.0)


@pytest.mark.parametrize(
    ("brightness", "offsets"),
    [
        (np.empty(0), np.empty((0, 2))),
        (np.array([np.nan]), np.zeros((1, 2))),
        (np.array([1.0]), np.array([[np.inf, 0.0]])),
        (np.array([1.0, 2.0]), np.zeros((1, 2))),
    ],
)
def test_bad_frames_are_rejected(brightness, offsets):
    with pytest.raises(FeatureError, match=r"^features: "):
        extract_features(brightness, offsets)


def test_a_limit_that_leaves_no_star_is_rejected():
    with pytest.raises(StaridError, match="no star is brightest than"):
        sky_of(thesis_catalog(), DatabaseParameters(kappa=-5.0, direction="brightest"))
