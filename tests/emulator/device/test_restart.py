"""What a restart does, what survives it, and the clock."""

import pytest

from emulator.device.state_store import FileStore
from emulator.errors import EmulatorError
from protocol.messages import ErrorCode


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
