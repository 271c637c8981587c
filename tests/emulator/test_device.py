"""The device without links and without pictures: what it answers, by names of the interface definition."""

import math

import numpy as np
import pytest

from emulator.device.device import missing_handlers
from emulator.device.state_store import FileStore
from emulator.device.telecommands import TELECOMMANDS
from emulator.device.telemetry import TELEMETRY
from emulator.errors import EmulatorError
from emulator.profile import Profile
from emulator.truth.source import FixedTruth, RateTruth
from protocol.icd import load_icd
from protocol.messages import ErrorCode, ReplyKind, Request
from starid.attitude import Attitude

ORION = Attitude.from_radec_roll(83.8, -1.2, 0.0)
F32 = 1e-6
CENTIMAG = 0.001


# --- every row has a handler ---


def test_every_row_of_the_definition_is_served():
    icd = load_icd()
    assert missing_handlers(icd) == []
    assert set(TELEMETRY) == set(icd.telemetry)
    assert set(TELECOMMANDS) == set(icd.telecommands)


@pytest.mark.parametrize("mode", ["standby", "lost_in_space"])
@pytest.mark.parametrize("name", load_icd().telemetry)
def test_every_telemetry_row_answers_in_every_state(make_bench, name, mode):
    bench = make_bench().start()
    bench.command("set_mode", mode=mode)
    bench.step(3.0)
    values = bench.read(name)
    assert set(values) == set(bench.icd.telemetry[name].named_fields)


# --- errors as published ---


@pytest.mark.parametrize(
    ("identifier", "data", "code"),
    [
        (31, b"", ErrorCode.INVALID_ID),
        (0, b"\x01", ErrorCode.INVALID_ID),
        (200, b"", ErrorCode.INVALID_ID),
        (1, b"", ErrorCode.INVALID_LENGTH),
        (1, b"\x5a\x00", ErrorCode.INVALID_LENGTH),
        (1, b"\x5b", ErrorCode.INVALID_PARAMETER),
        (96, b"\x04", ErrorCode.INVALID_PARAMETER),
        (2, b"\x00\x00\x00\x00\xe8\x03", ErrorCode.INVALID_PARAMETER),
        (37, bytes(52), ErrorCode.INVALID_LENGTH),
        (128, b"\x00", ErrorCode.INVALID_LENGTH),
    ],
)
def test_bad_requests_get_the_published_code_and_change_nothing(bench, identifier, data, code):
    (reply,) = bench.device.handle(Request.of(identifier, data))
    assert (reply.kind, reply.id, reply.code) == (ReplyKind.NACK, identifier, code)
    assert bench.mode == "standby"


def test_acknowledge_tells_what_became_of_the_last_telecommand(bench):
    bench.command("set_mode", mode="lost_in_space")
    assert bench.read("acknowledge") == {
        "last_telecommand": 96, "processed": True, "error": "ok", "parameter_index": 0,
    }  # fmt: skip
    bench.send("set_unix_time", b"\x00\x00\x00\x00\xff\xff")
    assert bench.read("acknowledge") == {
        "last_telecommand": 2, "processed": True, "error": "invalid_parameter", "parameter_index": 1,
    }  # fmt: skip
    bench.send("set_mode", b"")
    assert bench.read("acknowledge")["error"] == "invalid_length"


def test_counters_count_and_clear(bench):
    for _ in range(3):
        bench.command("set_mode", mode="standby")
    bench.device.handle(Request.of(31))
    status = bench.read("communication_status")
    assert (status["telecommand_count"], status["telemetry_count"]) == (4, 1)
    assert bench.command("clear_counters") is ErrorCode.OK
    status = bench.read("communication_status")
    assert (status["telecommand_count"], status["telemetry_count"]) == (0, 1)


def test_counters_wrap_at_16_bits(bench):
    bench.device.counters.telecommands = 65535
    bench.command("set_mode", mode="standby")
    assert bench.read("communication_status")["telecommand_count"] == 0


# --- modes ---


