"""What a restart does, what survives it, and the clock."""

import pytest

from starhil.emulator.device.device import run_at_once
from starhil.emulator.device.state_store import FileStore
from starhil.emulator.errors import EmulatorError
from starhil.protocol.messages import ErrorCode, ReplyKind


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


class LaterBackground:
    """A writer that does nothing until it is released, as a slow disk."""

    def __init__(self):
        self.waiting = []

    def __call__(self, work, done):
        self.waiting.append((work, done))

    def catch_up(self):
        while self.waiting:
            run_at_once(*self.waiting.pop(0))


def test_a_reset_before_the_disk_has_parameters_keeps_them(make_bench, tmp_path):
    bench = make_bench(store=FileStore(tmp_path)).start()
    bench.device._background = disk = LaterBackground()
    bench.command("set_parameter", parameter=1, value=55.0)
    bench.send("save_parameters")
    bench.command("reset")
    bench.step(1.0)
    assert bench.device.parameters["exposure"] == 55
    disk.catch_up()
    assert not bench.read("device_status")["parameters_changed"]
    assert bench.store.load()["parameters"]["exposure"] == 55
    assert bench.store.load()["boot_count"] == 2
    bench.store.close()


def test_resets_faster_than_the_disk_are_all_counted(make_bench):
    bench = make_bench()
    bench.device._background = disk = LaterBackground()
    bench.start()
    for count in (2, 3):
        bench.command("reset")
        bench.step(0.1)
        assert bench.read("boot_status")["boot_count"] == count
    disk.catch_up()
    assert bench.store.load()["boot_count"] == 3
    bench.command("reset")
    bench.step(0.1)
    assert bench.read("boot_status")["boot_count"] == 4


def test_a_save_that_fails_after_a_reset_takes_back_nothing_that_the_next_one_wrote(make_bench, monkeypatch):
    bench = make_bench().start()
    bench.device._background = disk = LaterBackground()
    bench.command("set_parameter", parameter=1, value=55.0)
    bench.send("save_parameters")
    bench.command("reset")
    bench.step(1.0)
    really, failed = bench.store.save, []

    def fail_once(content):
        if not failed:
            failed.append(content)
            raise EmulatorError("state file: cannot be written")
        really(content)

    monkeypatch.setattr(bench.store, "save", fail_once)
    disk.catch_up()
    assert failed
    assert bench.store.load()["parameters"]["exposure"] == 55
    bench.command("restore_parameters")
    assert bench.device.parameters["exposure"] == 55


def changes_of(bench):
    reported = []
    bench.device.signals.parameters_changed.connect(
        lambda names: reported.append({name: bench.device.parameters[name] for name in names})
    )
    return reported


@pytest.mark.parametrize("restart", ["reset", "restore_parameters"])
def test_a_restart_reports_only_parameters_that_change(bench, restart):
    bench.device.parameters.set({"canopen_node": 45, "exposure": 55})
    bench.command("save_parameters")
    bench.device.parameters.set({"exposure": 77, "analog_gain": 2.0})
    reported = changes_of(bench)
    bench.command(restart)
    bench.step(1.0)
    assert reported == [{"exposure": 55, "analog_gain": 1.0}]
    assert bench.device.parameters["canopen_node"] == 45


@pytest.mark.parametrize("pair", [(1, 1), (251, 255)])  # the defaults are 2 and 250
def test_a_stored_pair_is_checked_as_a_whole(make_bench, pair):
    bench = make_bench().start()
    smallest, largest = pair
    bench.device.parameters.set({"min_star_pixels": smallest, "max_star_pixels": largest})
    bench.command("save_parameters")
    again = make_bench(store=bench.store).start()
    assert again.device.parameters["min_star_pixels"] == smallest
    assert again.device.parameters["max_star_pixels"] == largest
    assert not again.read("device_status")["parameters_changed"]


def test_an_invalid_stored_value_does_not_affect_the_others(bench):
    stored = {"exposure": 1e9, "max_star_pixels": 1, "min_star_pixels": 1, "colour": 3}
    assert bench.device.parameters.restore(stored) == ["exposure", "colour"]
    assert bench.device.parameters["max_star_pixels"] == 1
    contradicting = {"min_star_pixels": 9, "max_star_pixels": 8, "analog_gain": 2.0}
    assert bench.device.parameters.restore(contradicting) == ["max_star_pixels"]
    assert bench.device.parameters["min_star_pixels"] == 9
    assert bench.device.parameters["analog_gain"] == 2.0


