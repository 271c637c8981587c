"""Expectations: what holds, what does not, and what is said about it."""

from __future__ import annotations

import pytest
from pydantic import TypeAdapter

from starhil.hil_tests.attitude import as_reported, attitude_in, from_radec_roll
from starhil.hil_tests.errors import BenchError
from starhil.hil_tests.session.expect import (
    AttitudeCheck,
    Conditions,
    ReadConditions,
    Variable,
    show,
)
from starhil.protocol.icd.conventions import Conventions
from starhil.protocol.unit import load_unit

SENSOR = Conventions()
ROW = load_unit().telemetry["precise_attitude"]


def expectation(value, known=()):
    return TypeAdapter(ReadConditions).validate_python(value, context={"captured": known})


@pytest.mark.parametrize(
    ("wanted", "good", "bad"),
    [
        (5, 5, 6),
        (5.0, 5.000001, 5.01),
        (True, True, False),
        ("tracking", "tracking", "standby"),
        ({"value": 10.0, "within": 0.5}, 10.5, 10.6),
        ({"value": 10, "within": 2}, 8, 7),
        ({"min": 3}, 3, 2.999),
        ({"max": 3}, 3, 3.001),
        ({"min": 1, "max": 2}, 1.5, 2.5),
        ({"above": 3}, 3.1, 3),
        ({"one_of": ["a", "b"]}, "b", "c"),
        ({"not": 0}, 1, 0),
        ({"angle_deg": 0.0, "within": 0.2}, 359.9, 359.7),
        ({"value": 5, "plus": 1}, 6, 5),
    ],
)
def test_each_form_matches_only_its_own_values(wanted, good, bad):
    assert expectation(wanted).mismatch("x", good, {}) is None
    text = expectation(wanted).mismatch("x", bad, {})
    assert text is not None
    assert text.startswith(f"x is {show(bad)}, expected ")


def test_a_captured_value_is_taken_at_the_time_of_the_check():
    growing = expectation({"above": "$before"}, frozenset({"before"}))
    assert growing.above == Variable("before")
    assert growing.mismatch("x", 8, {"before": 7}) is None
    assert growing.mismatch("x", 7, {"before": 7}) == "x is 7, expected more than 7"


def test_not_a_number_fails_every_comparison():
    nan = float("nan")
    for wanted in ({"min": 0}, {"max": 0}, {"above": 0}, {"value": 0, "within": 1}, 0.0):
        assert expectation(wanted).mismatch("x", nan, {}) is not None


def test_bytes_are_compared_with_bytes_given_or_captured():
    assert Conditions.model_construct(value=b"\x0a\x0b").mismatch("x", b"\x0a\x0b", {}) is None
    assert (
        Conditions.model_construct(value=b"\x0a\x0b").mismatch("x", b"\x0a\x0c", {})
        == "x is 0A 0C, expected 0A 0B"
    )
    before = {"before": b"\x0a\x0b"}
    assert Conditions.model_construct(value=Variable("before")).mismatch("x", b"\x0a\x0b", before) is None
    assert (
        Conditions.model_construct(differs_from=Variable("before")).mismatch("x", b"\x0a\x0b", before)
        is not None
    )
    assert (
        Conditions.model_construct(value=Variable("before")).mismatch("x", b"\x0a\x0b", {"before": "text"})
        is not None
    )


def test_a_flag_is_not_the_number_one():
    assert Conditions.model_construct(value=True).mismatch("x", 1, {}) is not None


def test_an_attitude_is_judged_in_arcseconds_and_an_invalid_one_fails():
    truth = from_radec_roll(10.0, 20.0, 30.0)
    off = from_radec_roll(10.0, 20.0 + 10.0 / 3600.0, 30.0)
    values = dict(zip(("q_x", "q_y", "q_z", "q_w"), off, strict=True)) | {"valid": True, "reason": "ok"}
    error, problem = AttitudeCheck(within_arcsec=10.1).judge(ROW, values, truth, SENSOR)
    assert problem is None
    assert error.cross_boresight_arcsec == pytest.approx(10.0, abs=1e-6)
    _, problem = AttitudeCheck(within_arcsec=9.9).judge(ROW, values, truth, SENSOR)
    assert problem == "cross-boresight error 10.0 arcsec, expected at most 9.9 arcsec"
    error, problem = AttitudeCheck(within_arcsec=1e9).judge(
        ROW, values | {"valid": False, "reason": "no_match"}, truth, SENSOR
    )
    assert error is None
    assert "no_match" in problem


def test_a_large_error_is_given_in_degrees_with_both_attitudes():
    truth, measured = from_radec_roll(83.8, -1.2, 30.0), from_radec_roll(133.3438, -1.2, 30.0)
    values = dict(zip(("q_x", "q_y", "q_z", "q_w"), measured, strict=True))
    _, problem = AttitudeCheck(within_arcsec=60.0).judge(ROW, values, truth, SENSOR)
    assert problem == (
        "cross-boresight error 49.532 deg, expected at most 60 arcsec; measured RA 133.3438, Dec -1.2000, "
        "roll 30.0000 deg, true RA 83.8000, Dec -1.2000, roll 30.0000 deg"
    )


def test_an_all_zero_quaternion_is_not_an_attitude():
    with pytest.raises(BenchError, match="length is 0"):
        attitude_in(ROW, {"q_x": 0.0, "q_y": 0.0, "q_z": 0.0, "q_w": 0.0})


def test_an_attitude_is_compared_as_the_unit_reports_it():
    truth = from_radec_roll(83.8, -1.2, 30.0)
    conventions = Conventions(quaternion="attitude", axes=["+y", "-x", "+z"])
    reported = as_reported(truth, conventions)
    values = dict(zip(("q_x", "q_y", "q_z", "q_w"), reported, strict=True)) | {"valid": True}
    check = AttitudeCheck(within_arcsec=0.01, roll_within_arcsec=0.01)
    assert check.judge(ROW, values, truth, conventions)[1] is None
    for other in (SENSOR, Conventions(quaternion="attitude"), Conventions(axes=["+y", "-x", "+z"])):
        assert "expected at most" in check.judge(ROW, values, truth, other)[1]


def test_an_attitude_that_a_map_calls_invalid_is_not_compared():
    row = load_unit("sagitta").telemetry["solution"]
    values = row.decode(row.encode({"q_w": 1.0, "valid": "false"}, check=False))
    with pytest.raises(BenchError, match="not valid"):
        attitude_in(row, values)
