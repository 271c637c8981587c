"""Stars, timing and the rate of frames."""

import struct
from itertools import pairwise

import pytest

from starhil.emulator.device.cycle import MAX_PENDING
from starhil.emulator.device.quantities import getter_of
from starhil.emulator.profile import Profile, load_profile
from starhil.emulator.sensor.pipeline.messages import Failure
from starhil.emulator.truth.source import FixedTruth
from starhil.protocol.messages import ErrorCode
from starid.attitude import Attitude

ORION = Attitude.from_radec_roll(83.8, -1.2, 0.0)
CENTIMAG = 0.001


def test_three_brightest_stars_are_reported(bench):
    bench.command("set_mode", mode="lost_in_space")
    bench.step(1.5)
    first, second = bench.read("star_1_raw"), bench.read("star_2_raw")
    assert first == {
        "star_1_catalogue": 32349,
        "star_1_x": pytest.approx(-382.0),
        "star_1_y": pytest.approx(356.6),
    }
    assert second["star_2_catalogue"] == 101772 % 65536
    magnitudes = bench.read("star_magnitudes")
    assert magnitudes["magnitude_1"] == pytest.approx(-1.44, abs=CENTIMAG)
    assert magnitudes["magnitude_3"] == pytest.approx(0.45, abs=CENTIMAG)
    stars = bench.read("identified_stars")
    assert stars["count"] == 4
    assert [stars[f"hip_{n}"] for n in range(1, 6)] == [32349, 101772, 27989, 21421, 0]


def test_performance_and_timing_come_from_the_frame(bench):
    bench.command("set_mode", mode="lost_in_space")
    bench.step(1.5)
    one, two, timing = (bench.read(n) for n in ("star_performance_1", "star_performance_2", "star_timing"))
    assert one == {
        "stars_detected": 40, "image_noise": pytest.approx(0.6), "invalid_stars": 3, "stars_identified": 35,
        "identification_mode": "lost_in_space", "image_dark": 8,
    }  # fmt: skip
    assert two["sample_period"] == 1000
    assert two["confidence_1"] == 100
    assert all(two[f"{step}_ok"] for step in ("capture", "detection", "identification", "attitude"))
    model = Profile().timing
    assert timing["capture_duration"] == round(100 + model.readout_s * 1e3)
    assert timing["detection_duration"] == round((model.detect_s + 40 * model.detect_per_star_s) * 1e3)
    assert timing["identification_duration"] == round(model.identify_lost_s * 1e3)


def test_the_star_tracker_s_rows_are_laid_out_as_the_drivers_of_albertasat_and_cts_unpack_them(bench):
    """Rows 187 to 189: bytes and words, little-endian, in the order of the two drivers' structures; durations in milliseconds."""
    bench.command("set_mode", mode="lost_in_space")
    bench.step(1.5)
    model = Profile().timing
    assert struct.unpack("<3H", bench.data("star_magnitudes")) == (
        560,
        2180,
        2450,
    )  # scale and offset are ours
    detected, noise, invalid, identified, lost, dark = bench.data("star_performance_1")
    assert (detected, invalid, identified, lost) == (40, 3, 35, 1)
    assert (noise, dark) == (6, 8)  # units are ours
    capture_ms, detection_ms, identification_ms = struct.unpack("<3H", bench.data("star_timing"))
    assert capture_ms == round(100 + model.readout_s * 1e3)
    assert detection_ms == round((model.detect_s + 40 * model.detect_per_star_s) * 1e3)
    assert identification_ms == round(model.identify_lost_s * 1e3)
    assert len({capture_ms, detection_ms, identification_ms}) == 3


def test_a_result_is_known_only_after_its_modelled_latency(bench):
    bench.command("set_mode", mode="lost_in_space")
    model = Profile().timing
    after = 0.1 + model.readout_s + model.detect_s + 40 * model.detect_per_star_s + model.identify_lost_s
    bench.step(after - 0.001)
    assert bench.read("precise_attitude")["reason"] == "no_frame"
    bench.step(0.002)
    attitude = bench.read("precise_attitude")
    assert attitude["valid"]
    assert attitude["latency"] == pytest.approx((after - 0.05) * 1e3, abs=0.1)


