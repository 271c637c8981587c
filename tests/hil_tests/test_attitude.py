"""The quaternion algebra of the bench compared with closed forms and an independent implementation."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from starhil.hil_tests.attitude import (
    Quaternion,
    attitude_error,
    attitude_in,
    from_directions,
    from_radec_roll,
    from_rotation_vector,
    from_vector_part,
    interpolate,
    rotation_vector,
    to_matrix,
    to_radec_roll,
    unit,
)
from starhil.hil_tests.errors import BenchError
from starhil.protocol.unit import load_unit

ARCSEC = math.radians(1.0 / 3600.0)
TOLERANCE_ARCSEC = 1e-3

angles = st.floats(0.0, 360.0, exclude_max=True)
declinations = st.floats(-89.9, 89.9)


def compose(vector_rad: tuple[float, float, float], q: Quaternion) -> Quaternion:
    """Turn the sensor frame by a rotation vector, with scipy."""
    return unit(list((Rotation.from_rotvec(vector_rad).inv() * Rotation.from_quat(q)).as_quat()))


@pytest.mark.parametrize(
    ("ra", "dec", "roll", "expected"),
    [
        (0.0, 0.0, 0.0, (1.0, 0.0, 0.0)),
        (90.0, 0.0, 77.0, (0.0, 1.0, 0.0)),
        (12.0, 90.0, 5.0, (0.0, 0.0, 1.0)),
        (180.0, -45.0, 0.0, (-math.sqrt(0.5), 0.0, -math.sqrt(0.5))),
    ],
)
def test_the_boresight_points_where_ra_and_dec_say(ra, dec, roll, expected):
    assert to_matrix(from_radec_roll(ra, dec, roll))[2] == pytest.approx(expected, abs=1e-12)


@given(angles, declinations, angles)
@settings(max_examples=200, deadline=None, derandomize=True)
def test_rows_of_the_matrix_follow_the_convention(ra, dec, roll):
    alpha, delta, rho = (math.radians(v) for v in (ra, dec, roll))
    north = (-math.sin(delta) * math.cos(alpha), -math.sin(delta) * math.sin(alpha), math.cos(delta))
    east = (-math.sin(alpha), math.cos(alpha), 0.0)
    matrix = Rotation.from_quat(from_radec_roll(ra, dec, roll)).as_matrix()
    x = [-math.sin(rho) * n - math.cos(rho) * e for n, e in zip(north, east, strict=True)]
    y = [-math.cos(rho) * n + math.sin(rho) * e for n, e in zip(north, east, strict=True)]
    assert matrix[0] == pytest.approx(x, abs=1e-12)
    assert matrix[1] == pytest.approx(y, abs=1e-12)


@pytest.mark.parametrize(
    ("vector", "cross", "roll", "total"),
    [
        ((10 * ARCSEC, 0.0, 0.0), 10.0, 0.0, 10.0),
        ((0.0, -25 * ARCSEC, 0.0), 25.0, 0.0, 25.0),
        ((0.0, 0.0, 40 * ARCSEC), 0.0, 40.0, 40.0),
        ((30 * ARCSEC, 0.0, 40 * ARCSEC), 30.0, 40.0, 50.0),
        ((0.0, 0.0, math.pi / 2), 0.0, 90 * 3600.0, 90 * 3600.0),
        ((math.pi, 0.0, 0.0), 180 * 3600.0, 0.0, 180 * 3600.0),
    ],
)
def test_error_is_split_into_boresight_and_roll(vector, cross, roll, total):
    truth = from_radec_roll(83.8, -1.2, 30.0)
    error = attitude_error(compose(vector, truth), truth)
    assert error.cross_boresight_arcsec == pytest.approx(cross, abs=TOLERANCE_ARCSEC)
    assert error.roll_arcsec == pytest.approx(roll, abs=TOLERANCE_ARCSEC)
    assert error.total_arcsec == pytest.approx(total, abs=TOLERANCE_ARCSEC)


@given(angles, declinations, angles)
@settings(max_examples=100, deadline=None, derandomize=True)
def test_a_quaternion_and_its_negative_are_one_attitude(ra, dec, roll):
    q = from_radec_roll(ra, dec, roll)
    assert attitude_error(Quaternion(*(-v for v in q)), q).total_arcsec == pytest.approx(
        0.0, abs=TOLERANCE_ARCSEC
    )


@given(angles, declinations, angles)
@settings(max_examples=100, deadline=None, derandomize=True)
def test_the_vector_part_alone_gives_the_attitude(ra, dec, roll):
    q = from_radec_roll(ra, dec, roll)
    sign = 1.0 if q.w >= 0.0 else -1.0
    rebuilt = from_vector_part(sign * q.x, sign * q.y, sign * q.z)
    # near a half turn the scalar is the root of a difference, so its rounding counts
    assert attitude_error(rebuilt, q).total_arcsec < 0.01


@pytest.mark.parametrize(
    "values", [(0.0, 0.0, 0.0, 0.0), (1.0, 1.0, 0.0, 0.0), (math.nan, 0.0, 0.0, 1.0), (1.0, 0.0, 0.0)]
)
def test_an_invalid_attitude_is_rejected(values):
    with pytest.raises(BenchError, match="quaternion"):
        unit(values)


@given(angles, declinations, angles)
def test_angles_are_those_from_which_an_attitude_was_made(ra, dec, roll):
    seen = from_radec_roll(*to_radec_roll(from_radec_roll(ra, dec, roll)))
    assert attitude_error(seen, from_radec_roll(ra, dec, roll)).total_arcsec < TOLERANCE_ARCSEC


def test_interpolation_goes_the_short_way_at_constant_rate():
    first = from_radec_roll(10.0, 20.0, 30.0)
    second = compose((0.0, math.radians(10.0), 0.0), first)
    quarter = interpolate(first, Quaternion(*(-v for v in second)), 0.25)
    assert attitude_error(quarter, first).cross_boresight_arcsec == pytest.approx(
        2.5 * 3600.0, abs=TOLERANCE_ARCSEC
    )
    assert interpolate(first, first, 0.3) == pytest.approx(first)


@given(st.tuples(*3 * [st.floats(-1.8, 1.8)]))
def test_a_rotation_vector_is_the_axis_times_the_angle(vector):
    q = from_rotation_vector(vector)
    assert Rotation.from_quat(q).as_rotvec() == pytest.approx(vector, abs=1e-9)
    for other in (q, [-part for part in q]):
        assert rotation_vector(other) == pytest.approx(vector, abs=1e-9)


def test_an_attitude_follows_from_two_directions():
    attitude = from_radec_roll(83.8, -1.2, 30.0)
    known = (0.6, 0.8, 0.0), (0.0, 0.6, 0.8)
    seen = [tuple(Rotation.from_quat(attitude).apply(vector)) for vector in known]
    assert attitude_error(from_directions(seen, known), attitude).total_arcsec < TOLERANCE_ARCSEC


FORMS = {
    "quaternion": (["x", "y", "z", "w"], "", lambda turn: turn.as_quat(canonical=True)),
    "vector part": (["x", "y", "z"], "", lambda turn: turn.as_quat(canonical=True)[:3]),
    "Gibbs vector": (["gibbs_x", "gibbs_y", "gibbs_z"], "", lambda turn: turn.as_quat()[:3] / turn.as_quat()[3]),
    "MRPs": (["mrp_x", "mrp_y", "mrp_z"], "", lambda turn: turn.as_mrp()),
    "rotation vector": (
        ["rotation_x", "rotation_y", "rotation_z"], 'unit = "deg", ', lambda turn: np.degrees(turn.as_rotvec())
    ),
}  # fmt: skip


@pytest.mark.parametrize("form", FORMS)
def test_the_attitude_of_a_row_is_read_in_any_form(form, tmp_path):
    quantities, unit_of_measure, values_of = FORMS[form]
    fields = ", ".join(
        f'{{ name = "f{n}", type = "f64", {unit_of_measure}value = "attitude.{name}" }}'
        for n, name in enumerate(quantities)
    )
    (tmp_path / "unit.toml").write_text(
        '[unit]\nname = "x"\nversion = "1"\ndoc = "d"\n[[telemetry]]\nid = 130\nname = "row"\ndoc = "d"\nprovenance = "ours"\n'
        f'fields = [{fields}, {{ type = "bits8", bits = [{{ name = "valid", value = "attitude.valid" }}, {{ width = 7 }}] }}]\n'
    )  # fmt: skip
    row = load_unit(tmp_path).telemetry["row"]
    turn = Rotation.from_rotvec([0.3, -1.2, 0.5])
    values = {f"f{n}": float(value) for n, value in enumerate(values_of(turn))}
    measured = attitude_in(row, {**values, "valid": True})
    assert tuple(measured) == pytest.approx(tuple(turn.as_quat(canonical=True)))
    with pytest.raises(BenchError, match="not valid"):
        attitude_in(row, {**values, "valid": False})
