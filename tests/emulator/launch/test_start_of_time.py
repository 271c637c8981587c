"""The boot passes while the pipelines start; time beyond it starts when every one is ready, however long that takes."""

import asyncio
import json
import time

import pytest

from starhil.emulator.errors import EmulatorError
from starhil.emulator.launch import RunOptions
from starid.attitude import Attitude
from tests.emulator.runs import Control, FakeImager
from tests.waiting import turns

pytestmark = pytest.mark.long

SLOW_START_S = 100.0
CLOCKS = ("real", "scaled:5", "stepped")
SLEW = {
    "kind": "slew",
    "attitude": {"ra_deg": 83.8, "dec_deg": -1.2},
    "segments": [{"do": "slew", "to": {"ra_deg": 143.8, "dec_deg": -1.2}, "max_rate_deg_s": 0.3}],
}


@pytest.fixture
def slow_start(monkeypatch):
    """Let `SLOW_START_S` of wall time pass before the last pipeline is ready, without waiting for it.

    The coroutine function assigned to `slow_start.during` runs in this time.
    """
    passed_ns, real, make_ready = [0], time.monotonic_ns, FakeImager.start
    monkeypatch.setattr("time.monotonic_ns", lambda: real() + passed_ns[0])

    async def nothing():
        return

    async def start(imager):
        if not imager.quick:
            await turns()  # a pump that runs would run events now
            passed_ns[0] = round(SLOW_START_S * 1e9)
            await turns()
            await slow_start.during()
        return await make_ready(imager)

    monkeypatch.setattr(FakeImager, "start", start)
    monkeypatch.setattr(FakeImager, "quick", False, raising=False)
    slow_start.during = nothing
    return slow_start


@pytest.mark.parametrize("clock", CLOCKS)
def test_events_of_a_scenario_wait_for_a_slow_start(run, slow_start, tmp_path, clock):
    path = tmp_path / "day.toml"
    path.write_text("[[at]]\nrun_time_s = 10.0\nfault = { device = { stuck = true } }\n")

    async def scenario(emulation, _line):
        return emulation.device.unresponsive, emulation.clock.now_ns() * 1e-9

    unresponsive, now_s = run(scenario, clock=clock, options=RunOptions(scenario=str(path)))
    assert not unresponsive
    assert now_s < SLOW_START_S / 10


@pytest.mark.parametrize("clock", CLOCKS)
def test_truth_and_boot_wait_for_a_slow_start(run, slow_start, clock):
    before = []

    async def during():
        emulation = run.first_head()
        before.append((emulation.clock.now_ns(), emulation.device.modes.mode.value))

    slow_start.during = during

    async def scenario(emulation, _line):
        if emulation.stepper:
            await emulation.stepper.step(0.1)
        return emulation.device.surroundings.truth.state(emulation.clock.now_ns() * 1e-9).attitude.ra_deg

    ra_deg = run(scenario, clock=clock, truth=SLEW, device={"boot_s": 0.1})
    boot_ns = 0 if clock == "stepped" else 100_000_000
    assert before == [(boot_ns, "boot")]
    assert ra_deg == pytest.approx(83.8, abs=2.0)


@pytest.mark.parametrize("clock", ["real", "scaled:5"])
@pytest.mark.parametrize("record", [False, True])
def test_the_device_boots_while_its_pipeline_starts(run, slow_start, tmp_path, clock, record):
    async def scenario(emulation, _line):
        return emulation.device.modes.mode.value, emulation.clock.now_ns() * 1e-9

    options = RunOptions(record=tmp_path / "tape" if record else None)
    boot = {"boot_s": SLOW_START_S}
    mode, now_s = run(scenario, clock=clock, device=boot, options=options, ready_within_s=5.0)
    assert mode == "standby"
    assert now_s == pytest.approx(SLOW_START_S, abs=SLOW_START_S / 10)


@pytest.mark.parametrize("clock", CLOCKS)
def test_time_waits_for_the_slowest_head(run, slow_start, monkeypatch, clock):
    made = []
    init = FakeImager.__init__

    def second_is_slow(imager, handle):
        init(imager, handle)
        imager.quick = not made
        made.append(imager)

    monkeypatch.setattr(FakeImager, "__init__", second_is_slow)

    async def scenario(emulation, _line):
        return emulation.clock.now_ns() * 1e-9

    links = {"serial": {"port": "auto"}, "can": {"channel": "off"}}
    assert run(scenario, clock=clock, others=[{"links": links}]) < SLOW_START_S / 10
    assert len(made) == 2


@pytest.mark.parametrize("clock", CLOCKS)
def test_a_pipeline_that_does_not_start_ends_the_start_of_all_heads(run, monkeypatch, clock):
    starts = []
    make_ready = FakeImager.start

    async def second_fails(imager):
        starts.append(imager)
        if len(starts) == 2:
            raise EmulatorError("no catalogue")
        return await make_ready(imager)

    monkeypatch.setattr(FakeImager, "start", second_fails)

    async def scenario(emulation, _line):
        pytest.fail("ready")

    links = {"serial": {"port": "auto"}, "can": {"channel": "off"}}
    with pytest.raises(EmulatorError, match="no catalogue"):
        run(scenario, clock=clock, others=[{"links": links}], ready_within_s=5.0)


def test_a_step_requested_before_the_pipeline_is_ready_waits_for_it(run, slow_start):
    requests = []

    async def ask():
        async with Control(run.first_head()) as control:
            return await control.do("step", seconds=1.0)

    async def during():
        requests.append(asyncio.create_task(ask()))
        async with Control(run.first_head()) as other:
            assert (await other.do("status"))["run_time_s"] == 0.0  # answered after the step has come
        assert not requests[0].done()

    slow_start.during = during

    async def scenario(emulation, _line):
        answer = await requests[0]
        return answer["run_time_s"], emulation.device.modes.mode.value

    assert run(scenario) == (1.0, "standby")


@pytest.mark.parametrize("timed", [True, False])
def test_a_live_feed_that_runs_during_a_slow_start_is_anchored_at_its_end(run, slow_start, timed):
    async def during():
        feed = run.first_head().feed
        for second in range(100):
            quaternion = Attitude.from_radec_roll(second, 0.0, 0.0).quaternion_xyzw.tolist()
            at = {"t": second} if timed else {}
            feed.receive(json.dumps({**at, "q": quaternion}).encode())

    slow_start.during = during

    async def scenario(emulation, _line):
        return emulation.device.surroundings.truth.state(emulation.clock.now_ns() * 1e-9)

    state = run(scenario, clock="real", truth={"kind": "live", "stale_s": 60.0}, device={"boot_s": 10.0})
    assert state.attitude.ra_deg == pytest.approx(99.0, abs=1.0)
    assert state.status.value in ("ok", "extrapolated")
