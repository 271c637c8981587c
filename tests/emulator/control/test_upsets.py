"""Bits that particles flip in the memory: of parameters, and of the star catalogue."""

import pytest

from starhil.emulator.errors import EmulatorError
from starhil.emulator.profile import Profile
from starhil.emulator.run.faults import FaultRequest, Faults

THRESHOLD_BIT = 22


def inject(bench, **upset):
    faults = Faults(bench.requests, {})
    faults.inject(FaultRequest.model_validate({"device": {"upset": upset}}))
    return faults


@pytest.mark.parametrize(
    ("name", "bit", "before", "after"),
    [("exposure", 3, 100, 108), ("min_stars_matched", 4, 4, 20), ("tracking_enable", 0, True, False)],
)
def test_a_flip_that_gives_a_valid_setting_goes_unnoticed(bench, name, bit, before, after):
    assert bench.device.parameters[name] == before
    inject(bench, parameter=name, bit=bit)
    assert bench.device.parameters[name] == after
    assert bench.mode == "standby"
    assert bench.read("device_status")["parameters_changed"]


def test_single_precision_flips_as_in_memory(bench):
    inject(bench, parameter="detection_threshold", bit=THRESHOLD_BIT)
    assert bench.device.parameters["detection_threshold"] == pytest.approx(7.0)  # 5 = 1.25·2², 7 = 1.75·2²


@pytest.mark.parametrize(("name", "bit"), [("max_star_pixels", 1), ("update_rate", 30), ("focal_length", 31)])
def test_a_flip_that_gives_an_invalid_setting_ends_in_the_error_mode_until_a_restart(bench, name, bit):
    default = bench.device.parameters.state.defaults[name]
    if name == "max_star_pixels":
        bench.command("set_parameter", parameter=bench.icd.parameters[name].id, value=2)
        bit = 1
    inject(bench, parameter=name, bit=bit)
    assert bench.mode == "error"
    assert bench.read("device_status")["error"] == "parameter_store"
    assert bench.device.parameters[name] == default
    bench.command("reset", magic=90)
    bench.step(2.0)
    assert bench.mode == "standby"


def test_restoring_the_parameters_undoes_a_flip(bench):
    inject(bench, parameter="exposure", bit=3)
    bench.command("restore_parameters")
    assert bench.device.parameters["exposure"] == 100


def test_flips_in_the_catalogue_reach_the_pipeline_until_a_restart(bench):
    faults = inject(bench, star=27989, component=1, bit=20)
    assert faults.describe() == {"device": {"upset_stars": [27989]}}
    bench.command("set_mode", mode="lost_in_space")
    bench.step(1.5)
    (upset,) = bench.pipeline.frames[-1].upsets
    assert (upset.hip, upset.component, upset.bit) == (27989, 1, 20)
    bench.command("reset", magic=90)
    bench.step(2.0)
    assert bench.device.cycle.upsets == ()


def test_a_stored_flip_shows_at_the_next_restart_and_survives_it(bench):
    inject(bench, parameter="exposure", bit=3, stored=True)
    assert bench.device.parameters["exposure"] == 100
    assert bench.read("device_status")["parameters_changed"]  # a restart would change them
    for _ in range(2):
        bench.command("reset", magic=90)
        bench.step(2.0)
        assert bench.mode == "standby"
        assert bench.device.parameters["exposure"] == 108
    bench.device.parameters.set({"exposure": 100})
    bench.command("save_parameters")
    bench.step(1.0)
    bench.command("reset", magic=90)
    bench.step(2.0)
    assert bench.device.parameters["exposure"] == 100


@pytest.mark.parametrize(
    ("name", "saved", "bit", "restarted"),
    [("exposure", 96, 5, 64), ("update_rate", 2.0, 31, 1.0)],
    ids=["the saved value is flipped, not the default", "an invalid flip is ignored"],
)
def test_a_stored_flip_shows_at_the_restart(bench, name, saved, bit, restarted):
    bench.device.parameters.set({name: saved})
    bench.command("save_parameters")
    bench.step(1.0)
    inject(bench, parameter=name, bit=bit, stored=True)
    bench.command("reset", magic=90)
    bench.step(2.0)
    assert bench.mode == "standby"
    assert bench.device.parameters[name] == restarted


def test_a_stored_flip_in_the_catalogue_survives_a_restart_until_faults_are_cleared(bench):
    faults = inject(bench, star=27989, component=1, bit=20, stored=True)
    bench.command("reset", magic=90)
    bench.step(2.0)
    assert faults.describe() == {"device": {"upset_stars": [27989]}}
    faults.clear()
    bench.command("reset", magic=90)
    bench.step(2.0)
    assert bench.device.cycle.upsets == ()


@pytest.mark.parametrize(
    ("upset", "message"),
    [
        ({"parameter": "exposur", "bit": 1}, "exposur"),
        ({"parameter": "exposure", "bit": 16}, "bits 0 to 15"),
        ({"star": 27989, "bit": 32}, "bits 0 to 31"),
    ],
)
def test_a_bit_that_does_not_exist_is_rejected(bench, upset, message):
    with pytest.raises(EmulatorError, match=message):
        inject(bench, **upset)


def test_algorithms_that_keep_no_directions_reject_an_upset_star(make_bench):
    bench = make_bench(Profile.model_validate({"run": {"algorithm": "lsi"}})).start()
    with pytest.raises(EmulatorError, match="geometric"):
        inject(bench, star=27989, bit=3)


@pytest.mark.parametrize("upset", [{"bit": 1}, {"parameter": "exposure", "star": 1, "bit": 1}])
def test_an_upset_has_one_target(bench, upset):
    with pytest.raises(ValueError, match="either parameter or star"):
        inject(bench, **upset)