def test_modes_go_by_command_and_by_result(bench):
    assert bench.mode == "standby"
    assert bench.command("set_mode", mode="tracking") is ErrorCode.SEQUENCE
    assert bench.command("set_mode", mode="lost_in_space") is ErrorCode.OK
    bench.step(2.5)
    assert bench.mode == "tracking"
    bench.picture.fail = "prediction_lost"
    bench.step(1.0)
    assert bench.mode == "lost_in_space"
    assert bench.command("set_mode", mode="tracking") is ErrorCode.OK  # from the attitude that it still has
    assert bench.command("set_mode", mode="standby") is ErrorCode.OK
    assert bench.command("set_mode", mode="tracking") is ErrorCode.OK
    bench.command("set_mode", mode="standby")
    bench.step(60.0)
    assert bench.command("set_mode", mode="tracking") is ErrorCode.SEQUENCE  # too old by now


def test_nothing_but_telemetry_is_taken_in_boot(make_bench):
    bench = make_bench()
    bench.device.power_on()
    assert bench.read("device_status")["mode"] == "boot"
    assert bench.read("identification")["node_type"] == 0x53
    assert bench.command("set_mode", mode="lost_in_space") is ErrorCode.SEQUENCE
    assert bench.command("save_image", image_size="size_64") is ErrorCode.SEQUENCE
    bench.step(5.0)
    assert bench.mode == "boot"  # the pipeline is not ready
    bench.device.pipeline_ready({})
    assert bench.mode == "standby"


def test_boot_takes_its_time(make_bench):
    bench = make_bench()
    bench.device.power_on()
    bench.device.pipeline_ready({})
    bench.step(0.49)
    assert bench.mode == "boot"
    bench.step(0.02)
    assert bench.mode == "standby"


def test_start_mode_is_entered_after_boot(make_bench):
    bench = make_bench(Profile(parameters={"start_mode": "lost_in_space"})).start()
    assert bench.device.modes.mode.makes_frames


def test_error_is_left_for_standby_only(bench):
    bench.device.modes.fail("sensor")
    assert bench.read("device_status")["error"] == "sensor"
    assert bench.command("set_mode", mode="lost_in_space") is ErrorCode.SEQUENCE
    assert bench.command("set_mode", mode="standby") is ErrorCode.OK
    assert bench.read("device_status")["error"] == "none"


def test_a_lost_pipeline_is_an_error_until_it_is_back(bench):
    bench.command("set_mode", mode="lost_in_space")
    bench.device.pipeline_lost()
    assert bench.read("device_status")["error"] == "processing"
    assert bench.read("precise_attitude")["reason"] == "processing_error"
    assert bench.command("set_mode", mode="standby") is ErrorCode.SEQUENCE
    bench.device.pipeline_ready({})
    assert bench.command("set_mode", mode="standby") is ErrorCode.OK


def test_a_stuck_device_takes_and_answers_nothing(bench):
    bench.device.deaf = True
    assert bench.device.handle(Request.of(128)) == []
    bench.device.deaf = False
    assert bench.read("communication_status")["telemetry_count"] == 1


# --- reset, boot count, what is kept ---


def test_reset_is_acknowledged_then_done(bench):
    bench.step(10.0)
    bench.command("set_mode", mode="lost_in_space")
    bench.command("set_unix_time", seconds=1_800_000_000)
    assert bench.command("reset") is ErrorCode.OK
    bench.step(0.1)
    assert bench.mode == "boot"
    boot = bench.read("boot_status")
    assert (boot["reset_cause"], boot["boot_cause"], boot["boot_count"]) == ("command", "command", 2)
    status = bench.read("device_status")
    assert status["uptime"] == pytest.approx(0.1)
    assert not status["time_set"]
    assert bench.read("communication_status")["telecommand_count"] == 0
    bench.step(1.0)
    assert bench.mode == "standby"


def test_saved_parameters_survive_a_restart_and_others_do_not(make_bench, tmp_path):
    bench = make_bench(store=FileStore(tmp_path)).start()
    bench.command("set_parameter", parameter=1, value=55.0)
    assert bench.read("device_status")["parameters_changed"]
    assert bench.command("save_parameters") is ErrorCode.OK
    assert not bench.read("device_status")["parameters_changed"]
    bench.command("set_update_rate", rate=4.0)
    bench.store.close()
    again = make_bench(store=FileStore(tmp_path)).start()
    assert again.device.parameters["exposure"] == 55
    assert again.device.parameters["update_rate"] == 1.0
    assert again.read("boot_status")["boot_count"] == 2
    assert not again.read("device_status")["store_fault"]
    again.command("set_parameter", parameter=1, value=99.0)
    again.command("restore_parameters")
    assert again.device.parameters["exposure"] == 55
    again.command("default_parameters")
    assert again.device.parameters["exposure"] == 100
    again.store.close()