def test_an_image_processed_during_the_next_exposure_has_its_result_a_period_later(make_bench):
    """Erlank (2013), table 6.2: images are processed, for 388 ms, while the next one is exposed; 0.94 to 1.24 s after mid-exposure."""
    bench = make_bench(load_profile("cubestar")).start()
    bench.command("set_mode", mode="lost_in_space")
    after = 1.0 + 0.388 + 40 * 0.00005
    bench.step(after - 0.001)
    assert bench.read("precise_attitude")["reason"] == "no_frame"
    bench.step(0.002)
    assert bench.read("precise_attitude")["latency"] == pytest.approx((after - 0.15) * 1e3, abs=0.1)
    assert 940.0 < bench.read("precise_attitude")["latency"] < 1241.0


@pytest.mark.parametrize("rate", [0.5, 1.0, 5.0, 10.0])
def test_frames_come_at_the_update_rate(bench, rate):
    bench.command("set_update_rate", rate=rate)
    bench.command("set_mode", mode="lost_in_space")
    bench.step(20.0)
    counter = bench.read("precise_attitude")["frame_counter"]
    assert abs(counter - 20.0 * rate) <= 2
    assert bench.read("star_performance_2")["sample_period"] == round(1000.0 / rate)


def test_a_new_update_rate_holds_at_once(bench):
    bench.command("set_update_rate", rate=0.1)
    bench.command("set_mode", mode="lost_in_space")
    bench.step(1.0)
    bench.command("set_update_rate", rate=10.0)
    bench.step(2.0)
    assert bench.read("precise_attitude")["frame_counter"] >= 18


@pytest.mark.long
@pytest.mark.parametrize(("exposure", "rate"), [(100, 10.0), (30, 33.333332), (20, 50.0), (10, 100.0)])
def test_the_highest_rate_that_an_exposure_leaves_is_reached(bench, exposure, rate):
    bench.command("set_parameter", parameter=1, value=exposure)
    assert bench.command("set_update_rate", rate=rate) is ErrorCode.OK
    bench.command("set_mode", mode="lost_in_space")
    bench.step(5.0)
    attitude = bench.read("precise_attitude")
    assert abs(attitude["frame_counter"] - 5.0 * rate) <= 0.25 * rate
    mid_points = [frame.index for frame in bench.pipeline.frames]
    assert len(set(mid_points)) == len(mid_points)
    assert bench.device.cycle.skipped == 0


def test_at_a_high_rate_no_exposure_is_left_out_while_results_come_in_time(bench):
    bench.command("set_parameter", parameter=1, value=10.0)
    bench.command("set_update_rate", rate=50.0)
    bench.command("set_mode", mode="lost_in_space")
    model = Profile().timing
    in_time = int((model.readout_s + model.detect_s + model.identify_tracking_s) * 50.0)
    assert in_time > MAX_PENDING
    bench.imager.pending = in_time
    bench.step(1.0)
    assert bench.device.cycle.skipped == 0
    bench.imager.pending = in_time + 1
    bench.step(1.0)
    assert bench.device.cycle.skipped == 50


def test_delay_time_moves_the_exposure(make_bench):
    bench = make_bench(truth=FixedTruth(ORION)).start()
    bench.command("set_parameter", parameter=12, value=300.0)
    begin = bench.clock.now_ns() / 1e9
    bench.command("set_mode", mode="lost_in_space")
    bench.step(0.9)
    mid_s = bench.read("precise_attitude")["time_of_exposure"] - Profile().run.start_unix_s
    assert mid_s == pytest.approx(begin + 0.35)


def test_exposures_that_the_machine_has_no_time_for_are_skipped_and_tracking_continues(bench):
    bench.command("set_mode", mode="lost_in_space")
    bench.step(3.5)
    before = bench.read("precise_attitude")
    assert (before["valid"], bench.mode) == (True, "tracking")
    bench.imager.pending = MAX_PENDING
    bench.step(2.0)
    during = bench.read("precise_attitude")
    assert (during["valid"], during["mode"], bench.mode) == (True, "tracking", "tracking")
    assert during["frame_counter"] == before["frame_counter"]
    assert bench.device.cycle.skipped == 2
    bench.imager.pending = 0
    bench.step(2.0)
    after = bench.read("precise_attitude")
    assert (after["valid"], bench.mode) == (True, "tracking")
    assert after["frame_counter"] == before["frame_counter"] + 2
    bench.imager.pending = MAX_PENDING
    bench.step(10.0)
    assert bench.read("precise_attitude")["reason"] == "no_frame"  # what stands is too old by now


