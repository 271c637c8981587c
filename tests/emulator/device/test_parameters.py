"""Parameters: set, refused, and where they act."""

import math

import pytest

from starhil.emulator.errors import EmulatorError
from starhil.emulator.profile import Profile
from starhil.emulator.sensor.pipeline.messages import camera_constants
from starhil.protocol.icd.device_model import device_model
from starhil.protocol.messages import ErrorCode
from starid.camera import DEFAULT_CAMERA, Camera

F32 = 1e-6


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


def holds(bench, name):
    """Present value of a parameter as telemetry 162 reports it."""
    bench.command("select_parameter", parameter=bench.icd.parameters[name].id)
    return bench.read("parameter")["value"]


def test_a_rate_too_high_for_the_exposure_is_refused(bench):
    assert bench.command("set_update_rate", rate=20.0) is ErrorCode.INVALID_PARAMETER
    assert bench.command("set_parameter", parameter=29, value=10.1) is ErrorCode.INVALID_PARAMETER
    assert bench.read("acknowledge")["parameter_index"] == 1
    assert holds(bench, "update_rate") == 1.0
    assert bench.command("set_update_rate", rate=10.0) is ErrorCode.OK
    assert holds(bench, "update_rate") == 10.0


@pytest.mark.parametrize(("name", "value"), [("exposure", 101), ("exposure", 500), ("delay_time", 1)])
def test_an_exposure_or_delay_too_long_for_the_rate_is_refused(bench, name, value):
    bench.command("set_update_rate", rate=10.0)
    before = holds(bench, name)
    identifier = bench.icd.parameters[name].id
    assert bench.command("set_parameter", parameter=identifier, value=value) is ErrorCode.INVALID_PARAMETER
    assert (holds(bench, name), holds(bench, "update_rate")) == (before, 10.0)


def test_the_acknowledge_names_the_configuration_field_too_long_for_the_rate(bench):
    bench.command("set_update_rate", rate=10.0)
    config = {**bench.read("star_config"), "delay_time": 50}
    assert bench.command("set_star_config", **config) is ErrorCode.INVALID_PARAMETER
    fields = list(bench.icd.telecommands["set_star_config"].named_fields)
    assert bench.read("acknowledge")["parameter_index"] == fields.index("delay_time")
    assert bench.command("set_star_config", **{**config, "exposure": 50}) is ErrorCode.OK


def test_every_exposure_and_delay_has_a_rate_that_leaves_it_time(bench):
    bench.command("set_update_rate", rate=bench.icd.parameters["update_rate"].minimum)
    for name in ("exposure", "delay_time"):
        parameter = bench.icd.parameters[name]
        sent = bench.command("set_parameter", parameter=parameter.id, value=parameter.maximum)
        assert sent is ErrorCode.OK


def test_a_profile_with_a_rate_too_high_for_its_exposure_is_rejected(make_bench):
    with pytest.raises(EmulatorError) as rejection:
        make_bench(Profile(name="bench", parameters={"update_rate": 20.0}))
    assert str(rejection.value) == (
        "profile bench: parameters.update_rate: 20 Hz leaves 50 ms per frame, exposure 100 ms and delay_time 0 ms take 100 ms; "
        "set update_rate to 10 Hz or less, or shorten them"
    )
    assert (
        make_bench(Profile(parameters={"update_rate": 50.0, "exposure": 20})).device.parameters["exposure"]
        == 20
    )


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
    request = bench.pipeline.frames[-1]
    assert (request.exposure_s, request.gain) == (0.06, 2.0)
    for name in set(changes) - {"exposure", "analog_gain"}:
        assert getattr(request.settings, name) == pytest.approx(changes[name], rel=F32), name


def test_tracking_flag_keeps_the_device_lost_in_space(bench):
    bench.command("set_parameter", parameter=27, value=0.0)
    bench.command("set_mode", mode="lost_in_space")
    bench.step(5.0)
    assert bench.mode == "lost_in_space"
    assert all(request.predicted is None for request in bench.pipeline.frames)


def test_one_parameter_is_set_read_and_refused(bench):
    assert bench.command("set_parameter", parameter=29, value=2.5) is ErrorCode.OK
    assert bench.read("parameter") == {
        "parameter": 29, "value": 2.5, "minimum": pytest.approx(0.01), "maximum": 100.0, "default": 1.0,
    }  # fmt: skip
    for identifier, value, code in ((29, 101.0, 3), (29, math.nan, 3), (1, 1.5, 3), (250, 1.0, 3)):
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
def test_a_profile_with_bad_parameters_is_rejected(make_bench, parameters):
    with pytest.raises(EmulatorError, match="parameters"):
        make_bench(Profile(parameters=parameters))


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"exposure": 1e9}, "profile bench: parameters.exposure: 1e+09 is outside"),
        ({"nope": 1}, "profile bench: parameters: no parameter named 'nope'"),
    ],
)
def test_a_bad_default_is_rejected_with_the_name_of_its_profile(make_bench, given, said):
    with pytest.raises(EmulatorError) as refusal:
        make_bench(Profile(name="bench", parameters=given))
    assert str(refusal.value).startswith(said)


def test_a_profile_may_give_the_device_another_idea_of_its_camera(make_bench):
    bench = make_bench(Profile.model_validate({"parameters": {"focal_length": 1230.0}}))
    bench.device.power_on()
    bench.device.pipeline_ready({"focal_length": 1220.0, "k1": 0.01})
    assert bench.device.parameters["focal_length"] == 1230.0
    assert bench.device.parameters["k1"] == pytest.approx(0.01)


def test_the_camera_of_a_profile_and_the_defaults_of_the_model_are_the_camera_of_starid():
    assert Camera.from_dict(Profile().camera_values) == DEFAULT_CAMERA
    defaults = {name: item.default for name, item in device_model().parameters.items()}
    constants = camera_constants(DEFAULT_CAMERA.to_dict())
    assert {name: defaults[name] for name in constants} == pytest.approx(constants, rel=F32)
