import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from emulator.errors import EmulatorError
from emulator.truth.file import read_truth_file
from emulator.truth.live import LiveTruth
from emulator.truth.source import (
    FixedTruth,
    HoldSegment,
    RateSegment,
    RateTruth,
    SlewSegment,
    SlewTruth,
    TruthStatus,
)
from starid.attitude import Attitude, propagate

ORION = Attitude.from_radec_roll(83.8, -1.2, 30.0)
EAST = Attitude.from_radec_roll(143.8, -1.2, 10.0)
MILLIARCSECOND = 1e-3


def apart_arcsec(a: Attitude, b: Attitude) -> float:
    return a.error_to(b).total_arcsec


def finite_difference_rate(truth, t: float, dt: float = 1e-4) -> np.ndarray:
    before, after = truth.state(t - dt).attitude, truth.state(t + dt).attitude
    return after.error_to(before).rotation_vector_rad / (2.0 * dt)


def test_fixed_truth_rests():
    state = FixedTruth(ORION).state(1e6)
    assert apart_arcsec(state.attitude, ORION) < MILLIARCSECOND
    assert not state.rate_rad_s.any()


def test_constant_rate_turns_about_its_axis():
    rate = np.radians([0.0, 0.0, 1.0])
    truth = RateTruth(ORION, rate, start_s=5.0)
    # a sensor that turns by +z (from +x right to +y down) sees north turned the other way in its image
    later = truth.state(15.0).attitude
    assert later.ra_deg == pytest.approx(ORION.ra_deg, abs=1e-9)
    assert (later.roll_deg - ORION.roll_deg) % 360.0 == pytest.approx(10.0, abs=1e-9)
    assert finite_difference_rate(truth, 8.0) == pytest.approx(rate, abs=1e-9)


@pytest.mark.parametrize(
    "slew",
    [
        SlewSegment(EAST, math.radians(0.3)),
        SlewSegment(EAST, math.radians(0.3), "limited", math.radians(0.05)),
        SlewSegment(EAST, math.radians(30.0), "limited", math.radians(0.05)),  # never reaches its rate
    ],
)
def test_slew_goes_from_rest_to_rest_about_one_axis_within_its_rate(slew):
    truth = SlewTruth(ORION, [HoldSegment(2.0), slew], start_s=1.0)
    end = 1.0 + truth.duration_s
    assert apart_arcsec(truth.state(3.0).attitude, ORION) < MILLIARCSECOND
    assert apart_arcsec(truth.state(end).attitude, EAST) < MILLIARCSECOND
    assert truth.state(end + 1.0).status is TruthStatus.AFTER_END
    axis = EAST.error_to(ORION).rotation_vector_rad
    axis /= np.linalg.norm(axis)
    for t in np.linspace(3.01, end - 0.01, 40):
        state = truth.state(float(t))
        rate = float(np.linalg.norm(state.rate_rad_s))
        assert rate <= slew.rate_rad_s * (1.0 + 1e-9)
        assert state.rate_rad_s == pytest.approx(finite_difference_rate(truth, float(t)), abs=1e-6)
        assert state.rate_rad_s == pytest.approx(axis * rate, abs=1e-12)


def test_limited_slew_keeps_its_acceleration():
    acceleration = math.radians(0.05)
    truth = SlewTruth(ORION, [SlewSegment(EAST, math.radians(0.3), "limited", acceleration)])
    times = np.linspace(0.0, truth.duration_s, 400)
    rates = np.array([np.linalg.norm(truth.state(float(t)).rate_rad_s) for t in times])
    assert np.abs(np.diff(rates) / np.diff(times)).max() <= acceleration * (1.0 + 1e-6)


