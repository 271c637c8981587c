"""The device in its modes: by command, by result, at boot and in error."""

from starhil.emulator.profile import Profile
from starhil.protocol.messages import ErrorCode, Request


def test_modes_go_by_command_and_by_result(bench):
    assert bench.mode == "standby"
    assert bench.command("set_mode", mode="tracking") is ErrorCode.SEQUENCE
    assert bench.command("set_mode", mode="lost_in_space") is ErrorCode.OK
    bench.step(2.5)
    assert bench.mode == "tracking"
    bench.pipeline.fail = "prediction_lost"
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


def test_the_end_of_boot_changes_nothing_once_a_fault_has_ended_it(make_bench):
    bench = make_bench(Profile(parameters={"start_mode": "lost_in_space"}))
    bench.device.power_on()
    bench.device.pipeline_ready({})
    bench.device.modes.fail("catalogue")
    assert bench.command("set_mode", mode="standby") is ErrorCode.OK
    bench.step(5.0)
    assert bench.mode == "standby"


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
    bench.device.unresponsive = True
    assert bench.requests.handle(Request.of(128)) == []
    bench.device.unresponsive = False
    assert bench.read("communication_status")["telemetry_count"] == 1
