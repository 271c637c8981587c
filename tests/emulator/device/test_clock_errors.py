"""A wrong clock, and a latency that varies: what telemetry reports, and what the truth log says of it."""

from __future__ import annotations

import math
import statistics

import pytest

from starhil.emulator.device.measurement import Measurement
from starhil.emulator.device.power import ThermalModel, ThermalState
from starhil.emulator.profile import Profile
from starhil.emulator.profile.sections import ThermalConfig
from starhil.emulator.run.faults import FaultRequest, Faults
from starhil.emulator.run.truth_log import compare
from starhil.protocol.icd.conventions import NANOSECONDS

pytestmark = pytest.mark.long


@pytest.fixture
def ticking(make_bench):
    """A device that takes images, with errors of its clock; one in two seconds, unless their number matters."""

    def make(rate_hz=0.5, **keys):
        parameters = {"start_mode": "lost_in_space", "update_rate": rate_hz}
        bench = make_bench(Profile.model_validate({"parameters": parameters, **keys})).start()
        bench.published: list[Measurement] = []
        bench.device.signals.frame_published.connect(bench.published.append)
        bench.faults = Faults(bench.requests, {})
        bench.inject = lambda **fault: bench.faults.inject(FaultRequest(clock=fault))
        bench.error_s = lambda: (
            (
                bench.device.time.unix_ns()
                - round(bench.device.profile.start_unix_s * 1e9)
                - bench.clock.now_ns()
            )
            / NANOSECONDS
        )
        return bench

    return make


def test_a_clock_drifts_and_the_truth_log_says_how_far(ticking):
    bench = ticking(clock={"drift_ppm": 50.0})
    bench.step(999.0)
    assert bench.error_s() == pytest.approx(0.05, abs=1e-9)
    row = compare(bench.published[-1])
    assert row["clock_error_s"] == pytest.approx(50e-6 * row["run_time_s"], abs=1e-9)
    reported = bench.read("precise_attitude")["time_of_exposure"]
    assert reported == pytest.approx(1_767_225_600.0 + row["run_time_s"] + row["clock_error_s"], abs=1e-6)
    unix_ns = bench.device.time.unix_ns()
    assert bench.device.time.run_ns(unix_ns) == pytest.approx(bench.clock.now_ns(), abs=2)


def test_the_drift_follows_the_temperature(ticking):
    thermal = {"mounting_c": 45.0, "swing_c": 20.0, "period_s": 600.0}
    bench = ticking(clock={"drift_ppm": 1.0, "drift_ppm_c": 0.5}, thermal=thermal)
    bench.step(149.0)
    quarter = 150.0 * (1.0 + 0.5 * (20.0 + 20.0 * 2.0 / math.pi)) * 1e-6  # mean of a quarter of a sine
    assert bench.error_s() == pytest.approx(quarter, rel=1e-6)
    bench.step(450.0)
    assert bench.error_s() == pytest.approx(600.0 * 11.0e-6, rel=1e-6)


def test_the_mean_temperature_is_that_of_a_sum_of_samples():
    config = ThermalConfig(
        mounting_c=10.0, swing_c=15.0, period_s=700.0, heating_c_w=20.0, time_constant_s=80.0
    )
    model = ThermalModel(config)
    model.start(0, 0.3)
    model.set_power(50 * NANOSECONDS, 0.1)
    state: ThermalState = model.state
    begin, end = 60 * NANOSECONDS, 260 * NANOSECONDS
    samples = [state.temperature_c(begin + (end - begin) * (2 * k + 1) // 20_000) for k in range(10_000)]
    assert state.mean_c(begin, end) == pytest.approx(statistics.fmean(samples), rel=1e-7)


def test_time_tags_jitter_with_the_stated_deviation(ticking):
    bench = ticking(5.0, clock={"jitter_s": 0.002})
    bench.step(200.0)
    errors = [compare(measurement)["clock_error_s"] for measurement in bench.published]
    assert len(errors) > 900
    assert statistics.stdev(errors) == pytest.approx(0.002, rel=0.1)  # 4 sigma
    assert bench.error_s() == 0.0


def test_a_jump_stays_and_a_stuck_second_ends(ticking):
    bench = ticking()
    bench.inject(jump_s=-3.5)
    assert bench.faults.describe() == {}
    bench.step(1.0)
    assert bench.error_s() == -3.5
    bench.inject(stuck_second=True)
    first = bench.device.time.unix_ns()
    bench.step(7.25)
    stuck = bench.device.time.unix_ns()
    assert stuck // NANOSECONDS == first // NANOSECONDS
    assert (stuck - first) % NANOSECONDS == NANOSECONDS // 4
    assert bench.faults.describe() == {"clock": {"stuck_second": True}}
    bench.faults.clear()
    assert bench.error_s() == -3.5


def test_a_fault_overrides_the_profile_until_it_is_cleared(ticking):
    bench = ticking(clock={"drift_ppm": 10.0})
    bench.step(99.0)
    bench.inject(drift_ppm=-1000.0)
    bench.step(10.0)
    assert bench.error_s() == pytest.approx(0.001 - 0.01, abs=1e-9)
    bench.faults.clear()
    bench.step(100.0)
    assert bench.error_s() == pytest.approx(0.001 - 0.01 + 0.001, abs=1e-9)


def test_the_latency_varies_and_results_stay_in_order(ticking):
    bench = ticking(5.0)
    bench.step(5.0)
    usual = bench.published[-1].latency_s
    bench.inject(latency_s=0.1, latency_jitter_s=0.3)
    bench.step(1.0)
    del bench.published[:]
    bench.step(60.0)
    latencies = [each.latency_s - usual for each in bench.published]
    assert min(latencies) >= 0.1 - 1e-9
    assert max(latencies) <= 0.4 + 1e-9
    assert max(latencies) - min(latencies) > 0.2
    assert [each.counter for each in bench.published] == sorted(each.counter for each in bench.published)