def test_segments_follow_one_another_and_repeat():
    turn = RateSegment(10.0, np.radians([0.5, 0.0, 0.0]))
    back = SlewSegment(ORION, math.radians(1.0))
    truth = SlewTruth(ORION, [turn, HoldSegment(3.0), back], repeat=True)
    assert (
        apart_arcsec(truth.state(12.0).attitude, propagate(ORION, np.radians([0.5, 0, 0]), 10.0))
        < MILLIARCSECOND
    )
    assert (
        apart_arcsec(truth.state(4.0).attitude, truth.state(4.0 + truth.duration_s).attitude) < MILLIARCSECOND
    )


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.floats(0.0, 200.0), st.floats(0.0, 0.01))
def test_slew_has_no_jump(t, dt):
    truth = SlewTruth(ORION, [HoldSegment(5.0), SlewSegment(EAST, math.radians(0.5)), HoldSegment(5.0)])
    moved = apart_arcsec(truth.state(t).attitude, truth.state(t + dt).attitude)
    assert moved <= 0.5 * 3600.0 * dt + MILLIARCSECOND


# --- files ---


def write(tmp_path, text):
    path = tmp_path / "truth.csv"
    path.write_text(text)
    return path


def test_file_is_interpolated_on_the_shortest_turn(tmp_path):
    middle = propagate(ORION, np.radians([0.0, 2.0, 0.0]), 10.0)
    rows = [",".join(map(repr, (t, *a.quaternion_xyzw.tolist()))) for t, a in ((0.0, ORION), (10.0, middle))]
    truth = read_truth_file(write(tmp_path, "# comment\n\nt,qx,qy,qz,qw\n" + "\n".join(rows)))
    state = truth.state(2.5)
    assert apart_arcsec(state.attitude, propagate(ORION, np.radians([0.0, 2.0, 0.0]), 2.5)) < MILLIARCSECOND
    assert np.degrees(state.rate_rad_s) == pytest.approx([0.0, 2.0, 0.0], abs=1e-9)
    assert truth.state(10.0).status is TruthStatus.OK
    assert truth.state(-1.0).status is TruthStatus.BEFORE_START
    assert truth.state(10.5).status is TruthStatus.AFTER_END