def test_a_reset_clears_selections_and_counters(bench):
    fresh = bench.read("device_status")["mode_changes"], bench.read("parameter")
    bench.command("set_parameter", parameter=29, value=2.0)
    bench.command("set_mode", mode="lost_in_space")
    bench.step(1.0)
    bench.command("reset")
    bench.step(1.0)
    assert bench.mode == "standby"
    assert (bench.read("device_status")["mode_changes"], bench.read("parameter")) == fresh


def test_forgotten_parameters_are_defaults_after_the_next_restart(make_bench, tmp_path):
    bench = make_bench(store=FileStore(tmp_path)).start()
    bench.command("set_parameter", parameter=1, value=55.0)
    bench.command("save_parameters")
    reported = []
    bench.device.forget_parameters().when_done(reported.append)
    assert reported == [None]
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


def test_stored_values_that_are_no_longer_allowed_are_ignored(make_bench, tmp_path):
    store = FileStore(tmp_path)
    store.save(
        {"boot_count": "x", "parameters": {"exposure": 1e9, "colour": 3, "analog_gain": 2.0, "k1": None}}
    )
    bench = make_bench(store=store).start()
    assert bench.device.parameters["exposure"] == 100
    assert bench.device.parameters["analog_gain"] == 2.0
    assert bench.read("boot_status")["boot_count"] == 1
    store.close()


def test_a_store_that_cannot_write_refuses_and_is_logged(make_bench, tmp_path, monkeypatch, caplog):
    bench = make_bench(store=FileStore(tmp_path)).start()

    def fail(_content):
        raise EmulatorError("state file: cannot be written")

    monkeypatch.setattr(bench.store, "save", fail)
    bench.command("set_parameter", parameter=1, value=55.0)
    assert bench.command("save_parameters") is ErrorCode.INTERNAL
    assert bench.read("acknowledge")["error"] == "internal"
    assert bench.read("device_status")["parameters_changed"]
    assert [each.getMessage() for each in caplog.records] == [
        "state file: cannot be written; the run continues and will exit with status 1"
    ]
    bench.store.close()


@pytest.mark.parametrize("fails", [False, True])
def test_a_save_is_answered_when_writing_has_succeeded_or_failed(make_bench, monkeypatch, fails):
    bench = make_bench().start()
    bench.device._background = disk = LaterBackground()

    def fail(_content):
        raise EmulatorError("state file: cannot be written")

    if fails:
        monkeypatch.setattr(bench.store, "save", fail)
    assert bench.send("save_parameters") == []
    assert bench.read("acknowledge")["processed"] is False
    assert bench.later == []
    disk.catch_up()
    (reply,) = bench.later
    assert (reply.kind, reply.code) == (
        (ReplyKind.NACK, ErrorCode.INTERNAL) if fails else (ReplyKind.ACK, ErrorCode.OK)
    )
    assert reply.id == bench.icd.telecommands["save_parameters"].id
    assert bench.read("acknowledge")["processed"]


def test_a_telecommand_before_the_last_one_is_done_is_an_overrun(make_bench):
    bench = make_bench().start()
    later = []
    bench.device._background = lambda work, done: later.append((work, done))
    bench.send("save_parameters")
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


def test_saves_during_a_write_share_the_next_one(bench):
    device, waiting, answers = bench.device, [], []
    device._background = lambda work, done: waiting.append((work, done))
    for number, exposure in enumerate(range(100, 200)):
        device.parameters.set({"exposure": exposure})
        device.save_parameters().when_done(lambda error, number=number: answers.append((number, error)))
    assert (len(waiting), answers) == (1, [])
    work, done = waiting.pop()
    work()
    done(None)
    assert (len(waiting), answers) == (1, [(0, None)])
    assert device.store.load()["parameters"]["exposure"] == 100
    work, done = waiting.pop()
    work()
    done(None)
    assert waiting == []
    assert answers == [(number, None) for number in range(100)]
    assert device.store.load()["parameters"]["exposure"] == 199


def test_a_shared_write_that_fails_is_reported_to_all_who_wait_for_it(bench):
    device, waiting, answers = bench.device, [], []
    device._background = lambda _work, done: waiting.append(done)
    for _ in range(3):
        device.save_parameters().when_done(answers.append)
    error = EmulatorError("full")
    waiting.pop()(None)
    waiting.pop()(error)
    assert answers == [None, error, error]