def test_forgotten_parameters_are_defaults_after_the_next_restart(make_bench, tmp_path):
    bench = make_bench(store=FileStore(tmp_path)).start()
    bench.command("set_parameter", parameter=1, value=55.0)
    bench.command("save_parameters")
    told = []
    bench.device.forget_parameters(told.append)
    assert told == [None]
    assert bench.device.parameters["exposure"] == 55
    assert bench.read("device_status")["parameters_changed"]
    bench.command("reset")
    bench.step(1.0)
    assert bench.device.parameters["exposure"] == 100
    bench.store.close()


def test_a_corrupt_store_gives_defaults_and_a_flag(make_bench, tmp_path):
    bench = make_bench(store=FileStore(tmp_path)).start()
    bench.command("set_parameter", parameter=1, value=55.0)
    bench.command("save_parameters")
    bench.store.close()
    (tmp_path / "device.json").write_text("{")
    again = make_bench(store=FileStore(tmp_path)).start()
    assert again.device.parameters["exposure"] == 100
    assert again.read("device_status")["store_fault"]
    again.store.close()


def test_stored_values_that_are_no_longer_allowed_are_passed_over(make_bench, tmp_path):
    store = FileStore(tmp_path)
    store.save(
        {"boot_count": "x", "parameters": {"exposure": 1e9, "colour": 3, "analog_gain": 2.0, "k1": None}}
    )
    bench = make_bench(store=store).start()
    assert bench.device.parameters["exposure"] == 100
    assert bench.device.parameters["analog_gain"] == 2.0
    assert bench.read("boot_status")["boot_count"] == 1
    store.close()


def test_a_store_that_cannot_write_is_told_in_the_acknowledge(make_bench, tmp_path, monkeypatch):
    bench = make_bench(store=FileStore(tmp_path)).start()

    def fail(_content):
        raise EmulatorError("state file: cannot be written")

    monkeypatch.setattr(bench.store, "save", fail)
    bench.command("set_parameter", parameter=1, value=55.0)
    bench.command("save_parameters")
    assert bench.read("acknowledge")["error"] == "internal"
    assert bench.read("device_status")["parameters_changed"]
    bench.store.close()


def test_a_telecommand_before_the_last_one_is_done_is_an_overrun(make_bench):
    bench = make_bench().start()
    later = []
    bench.device._background = lambda work, done: later.append((work, done))
    bench.command("save_parameters")
    assert not bench.read("acknowledge")["processed"]
    bench.command("set_mode", mode="standby")
    assert bench.read("communication_status")["telecommand_overrun"]
    for work, done in later:
        work()
        done(None)
    assert bench.read("acknowledge")["last_telecommand"] == 96


# --- time ---


def test_time_is_set_and_used_for_stamps(bench):
    bench.command("set_unix_time", seconds=1_800_000_000, milliseconds=250)
    assert bench.read("unix_time") == {"seconds": 1_800_000_000, "milliseconds": 250}
    bench.command("set_mode", mode="lost_in_space")
    bench.step(1.0)
    attitude = bench.read("precise_attitude")
    assert attitude["time_of_exposure"] == pytest.approx(
        1_800_000_000.300, abs=1e-6
    )  # half of 100 ms after the start
    assert attitude["time_set"]


# --- attitude ---


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


def test_tracking_predicts_with_the_rate(make_bench):
    rate = np.radians([0.0, 0.5, 0.0])
    truth = RateTruth(ORION, rate)
    bench = make_bench(truth=truth).start()
    bench.command("set_mode", mode="lost_in_space")
    bench.step(4.5)
    first, second, third, *_ = bench.picture.frames
    assert first.predicted_xyzw is None
    assert second.predicted_xyzw is None  # one attitude gives no rate
    predicted = Attitude(np.array(third.predicted_xyzw))
    assert predicted.error_to(Attitude(np.array(third.attitude_xyzw))).total_arcsec < 0.001
    bench.command("set_parameter", parameter=28, value=0.0)  # prediction off: the last attitude as it was
    bench.step(1.0)
    last = bench.picture.frames[-1]
    off = (
        Attitude(np.array(last.predicted_xyzw)).error_to(Attitude(np.array(last.attitude_xyzw))).total_arcsec
    )
    assert off == pytest.approx(0.5 * 3600.0, rel=1e-6)


