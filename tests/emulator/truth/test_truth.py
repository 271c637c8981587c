import itertools
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from starhil.emulator.errors import EmulatorError
from starhil.emulator.truth.file import read_truth_file
from starhil.emulator.truth.live import LiveTruth
from starhil.emulator.truth.source import (
    ZERO_RATE,
    FixedTruth,
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
    truth = SlewTruth(ORION, [RateSegment(2.0, ZERO_RATE), slew], start_s=1.0)
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
    truth = SlewTruth(ORION, [turn, RateSegment(3.0, ZERO_RATE), back], repeat=True)
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
    truth = SlewTruth(
        ORION,
        [RateSegment(5.0, ZERO_RATE), SlewSegment(EAST, math.radians(0.5)), RateSegment(5.0, ZERO_RATE)],
    )
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
    truth = replace(read_truth_file(write(tmp_path, text)), repeat=True)
    state = truth.state(1.0)
    assert (state.attitude.ra_deg, state.attitude.dec_deg) == pytest.approx((10.0, 20.0))
    assert np.degrees(state.rate_rad_s) == pytest.approx([1.5, 2.0, 2.5])
    assert np.degrees(truth.state(5.0).rate_rad_s) == pytest.approx([1.5, 2.0, 2.5])


def test_a_cell_of_200000_digits_is_rejected_by_line(tmp_path):
    with pytest.raises(EmulatorError, match=r"truth\.csv line 2: not CSV"):
        read_truth_file(write(tmp_path, "t,qx,qy,qz,qw\n0,0,0,0," + "1" * 200_000 + "\n"))


SECRET = "s3cr3t"


@pytest.mark.parametrize(
    "text",
    [
        SECRET,
        f"{SECRET}:19000:0:99999\n",
        f"t,qx,qy,qz,qw,{SECRET}\n",
        f"t,qx,qy,qz,qw\n0,0,0,0,{SECRET}\n",
        "t,qx,qy,qz,qw\n0,0,0,0,271828\n",
        "t,qx,qy,qz,qw\n271829,0,0,0,1\n271828,0,0,0,1\n",
        "t,ra_deg,dec_deg,roll_deg\n0,0,271828,0\n",
        "t,ra_deg,dec_deg,roll_deg\n0,0,1e271828,0\n",
    ],
)
def test_no_message_quotes_the_file(tmp_path, text):
    with pytest.raises(EmulatorError) as refusal:
        read_truth_file(write(tmp_path, text))
    assert SECRET not in str(refusal.value)
    assert "27182" not in str(refusal.value)


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


def test_between_distant_messages_a_live_feed_follows_their_rates():
    """Coning: a spin about z in a frame that turns about x; both rates are constant there."""

    def coning(t):
        turned = propagate(propagate(EAST, np.radians([0.2, 0.0, 0.0]), t), np.radians([0.0, 0.0, 1.5]), t)
        angle = np.radians(1.5 * t)
        rate = [0.2 * np.cos(angle), -0.2 * np.sin(angle), 1.5]  # the first turn, as seen after the second
        return turned, rate

    with_rates, without = (LiveTruth(EAST, timeline="run", stale_s=5.0) for _ in range(2))
    for t in (0.0, 5.0):
        attitude, rate = coning(t)
        assert with_rates.receive(line(t, attitude, rate), t), with_rates.last_fault
        assert without.receive(line(t, attitude), t)
    for t in (1.0, 2.5, 4.2):
        attitude, rate = coning(t)
        assert np.degrees(with_rates.state(t).rate_rad_s) == pytest.approx(rate, abs=1e-3)
        assert apart_arcsec(with_rates.state(t).attitude, attitude) < 0.1
        assert apart_arcsec(without.state(t).attitude, attitude) > 30.0


def test_live_feed_takes_the_rate_from_its_messages_and_the_time_from_their_receipt():
    rate = np.radians([0.3, 0.0, 0.1])
    live = LiveTruth(EAST)
    live.receive(line(None, ORION), 1.0)
    live.receive(line(None, propagate(ORION, rate, 0.5)), 1.5)
    assert live.state(1.7).rate_rad_s == pytest.approx(rate, abs=1e-9)


def test_a_restarted_live_feed_starts_a_new_time_line():
    live = LiveTruth(EAST)
    live.receive(line(500.0, ORION), 1.0)
    assert live.receive(line(0.0, EAST), 2.0)
    assert apart_arcsec(live.state(2.0).attitude, EAST) < MILLIARCSECOND


def test_live_feed_on_simulation_time_uses_message_times_unchanged():
    live = LiveTruth(EAST, timeline="run")
    live.receive(line(10.0, ORION), 3.0)
    assert live.state(10.0).status is TruthStatus.OK


def test_a_bad_message_is_counted_and_changes_nothing():
    live = LiveTruth(EAST)
    live.receive(line(0.0, ORION), 0.0)
    assert not live.receive("{}", 0.5)
    assert (live.accepted, live.refused) == (1, 1)
    assert apart_arcsec(live.state(0.0).attitude, ORION) < MILLIARCSECOND


def test_messages_that_do_not_rise_are_rejected():
    live = LiveTruth(EAST)
    live.receive(line(5.0, ORION), 0.0)
    assert not live.receive(line(5.0, EAST), 0.1)
    assert "not later" in live.last_fault


def test_two_messages_at_almost_the_same_time_give_a_finite_rate():
    live = LiveTruth(EAST, timeline="run")
    live.receive(line(0.0, ORION), 0.0)
    assert not live.receive(line(5e-324, EAST), 0.1)
    assert not live.receive(line(2e-9, EAST), 0.1)
    assert "q jumps by" in live.last_fault
    assert live.receive(line(0.2, EAST), 0.2)
    assert not live.state(0.25).rate_rad_s.any()


def test_messages_that_arrive_in_bunches_give_the_rate_of_the_turn():
    rate = np.radians([0.3, 0.0, 0.1])
    live = LiveTruth(EAST)
    received = [0.0, 1e-6, 0.2, 0.200001, 0.3, 0.5, 0.500000001, 0.6]
    sent = [0.0, 0.001, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6]
    for at, t in zip(received, sent, strict=True):
        assert live.receive(line(None, propagate(ORION, rate, t)), at), live.last_fault
        assert np.linalg.norm(live.state(at + 0.01).rate_rad_s) < 1.1 * np.linalg.norm(rate)
    assert live.state(0.61).rate_rad_s == pytest.approx(rate, rel=1e-3)


def test_of_two_attitudes_at_the_same_time_of_receipt_the_later_one_holds():
    live = LiveTruth(EAST)
    assert live.receive(line(None, EAST), 1.0)
    assert live.receive(line(None, ORION), 1.0)
    assert apart_arcsec(live.state(1.0).attitude, ORION) < MILLIARCSECOND


SLEW = SlewTruth(
    ORION, [SlewSegment(EAST, math.radians(0.8)), SlewSegment(ORION, math.radians(0.6))], repeat=True
)


def test_the_rate_of_a_slow_sender_is_in_simulation_time():
    rate = np.radians([0.3, 0.0, 0.1])
    live = LiveTruth(EAST)
    for n in range(600):
        received = 0.1 * n / 0.97
        live.receive(line(0.1 * n, propagate(ORION, rate, 0.1 * n), np.degrees(rate).tolist()), received)
    assert live.state(received).rate_rad_s == pytest.approx(0.97 * rate, rel=1e-3)


def test_a_sender_that_paused_is_tied_again_at_once():
    live = LiveTruth(EAST)
    for n in range(20):
        live.receive(line(0.1 * n, ORION), 0.1 * n)
    assert live.state(30.0).status is TruthStatus.STALE
    live.receive(line(2.0, EAST), 32.0)
    assert live.state(32.0).status is TruthStatus.OK
    assert apart_arcsec(live.state(32.0).attitude, EAST) < MILLIARCSECOND


def test_messages_sent_ahead_in_bursts_keep_their_times():
    live = LiveTruth(EAST)
    rate = np.radians([0.0, 0.2, 0.0])
    for second in range(0, 60, 10):
        for n in range(100):
            t = second + 0.1 * n
            live.receive(line(t, propagate(ORION, rate, t)), float(second))
        for t in (second + 0.05, second + 9.85):
            assert apart_arcsec(live.state(t).attitude, propagate(ORION, rate, t)) < MILLIARCSECOND, t


def test_a_gap_in_the_network_moves_no_time():
    live = LiveTruth(EAST)
    rate = np.radians([0.0, 0.2, 0.0])
    for n in range(200):
        t = 0.1 * n
        live.receive(line(t, propagate(ORION, rate, t)), 5.7 if 5.0 <= t < 5.7 else t)
    assert apart_arcsec(live.state(19.9).attitude, propagate(ORION, rate, 19.9)) < MILLIARCSECOND


# --- rates that contradict the attitudes ---

FEED_RATE_DEG_S = [-0.351, -0.085, -0.346]


def conjugate(attitude):
    return Attitude(attitude.quaternion_xyzw * [-1, -1, -1, 1])


def scalar_first(attitude):
    return Attitude(np.roll(attitude.quaternion_xyzw, 1))


@pytest.mark.parametrize(
    ("wrong", "factor", "with_t"),
    [
        *itertools.product([conjugate, scalar_first], [1.0], [True, False]),
        *itertools.product([lambda a: a], [-1.0, 0.0], [True, False]),
        (lambda a: a, math.pi / 180, True),  # without times a rate has a direction only
    ],
)
def test_a_feed_whose_rate_contradicts_its_attitudes_is_rejected_by_name(wrong, factor, with_t, caplog):
    live = LiveTruth(EAST)
    taken = []
    for n in range(50):
        attitude = wrong(propagate(ORION, np.radians(FEED_RATE_DEG_S), 0.1 * n))
        rate = [factor * each for each in FEED_RATE_DEG_S]
        taken.append(live.receive(line(0.1 * n if with_t else None, attitude, rate), 0.1 * n))
    assert taken == [True] + [False] * 49
    assert "rate contradicts q" in live.last_fault
    assert live.state(4.9).status is TruthStatus.STALE
    said = [record.getMessage() for record in caplog.records]
    assert len(said) == 2  # the first and the tenth
    assert "conjugate it" in said[0]


@pytest.mark.parametrize("rate_deg_s", [0.02, 0.06, 3.0])
@pytest.mark.parametrize("period", [0.01, 1.0])
def test_a_wrong_convention_is_found_at_slow_rates_and_quick_feeds_too(rate_deg_s, period):
    live = LiveTruth(EAST)
    rate = [0.0, rate_deg_s, 0.0]
    taken = [
        live.receive(
            line(
                period * n, conjugate(propagate(ORION, np.radians(rate), period * n)), [0.0, rate_deg_s, 0.0]
            ),
            period * n,
        )
        for n in range(int(16.0 / period))
    ]
    assert not any(taken[int(12.0 / period) :])


@pytest.mark.long
@pytest.mark.parametrize("with_t", [True, False])
@pytest.mark.parametrize(("period", "repeat"), [(0.01, 1), (0.01, 10), (0.1, 1), (0.1, 5), (1.0, 1)])
def test_a_feed_whose_rate_fits_is_never_rejected(period, repeat, with_t):
    live = LiveTruth(EAST)
    rng = np.random.default_rng(2)
    late = np.cumsum(rng.exponential(period, 1000)) if not with_t else None
    for n in range(1000):
        truth = SLEW.state(period * (n - n % repeat))
        attitude = Attitude(np.round(truth.attitude.quaternion_xyzw, 6))
        rate = np.round(np.degrees(truth.rate_rad_s), 4).tolist()
        received = period * n if late is None else float(late[n])
        assert live.receive(line(period * n if with_t else None, attitude, rate), received), (
            n,
            live.last_fault,
        )


def test_a_jump_of_the_attitude_costs_one_message():
    live = LiveTruth(EAST)
    rate = [0.0, 0.2, 0.0]
    taken = []
    for n in range(20):
        start = ORION if n < 10 else EAST
        attitude = propagate(start, np.radians(rate), 0.1 * n)
        taken.append(live.receive(line(0.1 * n, attitude, rate), 0.1 * n))
    assert taken == [True] * 10 + [False] + [True] * 9


def test_an_impossible_path_is_named():
    with pytest.raises(EmulatorError, match="cannot be read"):
        read_truth_file(Path("a\0b"))


@settings(max_examples=200, deadline=None, derandomize=True)
@given(st.one_of(st.binary(max_size=60), st.text(max_size=60)))
def test_any_line_is_taken_or_rejected_by_name(text):
    live = LiveTruth(EAST)
    assert live.receive(text, 0.0) == (live.refused == 0)
    assert live.accepted + live.refused == 1
    assert bool(live.last_fault) == bool(live.refused)


def test_a_byte_order_mark_before_a_truth_file_is_accepted(tmp_path):
    path = tmp_path / "truth.csv"
    path.write_bytes(b"\xef\xbb\xbft,ra_deg,dec_deg,roll_deg\n0,370,20,30\n")
    assert read_truth_file(path).state(0.0).attitude.ra_deg == pytest.approx(10.0)