def test_the_age_of_a_frame_counts_from_the_middle_of_its_exposure(bench):
    bench.command("set_mode", mode="lost_in_space")
    bench.step(2.5)
    snapshot = bench.device.snapshot()
    age_s = (bench.clock.now_ns() - snapshot.frame.mid_ns) / 1e9
    assert getter_of("frame.age")(snapshot) == age_s
    assert 0.0 < age_s < 2.5


def test_a_pipeline_that_fails_makes_frames_invalid_and_is_logged_once_until_it_works_again(bench, caplog):
    good, answers = bench.pipeline.handle, []

    def submit(request, done):
        done(answers[0] if answers else good(request))

    bench.imager.submit = submit
    bench.command("set_mode", mode="lost_in_space")
    for answer, valid in ((Failure("out of memory"), False), (None, True), (Failure("out of memory"), False)):
        answers[:] = [] if answer is None else [answer]
        bench.step(3.0)
        reading = bench.read("precise_attitude")
        assert (reading["valid"], reading["reason"]) == (valid, "ok" if valid else "processing_error")
    assert caplog.text.count("out of memory") == 2


def test_cubestar_processes_an_image_while_it_takes_the_next_one_as_in_erlanks_table(make_bench):
    """Erlank (2013), table 6.2, cycle of 1000 ms: idle 140 ms, imager on 68 ms, "expose and process previous image" 388 ms,
    transfer of the image 404 ms; 396.2 mW on average at 3.3 V. A result comes during the next period's exposure."""
    bench = make_bench(load_profile("cubestar", ["run.clock=stepped"])).start()
    bench.command("set_mode", mode="lost_in_space")
    phases = []
    bench.step(4.0)
    for _ in range(1000):
        bench.step(0.001)
        phases.append(bench.device.snapshot().phase.value)
    lasting = {name: phases.count(name) for name in set(phases)}
    published = {"idle": 140, "imager_on": 68, "exposure": 388, "transfer": 404}
    assert lasting == pytest.approx(published, abs=2)
    currents_ma = {"idle": 71.2, "imager_on": 121.2, "exposure": 177.3, "transfer": 81.81}
    assert 3.3 * sum(currents_ma[name] * lasting[name] for name in lasting) / 1e3 == pytest.approx(
        396.2, rel=0.01
    )
    changes = [name for name, before in zip(phases, [phases[-1], *phases], strict=False) if name != before]
    start = changes.index("exposure")
    assert changes[start:] + changes[:start] == ["exposure", "transfer", "idle", "imager_on"]
    latency_s = bench.read("precise_attitude")["latency"] / 1e3
    assert 1.0 - 0.15 < latency_s < 1.0 - 0.15 + 0.388 + 0.005
    assert latency_s == pytest.approx(1.238, abs=0.005)
    assert bench.read("precise_attitude")["reason"] == "ok"


def test_an_afterimage_lasts_from_exposure_to_exposure_until_the_pipeline_is_started_again(bench):
    """The begins are those of the exposures, not of their results, and a rehearsal, which nobody counts, has none."""
    assert bench.device.cycle.rehearsal({}).rehearsal.begin_s is None
    bench.command("set_mode", mode="lost_in_space")
    bench.step(4.0)
    first = bench.pipeline.frames[-3:]
    period_s, exposure_s = 1.0 / bench.device.parameters["update_rate"], bench.device.cycle.exposure_s
    begins = [frame.begin_s for frame in first]
    assert [after - before for before, after in pairwise(begins)] == pytest.approx([period_s] * 2)
    assert bench.clock.now_ns() / 1e9 - begins[-1] < period_s + exposure_s
    assert {frame.pipeline_starts for frame in first} == {1}
    bench.device.pipeline_ready({})
    bench.step(2.0)
    assert bench.pipeline.frames[-1].pipeline_starts == 2
