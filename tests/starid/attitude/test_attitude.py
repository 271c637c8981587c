"""Attitude against scipy's rotations and against the definition of roll, over the whole sky."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from starid.attitude import Attitude, interpolate, propagate, random_attitude, rate_between
from starid.errors import StaridError

ROUND_OFF = 1e-13
MICRO_ARCSEC = 1e-6

angles = st.floats(-720.0, 720.0)
declinations = st.one_of(st.floats(-90.0, 90.0), st.sampled_from([-90.0, 90.0, -89.9999999, 89.9999999, 0.0]))


def circle_difference(a: float, b: float) -> float:
    return abs((a - b + 180.0) % 360.0 - 180.0)


def matrix_by_definition(ra_deg: float, dec_deg: float, roll_deg: float) -> np.ndarray:
    """The rows of the matrix, as defined in the conventions."""
    ra, dec, roll = np.radians([ra_deg, dec_deg, roll_deg])
    b = np.array([math.cos(dec) * math.cos(ra), math.cos(dec) * math.sin(ra), math.sin(dec)])
    n = np.array([-math.sin(dec) * math.cos(ra), -math.sin(dec) * math.sin(ra), math.cos(dec)])
    e = np.cross(n, b)
    return np.array([-math.sin(roll) * n - math.cos(roll) * e, -math.cos(roll) * n + math.sin(roll) * e, b])


@given(angles, declinations, angles)
@settings(deadline=None, derandomize=True, max_examples=100)
def test_round_trip_over_the_whole_sky(ra: float, dec: float, roll: float) -> None:
    attitude = Attitude.from_radec_roll(ra, dec, roll)
    np.testing.assert_allclose(attitude.matrix, matrix_by_definition(ra, dec, roll), atol=ROUND_OFF)
    again = Attitude.from_radec_roll(attitude.ra_deg, attitude.dec_deg, attitude.roll_deg)
    assert again.error_to(attitude).total_arcsec < MICRO_ARCSEC
    assert 0.0 <= attitude.ra_deg < 360.0
    assert 0.0 <= attitude.roll_deg < 360.0
    if abs(dec) < 89.9:
        assert circle_difference(attitude.ra_deg, ra) < 1e-9
        assert circle_difference(attitude.roll_deg, roll) < 1e-9
        assert attitude.dec_deg == pytest.approx(dec, abs=1e-10)


@pytest.mark.parametrize("ra", [0.0, 1e-13, -1e-14, 360.0, 359.9999999999999, 180.0, 90.0])
@pytest.mark.parametrize("dec", [90.0, -90.0, 0.0, 45.0])
@pytest.mark.parametrize("roll", [0.0, 360.0, -1e-15, 90.0, 180.0, 359.9999999999])
def test_edges_of_the_ranges(ra: float, dec: float, roll: float) -> None:
    attitude = Attitude.from_radec_roll(ra, dec, roll)
    np.testing.assert_allclose(attitude.matrix, matrix_by_definition(ra, dec, roll), atol=ROUND_OFF)
    assert 0.0 <= attitude.ra_deg < 360.0
    assert 0.0 <= attitude.roll_deg < 360.0


@pytest.mark.parametrize("dec", [90.0, -90.0])
def test_at_a_pole_right_ascension_is_zero_and_roll_has_the_whole_rotation(dec: float) -> None:
    attitude = Attitude.from_radec_roll(123.0, dec, 10.0)
    assert (attitude.ra_deg, attitude.dec_deg) == (0.0, dec)
    expected = 10.0 + 123.0 if dec > 0 else 10.0 - 123.0
    assert circle_difference(attitude.roll_deg, expected) < 1e-9


def test_roll_zero_has_north_up_and_east_left() -> None:
    attitude = Attitude.from_radec_roll(40.0, 20.0, 0.0)
    north = attitude.to_sensor(Attitude.from_radec_roll(40.0, 21.0, 0.0).boresight)
    east = attitude.to_sensor(Attitude.from_radec_roll(41.0, 20.0, 0.0).boresight)
    assert north[1] < 0.0
    assert abs(north[0]) < ROUND_OFF
    assert east[0] < 0.0


def test_roll_turns_north_counter_clockwise_in_the_image() -> None:
    attitude = Attitude.from_radec_roll(40.0, 20.0, 90.0)
    north = attitude.to_sensor(Attitude.from_radec_roll(40.0, 21.0, 0.0).boresight)
    assert north[0] < 0.0, "a quarter turn counter-clockwise brings north from up to left"
    assert abs(north[1]) < ROUND_OFF


def test_quaternion_agrees_with_scipy() -> None:
    rng = np.random.default_rng(1)
    for _ in range(200):
        attitude = random_attitude(rng)
        rotation = Rotation.from_quat(attitude.quaternion_xyzw)
        np.testing.assert_allclose(attitude.matrix, rotation.as_matrix(), atol=ROUND_OFF)
        back = Attitude.from_matrix(rotation.as_matrix())
        np.testing.assert_allclose(back.quaternion_xyzw, attitude.quaternion_xyzw, atol=ROUND_OFF)
        vector = rng.standard_normal(3)
        np.testing.assert_allclose(attitude.to_sensor(vector), rotation.apply(vector), atol=ROUND_OFF)
        np.testing.assert_allclose(attitude.to_icrs(attitude.to_sensor(vector)), vector, atol=ROUND_OFF)


@pytest.mark.parametrize("axis", [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1], [-0.3, 0.2, 0.9]])
def test_half_turns_survive_conversion_to_a_matrix(axis: list[float]) -> None:
    half_turn = Rotation.from_rotvec(math.pi * np.array(axis) / np.linalg.norm(axis))
    attitude = Attitude.from_matrix(half_turn.as_matrix())
    np.testing.assert_allclose(attitude.matrix, half_turn.as_matrix(), atol=ROUND_OFF)


@pytest.mark.parametrize("size", [0.0, 1e-12, 1e-9, 1e-6, 0.01, 1.0, 3.1])
def test_rotated_and_error_are_inverse(size: float) -> None:
    rng = np.random.default_rng(2)
    for _ in range(20):
        attitude = random_attitude(rng)
        axis = rng.standard_normal(3)
        vector = size * axis / np.linalg.norm(axis)
        turned = attitude.rotated(vector)
        expected = Rotation.from_rotvec(-vector).as_matrix() @ attitude.matrix
        np.testing.assert_allclose(turned.matrix, expected, atol=ROUND_OFF)
        error = turned.error_to(attitude)
        np.testing.assert_allclose(error.rotation_vector_rad, vector, rtol=1e-12, atol=1e-15)


def test_error_splits_into_cross_boresight_and_roll() -> None:
    truth = Attitude.from_radec_roll(10.0, 30.0, 50.0)
    error = truth.rotated([0.0, 0.0, math.radians(2.0)]).error_to(truth)
    assert error.roll_arcsec == pytest.approx(7200.0, rel=1e-12)
    assert error.cross_boresight_arcsec == pytest.approx(0.0, abs=1e-9)
    error = truth.rotated([math.radians(1.0), 0.0, 0.0]).error_to(truth)
    assert error.cross_boresight_arcsec == pytest.approx(3600.0, rel=1e-12)
    assert error.roll_arcsec == pytest.approx(0.0, abs=1e-9)
    assert error.total_arcsec == pytest.approx(3600.0, rel=1e-12)


def test_sensor_turning_right_sees_stars_move_left() -> None:
    attitude = Attitude.from_radec_roll(10.0, 30.0, 0.0)
    turned = propagate(attitude, [0.0, math.radians(1.0), 0.0], 1.0)
    star = turned.to_sensor(attitude.boresight)
    assert star[0] == pytest.approx(-math.sin(math.radians(1.0)), rel=1e-12)


def test_propagate_interpolate_and_rate_agree() -> None:
    start = Attitude.from_radec_roll(200.0, -70.0, 300.0)
    rate = np.array([0.01, -0.02, 0.005])
    end = propagate(start, rate, 4.0)
    np.testing.assert_allclose(rate_between(start, end, 4.0), rate, rtol=1e-12)
    middle = interpolate(start, end, 0.25)
    assert middle.error_to(propagate(start, rate, 1.0)).total_arcsec < MICRO_ARCSEC


def test_random_attitudes_are_uniform() -> None:
    rng = np.random.default_rng(3)
    matrices = np.array([random_attitude(rng).matrix for _ in range(4000)])
    assert np.abs(matrices.mean(axis=0)).max() < 0.05
    assert np.abs((matrices**2).mean(axis=0) - 1 / 3).max() < 0.03


@pytest.mark.parametrize(
    "quaternion", [[0, 0, 0, 0], [1, 0, 0], [math.nan, 0, 0, 1], [math.inf, 0, 0, 0], [[1, 0, 0, 0]]]
)
def test_bad_quaternions_are_rejected(quaternion: list[float]) -> None:
    with pytest.raises(StaridError, match="attitude quaternion"):
        Attitude.from_quaternion(quaternion)


@pytest.mark.parametrize(
    "matrix", [np.eye(3) * 1.1, np.diag([1.0, 1.0, -1.0]), np.full((3, 3), np.nan), np.eye(2)]
)
def test_bad_matrices_are_rejected(matrix: np.ndarray) -> None:
    with pytest.raises(StaridError, match="attitude matrix"):
        Attitude.from_matrix(matrix)


@pytest.mark.parametrize(
    "values", [(0.0, 90.1, 0.0), (math.nan, 0.0, 0.0), (0.0, 0.0, math.inf), (0.0, math.nan, 0.0)]
)
def test_bad_angles_are_rejected(values: tuple[float, float, float]) -> None:
    with pytest.raises(StaridError, match="attitude"):
        Attitude.from_radec_roll(*values)
