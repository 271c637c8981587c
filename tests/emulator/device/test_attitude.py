"""The attitude as the device reports it: with the truth, its validity and its rate."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pytest

from starhil.emulator.profile import Profile
from starhil.emulator.truth.source import FixedTruth, RateTruth, TruthState
from starid.attitude import Attitude

ORION = Attitude.from_radec_roll(83.8, -1.2, 0.0)
F32 = 1e-6
TUMBLE_STEP_S = 0.05
WINDOW_RAD = math.radians(0.94)
"""The tracking window of the default camera: 20 px."""


def test_attitude_agrees_with_the_truth_in_every_row(make_bench):
    rate = np.radians([0.02, -0.3, 0.1])
    truth = RateTruth(ORION, rate)
    bench = make_bench(truth=truth).start()
    bench.command("set_mode", mode="lost_in_space")
    bench.step(4.7)
    precise = bench.read("precise_attitude")
    mid_s = precise["time_of_exposure"] - Profile().run.start_unix_s
    measured = Attitude(np.array([precise[f"q_{axis}"] for axis in "xyzw"]))
    assert measured.error_to(truth.state(mid_s).attitude).total_arcsec < 0.1
    for n, axis in enumerate("xyz"):
        assert precise[f"rate_{axis}"] == pytest.approx(math.degrees(rate[n]), abs=1e-6)
        assert bench.read("rates")[f"rate_{axis}"] == pytest.approx(math.degrees(rate[n]), abs=1e-4)
        assert bench.read("quaternion")[f"q_{axis}"] == pytest.approx(precise[f"q_{axis}"], abs=1e-4)
    assert precise["valid"]
    assert precise["tracking"]
    assert precise["frame_counter"] == 5
    assert (precise["stars_detected"], precise["stars_matched"]) == (40, 35)
    assert (precise["uncertainty_cross"], precise["uncertainty_roll"]) == (1.5, 6.0)
    combined = bench.read("star_tracker")
    for row in (
        "star_performance_1",
        "star_performance_2",
        "star_magnitudes",
        "star_timing",
        "rates",
        "quaternion",
    ):
        for name, value in bench.read(row).items():
            assert combined[name] == value, name


@pytest.mark.parametrize(("rate_deg_s", "clipped"), [(3.2, False), (4.0, True), (-4.0, True)])
def test_a_rate_beyond_the_published_row_is_flagged_where_it_is_whole(make_bench, rate_deg_s, clipped):
    bench = make_bench(truth=RateTruth(ORION, np.radians([0.0, rate_deg_s, 0.0]))).start()
    bench.command("set_update_rate", rate=5.0)
    bench.command("set_mode", mode="lost_in_space")
    bench.step(2.0)
    precise, published = bench.read("precise_attitude"), bench.read("rates")["rate_y"]
    assert (precise["valid"], precise["rates_clipped"]) == (True, clipped)
    assert precise["rate_y"] == pytest.approx(rate_deg_s, abs=1e-4)
    assert published == pytest.approx(math.copysign(3.2767, rate_deg_s) if clipped else rate_deg_s, abs=2e-4)


def test_tracking_predicts_with_the_rate(make_bench):
    rate = np.radians([0.0, 0.5, 0.0])
    truth = RateTruth(ORION, rate)
    bench = make_bench(truth=truth).start()
    bench.command("set_mode", mode="lost_in_space")
    bench.step(4.5)
    first, second, third, *_ = bench.pipeline.frames
    assert first.predicted is None
    assert second.predicted is None  # one attitude gives no rate
    assert third.predicted.error_to(third.truth.attitude).total_arcsec < 0.001
    bench.command("set_parameter", parameter=28, value=0.0)  # prediction off: the last attitude as it was
    bench.step(1.0)
    last = bench.pipeline.frames[-1]
    off = last.predicted.error_to(last.truth.attitude).total_arcsec
    assert off == pytest.approx(0.5 * 3600.0, rel=1e-6)


def test_validity_clears_at_the_first_failed_frame_with_its_reason(bench):
    bench.command("set_mode", mode="lost_in_space")
    bench.step(3.5)
    assert bench.read("precise_attitude")["valid"]
    bench.pipeline.fail = "too_few_stars"
    bench.step(1.0)
    attitude = bench.read("precise_attitude")
    assert not attitude["valid"]
    assert not attitude["rate_valid"]
    assert attitude["reason"] == "too_few_stars"
    assert [attitude[f"q_{axis}"] for axis in "xyzw"] == [0.0] * 4
    assert not bench.read("star_performance_2")["attitude_ok"]
    assert not bench.read("device_status")["attitude_valid"]
    assert bench.read("star_1_raw")["star_1_catalogue"] == 0


def test_standby_reports_no_attitude(bench):
    bench.command("set_mode", mode="lost_in_space")
    bench.step(3.5)
    bench.command("set_mode", mode="standby")
    attitude = bench.read("precise_attitude")
    assert (attitude["valid"], attitude["reason"]) == (False, "not_running")


def test_an_attitude_that_is_not_renewed_goes_out_of_date(bench):
    bench.command("set_mode", mode="lost_in_space")
    bench.step(3.5)
    bench.device.cycle._next.cancel()
    bench.step(10.0)
    attitude = bench.read("precise_attitude")
    assert (attitude["valid"], attitude["reason"]) == (False, "no_frame")


def test_a_rate_is_never_taken_over_a_gap(make_bench):
    bench = make_bench(truth=RateTruth(ORION, np.radians([0.0, 0.5, 0.0]))).start()
    bench.command("set_mode", mode="lost_in_space")
    bench.step(3.5)
    bench.command("set_mode", mode="standby")
    bench.step(500.0)  # the sensor has turned by 250 degrees
    bench.command("set_mode", mode="lost_in_space")
    bench.step(0.9)
    attitude = bench.read("precise_attitude")
    assert (attitude["valid"], attitude["rate_valid"]) == (True, False)
    bench.step(1.0)
    assert bench.read("rates")["rate_y"] == pytest.approx(0.5, abs=1e-4)


@dataclass(frozen=True)
class Tumble:
    """A body rate of 4 degrees per second whose axis turns by 9.5 degrees per second about z, from a table."""

    kind = "rate"

    @cached_property
    def _path(self) -> list[Attitude]:
        path = [ORION]
        for n in range(int(40.0 / TUMBLE_STEP_S)):
            phase = np.radians(9.5) * (n + 0.5) * TUMBLE_STEP_S
            rate = np.radians(4.0) * np.array([np.cos(phase), np.sin(phase), 0.0])
            path.append(path[-1].rotated(rate * TUMBLE_STEP_S))
        return path

    def state(self, t_s: float) -> TruthState:
        return TruthState(self._path[round(t_s / TUMBLE_STEP_S)], np.zeros(3))


def reasons(bench, seconds: int) -> list[str]:
    """The reason of each frame."""
    measurements = []
    for _ in range(seconds):
        bench.step(1.0)
        measurements.append(bench.read("precise_attitude")["reason"])
    return measurements


def test_one_frame_without_stars_in_a_tumble_costs_no_other(make_bench):
    bench = make_bench(truth=Tumble()).start()
    bench.pipeline.window_rad = WINDOW_RAD
    bench.command("set_mode", mode="lost_in_space")
    assert set(reasons(bench, 8)) == {"ok"}
    assert bench.pipeline.frames[-1].predicted is not None
    bench.pipeline.fail = "too_few_stars"
    assert reasons(bench, 1) == ["too_few_stars"]
    bench.pipeline.fail = ""
    assert set(reasons(bench, 20)) == {"ok"}
    assert bench.pipeline.frames[-1].predicted is not None


def test_a_jump_marks_no_frame_but_that_which_lost_it(bench):
    bench.pipeline.window_rad = WINDOW_RAD
    bench.command("set_mode", mode="lost_in_space")
    bench.step(4.5)
    bench.device.surroundings.truth = FixedTruth(ORION.rotated((0.5, 0.0, 0.0)))
    assert reasons(bench, 4) == ["prediction_lost", "ok", "ok", "ok"]


def test_too_high_a_rate_is_flagged(make_bench):
    bench = make_bench(truth=RateTruth(ORION, np.radians([0.0, 6.0, 0.0]))).start()
    bench.command("set_mode", mode="lost_in_space")
    bench.step(3.5)
    attitude = bench.read("precise_attitude")
    assert (attitude["valid"], attitude["reason"]) == (False, "rate_too_high")


def test_processing_longer_than_allowed_is_flagged(bench):
    bench.command("set_parameter", parameter=10, value=20.0)
    bench.command("set_mode", mode="lost_in_space")
    bench.step(1.5)
    assert bench.read("precise_attitude")["reason"] == "timeout"
    assert bench.read("star_performance_2")["processing_time_error"]


def test_the_mount_rotates_the_reported_attitude(bench):
    bench.command("set_mode", mode="lost_in_space")
    bench.command("set_parameter", parameter=20, value=90.0)  # alpha: about x
    bench.step(3.5)
    values = bench.read("precise_attitude")
    body = Attitude(np.array([values[f"q_{axis}"] for axis in "xyzw"]))
    assert body.matrix[0] == pytest.approx(ORION.matrix[0], abs=F32)  # x stays
    assert body.matrix[1] == pytest.approx(ORION.matrix[2], abs=F32)  # y turns to where z was
    assert body.matrix[2] == pytest.approx(-ORION.matrix[1], abs=F32)