def test_validity_clears_at_the_first_failed_frame_with_its_reason(bench):
    bench.command("set_mode", mode="lost_in_space")
    bench.step(3.5)
    assert bench.read("precise_attitude")["valid"]
    bench.picture.fail = "too_few_stars"
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


def test_mounting_turns_what_is_reported(bench):
    bench.command("set_mode", mode="lost_in_space")
    bench.command("set_parameter", parameter=20, value=90.0)  # alpha: about x
    bench.step(3.5)
    values = bench.read("precise_attitude")
    body = Attitude(np.array([values[f"q_{axis}"] for axis in "xyzw"]))
    assert body.matrix[0] == pytest.approx(ORION.matrix[0], abs=F32)  # x stays
    assert body.matrix[1] == pytest.approx(ORION.matrix[2], abs=F32)  # y turns to where z was
    assert body.matrix[2] == pytest.approx(-ORION.matrix[1], abs=F32)


# --- stars and timing ---


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


def test_exposure_bounds_the_update_rate(bench):
    bench.command("set_parameter", parameter=1, value=500.0)
    bench.command("set_update_rate", rate=10.0)
    bench.command("set_mode", mode="lost_in_space")
    bench.step(10.2)
    assert 18 <= bench.read("precise_attitude")["frame_counter"] <= 20
    assert bench.read("star_performance_2")["sample_period"] == 500


def test_delay_time_moves_the_exposure(make_bench):
    bench = make_bench(truth=FixedTruth(ORION)).start()
    bench.command("set_parameter", parameter=12, value=300.0)
    begin = bench.clock.now_ns() / 1e9
    bench.command("set_mode", mode="lost_in_space")
    bench.step(0.9)
    mid_s = bench.read("precise_attitude")["time_of_exposure"] - Profile().run.start_unix_s
    assert mid_s == pytest.approx(begin + 0.35)


# --- parameters ---


def test_star_config_sets_all_or_nothing(bench):
    config = bench.read("star_config")
    assert (
        bench.command("set_star_config", **{**config, "exposure": 77, "focal_length": 1300.0}) is ErrorCode.OK
    )
    assert bench.read("star_config")["exposure"] == 77
    good = bench.icd.telecommands["set_star_config"].encode({**config, "exposure": 88})
    bad = good[:17] + b"\x00" + good[18:]  # error margin 0
    bench.send("set_star_config", bad)
    assert bench.read("acknowledge")["error"] == "invalid_parameter"
    assert bench.read("acknowledge")["parameter_index"] == 11
    assert bench.read("star_config")["exposure"] == 77


def test_contradicting_parameters_are_refused(bench):
    config = {**bench.read("star_config"), "min_star_pixels": 9, "max_star_pixels": 8}
    assert bench.command("set_star_config", **config) is ErrorCode.INVALID_PARAMETER


def test_parameters_reach_the_pipeline(bench):
    config = bench.read("star_config")
    changes = {
        "exposure": 60, "analog_gain": 2.0, "detection_threshold": 7.5, "star_threshold": 2.5, "max_stars_matched": 20,
        "max_star_pixels": 99, "min_star_pixels": 3, "error_margin": 120, "centroid_x": 460.0, "centroid_y": 470.0,
        "focal_length": 1200.0, "k1": 0.01, "k2": -0.02, "p1": 0.001, "p2": -0.001, "window_width": 31,
        "tracking_margin": 7, "validation_margin": 3, "search_width": 12.0,
    }  # fmt: skip
    bench.command("set_star_config", **{**config, **changes})
    bench.command("set_mode", mode="lost_in_space")
    bench.step(1.0)
    request = bench.picture.frames[-1]
    assert (request.exposure_s, request.gain) == (0.06, 2.0)
    for name in set(changes) - {"exposure", "analog_gain"}:
        assert getattr(request.settings, name) == pytest.approx(changes[name], rel=F32), name