def test_file_takes_angles_rates_and_repeats(tmp_path):
    text = "t,ra_deg,dec_deg,roll_deg,wx_deg_s,wy_deg_s,wz_deg_s\n0,10,20,30,1,2,3\n4,10,20,30,3,2,1\n"
    truth = read_truth_file(write(tmp_path, text), repeat=True)
    state = truth.state(1.0)
    assert (state.attitude.ra_deg, state.attitude.dec_deg) == pytest.approx((10.0, 20.0))
    assert np.degrees(state.rate_rad_s) == pytest.approx([1.5, 2.0, 2.5])
    assert np.degrees(truth.state(5.0).rate_rad_s) == pytest.approx([1.5, 2.0, 2.5])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "empty"),
        ("t,qx,qy,qz,qw\n", "no rows"),
        ("t,qx,qy,qz\n0,0,0,0\n", "line 1"),
        ("t,qx,qy,qz,qw,colour\n0,0,0,0,1,3\n", "line 1: unknown column 'colour'"),
        ("t,qx,qy,qz,qw\n0,0,0,0,1\n1,0,0,x,1\n", "line 3: qz = 'x' is not a number"),
        ("t,qx,qy,qz,qw\n0,0,0,0,1\n# c\n1,0,0,1\n", "line 4: 4 values for 5 columns"),
        ("t,qx,qy,qz,qw\n0,0,0,0,1\n0,0,0,0,1\n", "line 3: t = 0 is not later"),
        ("t,qx,qy,qz,qw\n0,0,0,0,2\n", "line 2: quaternion of length 2"),
        ("t,qx,qy,qz,qw\n0,0,0,0,nan\n", "line 2: qw = 'nan' is not a number"),
        ("t,ra_deg,dec_deg,roll_deg\n0,0,91,0\n", "line 2: dec_deg = 91 is outside"),
        (
            "t,qx,qy,qz,qw\n0,0,0,0,1\n0.001,1,0,0,0\n",
            "line 3: the turn from the row before is faster than 600",
        ),
        ("t,qx,qy,qz,qw\n0,0,0,0,1_0\n", "line 2: qw = '1_0' is not a number"),
        ("t,ra_deg,dec_deg,roll_deg\n0,1e300,0,0\n", "line 2: ra_deg = 1e+300 is outside ±1e+06"),
        ("t,ra_deg,dec_deg,roll_deg\n0,0,0,1e999\n", "line 2: roll_deg = '1e999' is not a number"),
        ("t,ra_deg,dec_deg,roll_deg\n1e300,0,0,0\n", "line 2: t = 1e+300 is outside ±1e+09"),
        (
            "t,qx,qy,qz,qw,wx_deg_s,wy_deg_s,wz_deg_s\n0,0,0,0,1,0,0,601\n",
            "line 2: wz_deg_s = 601 is outside ±600",
        ),
        (
            "t,qx,qy,qz,qw,ra_deg,dec_deg,roll_deg\n0,0,0,0,1,0,0,0\n",
            "line 1: columns qx, qy, qz, qw and ra_deg, dec_deg, roll_deg both give the attitude",
        ),
        ("t,qx,qy,qz,qw,roll_deg\n0,0,0,0,1,0\n", "line 1: columns qx, qy, qz, qw and roll_deg both give"),
        ("# c\nt,t,qx,qy,qz,qw\n0,1,0,0,0,1\n", "line 2: column t stands there twice"),
        ("t,qx,qy,qz,qw,wx_deg_s,wz_deg_s\n0,0,0,0,1,3,3\n", "line 1: column wy_deg_s is missing"),
        ("t,qx,qy,qz,qw\n0,0,0,0," + "1" * 200_000 + "\n", "line 2: not CSV"),
    ],
)
def test_bad_files_are_named_by_line(tmp_path, text, said):
    path = write(tmp_path, text)
    with pytest.raises(EmulatorError) as refusal:
        read_truth_file(path)
    assert said in str(refusal.value)
    assert str(path) in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_missing_file_is_named(tmp_path):
    with pytest.raises(EmulatorError, match=r"nowhere\.csv"):
        read_truth_file(tmp_path / "nowhere.csv")


# --- live feed ---


def line(t, attitude, rate=None):
    message = {"q": attitude.quaternion_xyzw.tolist()}
    if t is not None:
        message["t"] = t
    if rate is not None:
        message["rate"] = rate
    return json.dumps(message)


def test_live_feed_interpolates_extrapolates_and_goes_stale():
    rate = np.radians([0.0, 0.5, 0.0])
    live = LiveTruth(EAST, stale_s=1.0)
    assert live.state(3.0).status is TruthStatus.WAITING
    assert apart_arcsec(live.state(3.0).attitude, EAST) < MILLIARCSECOND
    assert live.receive(line(100.0, ORION, [0.0, 0.5, 0.0]), 5.0)
    assert live.receive(
        line(101.0, propagate(ORION, rate, 1.0), [0.0, 0.5, 0.0]), 6.2
    )  # late by 0.2 s: no matter
    between, after, stale = live.state(5.25), live.state(6.5), live.state(7.5)
    assert between.status is TruthStatus.OK
    assert apart_arcsec(between.attitude, propagate(ORION, rate, 0.25)) < MILLIARCSECOND
    assert after.status is TruthStatus.EXTRAPOLATED
    assert apart_arcsec(after.attitude, propagate(ORION, rate, 1.5)) < MILLIARCSECOND
    assert after.rate_rad_s == pytest.approx(rate)
    assert stale.status is TruthStatus.STALE
    assert apart_arcsec(stale.attitude, propagate(ORION, rate, 2.0)) < MILLIARCSECOND
    assert not stale.rate_rad_s.any()


