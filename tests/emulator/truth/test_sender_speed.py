"""A live feed that runs at another speed than the clock is detected, followed and reported."""

import json

import numpy as np
import pytest

from starhil.emulator.truth.live import LiveTruth, rounded_speed
from starhil.emulator.truth.source import TruthStatus
from starid.attitude import Attitude, propagate
from tests.emulator.runs import Control

START = Attitude.from_radec_roll(83.8, -1.2, 30.0)
RATE_DEG_S = (0.2, -0.1, 0.2)
RATE_RAD_S = np.radians(RATE_DEG_S)
FEW = 12


def send(live, t, received, *, timed=True):
    """Send the state at a sender's time; return it."""
    attitude = propagate(START, RATE_RAD_S, t)
    message = {"q": attitude.quaternion_xyzw.tolist(), "rate": RATE_DEG_S}
    if timed:
        message["t"] = t
    assert live.receive(json.dumps(message), received), live.last_fault
    return attitude


def warnings(caplog):
    return [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]


@pytest.mark.parametrize("clock_speed", [1.0, 2.0])
@pytest.mark.parametrize("speed", [0.1, 0.5, 1.5, 3.0, 100.0])
def test_a_sender_at_another_speed_is_named_within_a_few_messages_and_followed(speed, clock_speed, caplog):
    live = LiveTruth(START, stale_s=10.0)
    live.set_run(clock_speed, 0.0)
    period_s = 0.1 * clock_speed  # of simulation time; 0.1 s of wall time
    rng = np.random.default_rng(1)
    for n in range(100):
        received = period_s * n + clock_speed * rng.exponential(0.003)
        attitude = send(live, speed * period_s * n, received)
        if n >= FEW:
            state = live.state(received + 0.01)
            assert state.status is TruthStatus.WRONG_SPEED, n
            behind_s = state.attitude.error_to(attitude).total_arcsec / 3600.0 / 0.3
            assert behind_s < 1.5 * speed * 0.01 + 1e-3
            assert state.rate_rad_s == pytest.approx(speed * RATE_RAD_S, rel=0.2)
    (said,) = warnings(caplog)
    assert said == (
        f"truth feed: the sender runs at {speed:g} × the clock; "
        f"use --clock scaled:{speed * clock_speed:g}, or lock-step with --clock stepped"
    )


@pytest.mark.parametrize("speed", [0.5, 3.0])
def test_a_sender_of_simulation_time_at_another_speed_is_named_and_its_times_still_hold(speed, caplog):
    live = LiveTruth(START, stale_s=10.0, timeline="run")
    for n in range(100):
        send(live, speed * 0.1 * n, 0.1 * n)
        state = live.state(0.1 * n)
        assert state.attitude.error_to(propagate(START, RATE_RAD_S, 0.1 * n)).total_arcsec < 1e-3
        if n >= FEW:
            assert state.status is TruthStatus.WRONG_SPEED, n
    (said,) = warnings(caplog)
    assert said.startswith(
        f"truth feed: the sender runs at {speed:g} × the clock; use --clock scaled:{speed:g}"
    )


def arrivals(kind, count, rng):
    """Times of receipt of a sender at 0.1 s per message on time, with the delays of a real link."""
    sent = 0.1 * np.arange(count)
    if kind == "jitter":
        return np.maximum.accumulate(sent + rng.exponential(0.03, count))
    if kind == "bunches":
        return np.ceil(sent / 0.73) * 0.73 + 1e-4 * np.arange(count)
    if kind == "ahead":
        return np.floor(sent / 10.0) * 10.0 + 1e-5 * np.arange(count)
    if kind == "gaps":
        blocked = (sent % 7.0) < 1.5
        return np.maximum.accumulate(np.where(blocked, sent - sent % 7.0 + 1.5, sent)) + 1e-5 * np.arange(
            count
        )
    if kind == "pauses":
        return sent + 30.0 * np.floor(sent / 5.0)
    return sent / float(kind)


@pytest.mark.parametrize(
    "kind", ["jitter", "bunches", "ahead", "gaps", "pauses", "0.9", "0.97", "0.98", "1", "1.03", "1.1"]
)
def test_delays_and_clocks_that_slip_are_no_other_speed(kind, caplog):
    live = LiveTruth(START, stale_s=1.0)
    for n, received in enumerate(arrivals(kind, 500, np.random.default_rng(7)).tolist()):
        send(live, 0.1 * n, received)
        assert live.state(received).status is not TruthStatus.WRONG_SPEED, (n, received)
    assert not warnings(caplog)


def test_a_sender_that_changes_its_speed_is_named_each_time(caplog):
    live = LiveTruth(START, stale_s=10.0)
    t = received = 0.0
    for speed, expected in ((1.0, False), (3.0, True), (1.0, False), (0.5, True)):
        for _ in range(100):
            t, received = t + 0.1 * speed, received + 0.1
            attitude = send(live, t, received)
        state = live.state(received)
        assert (state.status is TruthStatus.WRONG_SPEED) == expected
        assert state.attitude.error_to(attitude).total_arcsec < 360.0 * 0.1
    named = [float(said.split("runs at ")[1].split(" ×")[0]) for said in warnings(caplog)]
    assert named == pytest.approx([3.0, 0.5], rel=0.1)


@pytest.mark.parametrize(
    ("measured", "named"), [(2.91, 3.0), (0.51, 0.5), (0.34, 1 / 3), (1.52, 1.5), (2.44, 2.4), (981.0, 981.0)]
)
def test_a_measured_speed_is_named_as_a_whole_one_if_it_is_near(measured, named):
    assert rounded_speed(measured) == pytest.approx(named)


def test_only_a_sender_with_times_on_a_clock_that_passes_by_itself_has_a_speed(caplog):
    untimed, stepped = LiveTruth(START), LiveTruth(START)
    stepped.set_run(0.0, 0.0)
    for n in range(50):
        send(untimed, 0.3 * n, 0.1 * n, timed=False)
        send(stepped, 0.3 * n, 0.1 * n)
    assert untimed.state(4.9).status is TruthStatus.OK
    assert stepped.state(4.9).status is not TruthStatus.WRONG_SPEED
    assert not warnings(caplog)


def test_the_status_shows_a_sender_at_another_speed(run, monkeypatch):
    wall_ns = [10**9]
    monkeypatch.setattr("time.monotonic_ns", lambda: wall_ns[0])

    async def scenario(emulation, _line):
        for n in range(FEW):
            wall_ns[0] += 10**8
            attitude = propagate(START, RATE_RAD_S, 0.3 * n).quaternion_xyzw.tolist()
            emulation.feed.receive(json.dumps({"t": 0.3 * n, "q": attitude}).encode())
        async with Control(emulation) as control:
            return await control.do("status")

    answer = run(scenario, clock="real", truth={"kind": "live", "stale_s": 10.0}, device={"boot_s": 0.0})
    assert answer["truth_status"] == "wrong_speed"
    assert answer["feed"]["speed"] == pytest.approx(3.0)