def test_tracking_flag_keeps_the_device_lost_in_space(bench):
    bench.command("set_parameter", parameter=27, value=0.0)
    bench.command("set_mode", mode="lost_in_space")
    bench.step(5.0)
    assert bench.mode == "lost_in_space"
    assert all(request.predicted_xyzw is None for request in bench.picture.frames)


def test_one_parameter_is_set_read_and_refused(bench):
    assert bench.command("set_parameter", parameter=29, value=2.5) is ErrorCode.OK
    assert bench.read("parameter") == {
        "parameter": 29, "value": 2.5, "minimum": pytest.approx(0.1), "maximum": 20.0, "default": 1.0,
    }  # fmt: skip
    for identifier, value, code in ((29, 99.0, 3), (29, math.nan, 3), (1, 1.5, 3), (250, 1.0, 3)):
        row = bench.icd.telecommands["set_parameter"]
        data = row.encode({"parameter": identifier, "value": value}, check=False)
        assert bench.send("set_parameter", data)[0].code == code
    assert bench.device.parameters["update_rate"] == 2.5
    bench.command("select_parameter", parameter=1)
    assert bench.read("parameter")["value"] == 100.0
    assert bench.command("select_parameter", parameter=200) is ErrorCode.INVALID_PARAMETER


def test_camera_constants_become_defaults_unless_set(make_bench):
    bench = make_bench()
    bench.device.power_on()
    bench.command("set_parameter", parameter=13, value=400.0)
    bench.device.pipeline_ready({"focal_length": 1500.0, "centroid_x": 500.0})
    assert bench.device.parameters["focal_length"] == 1500.0
    assert bench.device.parameters["centroid_x"] == 400.0
    bench.command("default_parameters")
    assert bench.device.parameters["centroid_x"] == 500.0


@pytest.mark.parametrize(
    "parameters", [{"exposur": 3}, {"exposure": -1}, {"exposure": "long"}, {"exposure": [1]}]
)
def test_a_profile_with_bad_parameters_is_refused(make_bench, parameters):
    with pytest.raises(EmulatorError, match="parameters"):
        make_bench(Profile(parameters=parameters))


# --- unsolicited telemetry ---


def test_unsolicited_telemetry_goes_out_at_its_rate(bench):
    sent = []
    bench.device.outlets.append(sent.append)
    assert bench.command("set_unsolicited", telemetry=160, rate=4.0) is ErrorCode.OK
    bench.step(9.99)
    assert len(sent) == 40
    assert {(reply.kind, reply.id, reply.destination) for reply in sent} == {(ReplyKind.UNSOLICITED, 160, 1)}
    assert bench.icd.telemetry["precise_attitude"].decode(sent[0].data)["reason"] == "not_running"
    bench.command("set_unsolicited", telemetry=160, rate=0.0)
    bench.step(5.0)
    assert len(sent) == 40


def test_unsolicited_telemetry_of_the_profile_starts_by_itself(make_bench):
    bench = make_bench(Profile(parameters={"unsolicited_rate": 2.0, "unsolicited_selection": 128}))
    sent = []
    bench.device.outlets.append(sent.append)
    bench.start()
    assert len(sent) == 3
    assert sent[0].id == 128


def test_unsolicited_telemetry_needs_a_row(bench):
    assert bench.command("set_unsolicited", telemetry=200, rate=1.0) is ErrorCode.INVALID_PARAMETER


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"exposure": 1e9}, "profile bench: parameters.exposure: 1e+09 is outside"),
        ({"nope": 1}, "profile bench: parameters: no parameter named 'nope'"),
    ],
)
def test_a_bad_default_is_refused_with_the_name_of_its_profile(make_bench, given, said):
    with pytest.raises(EmulatorError) as refusal:
        make_bench(Profile(name="bench", parameters=given))
    assert str(refusal.value).startswith(said)


def test_a_profile_may_give_the_device_another_idea_of_its_camera(make_bench):
    bench = make_bench(Profile.model_validate({"parameters": {"focal_length": 1230.0}}))
    bench.device.power_on()
    bench.device.pipeline_ready({"focal_length": 1220.0, "k1": 0.01})
    assert bench.device.parameters["focal_length"] == 1230.0
    assert bench.device.parameters["k1"] == pytest.approx(0.01)