def test_live_feed_takes_the_rate_from_its_messages_and_the_time_from_their_receipt():
    rate = np.radians([0.3, 0.0, 0.1])
    live = LiveTruth(EAST)
    live.receive(line(None, ORION), 1.0)
    live.receive(line(None, propagate(ORION, rate, 0.5)), 1.5)
    assert live.state(1.7).rate_rad_s == pytest.approx(rate, abs=1e-9)


def test_live_feed_that_starts_again_begins_a_new_time_line():
    live = LiveTruth(EAST)
    live.receive(line(500.0, ORION), 1.0)
    assert live.receive(line(0.0, EAST), 2.0)
    assert apart_arcsec(live.state(2.0).attitude, EAST) < MILLIARCSECOND


def test_live_feed_on_run_time_takes_times_as_they_stand():
    live = LiveTruth(EAST, timeline="run")
    live.receive(line(10.0, ORION), 3.0)
    assert live.state(10.0).status is TruthStatus.OK


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("nonsense", "JSON"),
        ("[1]", "object"),
        ("{}", "q is missing"),
        ('{"q":[0,0,0,1],"w":1}', "unknown key 'w'"),
        ('{"q":[0,0,0]}', "q is not 4 numbers"),
        ('{"q":[0,0,0,"1"]}', "finite number"),
        ('{"q":[0,0,0,NaN]}', "finite number"),
        ('{"q":[0,0,0,true]}', "finite number"),
        ('{"q":[0,0,0,2]}', "length 1"),
        ('{"q":[0,0,0,1],"rate":[1,2]}', "rate is not 3 numbers"),
        ('{"q":[0,0,0,1],"t":"x"}', "t holds"),
        ('{"q":[0,0,0,1],"t":1e999}', "t holds"),
        ('{"q": [0, 0, 0, 1], "rate": [0, 1e9, 0]}', "rate is beyond 600"),
    ],
)
def test_bad_messages_are_counted_and_named_and_change_nothing(text, said):
    live = LiveTruth(EAST)
    live.receive(line(0.0, ORION), 0.0)
    assert not live.receive(text, 0.5)
    assert (live.accepted, live.refused) == (1, 1)
    assert said in live.last_fault
    assert apart_arcsec(live.state(0.0).attitude, ORION) < MILLIARCSECOND


def test_messages_that_do_not_rise_are_refused():
    live = LiveTruth(EAST)
    live.receive(line(5.0, ORION), 0.0)
    assert not live.receive(line(5.0, EAST), 0.1)
    assert "not later" in live.last_fault


def test_two_messages_at_almost_the_same_time_make_no_endless_rate():
    live = LiveTruth(EAST, timeline="run")
    live.receive(line(0.0, ORION), 0.0)
    assert not live.receive(line(5e-324, EAST), 0.1)
    assert live.receive(line(2e-9, EAST), 0.1)
    assert np.all(np.isfinite(live.state(0.5).rate_rad_s))


def test_a_path_that_no_file_can_have_is_named():
    with pytest.raises(EmulatorError, match="cannot be read"):
        read_truth_file(Path("a\0b"))


@settings(max_examples=200, deadline=None, derandomize=True)
@given(st.one_of(st.binary(max_size=60), st.text(max_size=60)))
def test_any_line_is_taken_or_refused_by_name(text):
    live = LiveTruth(EAST)
    assert live.receive(text, 0.0) == (live.refused == 0)
    assert live.accepted + live.refused == 1
    assert bool(live.last_fault) == bool(live.refused)


def test_a_byte_order_mark_before_a_truth_file_is_accepted(tmp_path):
    path = tmp_path / "truth.csv"
    path.write_bytes(b"\xef\xbb\xbft,ra_deg,dec_deg,roll_deg\n0,370,20,30\n")
    assert read_truth_file(path).state(0.0).attitude.ra_deg == pytest.approx(10.0)
