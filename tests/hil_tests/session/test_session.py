"""The session runner with a canned device: passes, failures, and files."""

from __future__ import annotations

import csv
import io
import json
import re
import signal
import threading
from dataclasses import replace
from itertools import pairwise
from xml.etree import ElementTree as ET

import pytest
from rich.console import Console
from typer.testing import CliRunner

from starhil.emulator.cli.app import build_app
from starhil.emulator.profile import load_profile
from starhil.hil_tests.attitude import attitude_error, from_radec_roll, unit
from starhil.hil_tests.errors import BenchError, ScriptError
from starhil.hil_tests.rig.interruption import Interrupted
from starhil.hil_tests.rig.rig import LinkOptions, Rig
from starhil.hil_tests.session import SessionRequest, run_session
from starhil.hil_tests.session.results import junit_cases
from starhil.hil_tests.session.script import load_script
from starhil.hil_tests.session.session import run_steps
from starhil.hil_tests.session.session_run import (
    INTRUSIVE_ACTIONS,
    _emulator,
    _print_result,
    _running_step,
    find_script,
)
from starhil.hil_tests.session.step import BOOTING
from starhil.protocol.icd.device_model import device_model
from starhil.protocol.messages import ErrorCode
from starhil.protocol.serial.cubespace import Dialect
from starhil.protocol.unit import load_unit
from starid.errors import StaridError
from tests.candump import read_candump
from tests.hil_tests.fake_device import FakeDevice
from tests.waiting import PATIENCE_S

ICD = load_unit()


@pytest.fixture
def device():
    with FakeDevice() as fake:
        yield fake


@pytest.fixture
def play(device, tmp_path):
    """Run a script on the serial line of the device."""
    port = device.open_serial()

    def _play(text: str, can: str | None = None):
        path = tmp_path / "trial.toml"
        path.write_text("[defaults]\ntimeout_s = 5\nkeep_going = true\n" + text, encoding="utf-8")
        script = load_script(path, ICD)
        options = LinkOptions(serial=port, can=can, timeout_s=script.defaults.timeout_s)
        with Rig(options, ICD, log_folder=tmp_path) as rig:
            return run_steps(script, rig, tmp_path)

    return _play


def test_listen_checks_only_messages_after_its_start(device, hub, tmp_path):
    path = tmp_path / "trial.toml"
    path.write_text(
        "[[step]]\nlisten = 'precise_attitude'\ncount = 4\ntimeout_s = 20\nexpect = { frame_counter = { min = 100 } }\n",
        encoding="utf-8",
    )
    script = load_script(path, ICD)
    pause = threading.Event()
    with Rig(LinkOptions(can=device.open_can(hub), timeout_s=PATIENCE_S), ICD) as rig:
        for number in range(50):  # they pile up before the step
            device.say("precise_attitude", {"frame_counter": number})
        rig.client("can").read("rates")
        for number in range(50):
            device.say("precise_attitude", {"frame_counter": number})
        rig.client("can").read("rates")

        def send() -> None:
            for number in range(100, 200):
                if pause.wait(0.1):
                    return
                device.say("precise_attitude", {"frame_counter": number})

        sender = threading.Thread(target=send)
        sender.start()
        try:
            (result,) = run_steps(script, rig, tmp_path).results
        finally:
            pause.set()
            sender.join()
    assert result.status == "passed", result.detail
    assert 0.0 < result.figures["rate_hz"] < 10.5


def test_a_time_in_seconds_keeps_its_fraction_in_the_junit_file(play, device):
    device.telemetry["precise_attitude"] = attitude_values() | {"time_of_exposure": 1767225619.53125}
    result = play("[[step]]\nread = 'precise_attitude'\n")
    (case,) = junit_cases(result, "trial")
    assert "time_of_exposure = 1767225619.53125" in case.output.splitlines()


def test_a_message_uses_one_time_unit(play, device, capsys):
    result = play("[[step]]\nread = 'rates'\nmax_latency_s = 0.0\nwithin_s = 0.1\nevery_s = 0.01\n")
    assert result.results[0].detail.startswith("not within 0.1 s: latency 0.")
    _print_result(Console(highlight=False), result.results[0])
    line = capsys.readouterr().out
    assert " s" in line
    assert " ms" not in line


def test_the_running_step_is_shown_on_a_terminal_alone():
    for is_terminal in (True, False):
        console = Console(file=io.StringIO(), force_terminal=is_terminal, highlight=False, width=60)
        with _running_step(console) as begun:
            begun(4, "sample [green] attitude")
            console.print("a result above it")
        shown = re.sub(r"\x1b\[[0-9;]*m", "", console.file.getvalue())
        assert "a result above it" in shown
        assert ("…   4  sample [green] attitude 0:00:00" in shown) is is_terminal


def attitude_values(dec_offset_arcsec: float = 0.0, **more) -> dict:
    q = from_radec_roll(83.8, -1.2 + dec_offset_arcsec / 3600.0, 30.0)
    return (
        dict(zip(("q_x", "q_y", "q_z", "q_w"), q, strict=True))
        | {"valid": True, "time_of_exposure": 100.5}
        | more
    )


TRUTH = "[truth]\nra_deg = 83.8\ndec_deg = -1.2\nroll_deg = 30\n"


def test_passing_steps_pass_and_failing_steps_give_the_reason(play, device):
    device.telemetry["boot_status"] = {"boot_count": 7, "reset_cause": "command"}
    device.refuse["save_parameters"] = ErrorCode.BUSY
    result = play(
        """
        [[step]]
        read = "boot_status"
        expect = { boot_count = 7, reset_cause = "command" }
        [[step]]
        read = "boot_status"
        expect = { boot_count = 8 }
        [[step]]
        command = "save_parameters"
        [[step]]
        command = "save_parameters"
        refused = "busy"
        [[step]]
        command = "save_parameters"
        refused = "sequence"
        [[step]]
        command = "clear_counters"
        refused = "busy"
        [[step]]
        read = "boot_status"
        max_latency_s = 0.0
        """
    )
    details = [(item.status, item.detail) for item in result.results]
    assert details[0] == ("passed", "boot_count=7 reset_cause=command")
    assert details[1] == ("failed", "boot_count is 7, expected 8")
    assert details[2] == ("failed", "save_parameters: refused by the device with error 6 (busy)")
    assert details[3][0] == "passed"
    assert details[4] == ("failed", "refused with 6 (busy), expected sequence")
    assert details[5] == ("failed", "accepted, expected to be refused with busy")
    assert details[6][0] == "failed"
    assert "latency" in details[6][1]
    assert not result.passed


def test_after_a_failed_step_the_rest_is_skipped_without_keep_going(device, tmp_path):
    path = tmp_path / "s.toml"
    path.write_text("[[step]]\nread = 'rates'\nexpect = { rate_x = 9 }\n[[step]]\nread = 'rates'\n")
    with Rig(LinkOptions(serial=device.open_serial()), ICD) as rig:
        result = run_steps(load_script(path, ICD), rig, tmp_path)
    assert [item.status for item in result.results] == ["failed", "skipped"]


@pytest.mark.parametrize("moment", [0, 1])
def test_finished_steps_keep_their_result_when_a_signal_comes_as_one_is_shown(device, tmp_path, moment):
    path = tmp_path / "s.toml"
    path.write_text("[[step]]\nread = 'rates'\n" * 3)
    shown = []

    def show(result):
        shown.append(result)
        if len(shown) == moment + 1:
            raise Interrupted(signal.SIGTERM)

    with Rig(LinkOptions(serial=device.open_serial()), ICD) as rig:
        result = run_steps(load_script(path, ICD), rig, tmp_path, on_result=show)
    assert [item.status for item in result.results] == ["passed"] * (moment + 1) + ["skipped"] * (2 - moment)
    assert result.results[-1].detail == "not run: interrupted by SIGTERM"
    assert result.interruption is not None
    assert shown == list(result.results)


def test_a_signal_after_the_last_step_loses_no_result(device, tmp_path, monkeypatch):
    script, junit = tmp_path / "s.toml", tmp_path / "j.xml"
    script.write_text("[[step]]\nread = 'rates'\n")
    close = Rig.close_clients

    def interrupted_close(rig):
        close(rig)
        raise Interrupted(signal.SIGTERM)

    monkeypatch.setattr(Rig, "close_clients", interrupted_close)
    options = LinkOptions(serial=device.open_serial())
    result = run_session(SessionRequest(script, options=options, folder=tmp_path, junit=junit, quiet=True))
    assert [item.status for item in result.results] == ["passed"]
    assert not result.passed
    assert ET.parse(junit).getroot().get("skipped") == "0"


def test_captured_values_are_used_later(play, device):
    device.telemetry["device_status"] = {"frames_captured": 10}
    result = play(
        """
        [[step]]
        read = "device_status"
        capture = { before = "frames_captured" }
        [[step]]
        read = "device_status"
        expect = { frames_captured = { above = "$before" } }
        [[step]]
        command = "set_unix_time"
        with = { seconds = "$before" }
        """
    )
    assert [item.status for item in result.results] == ["passed", "failed", "passed"]
    assert device.received == [("set_unix_time", {"seconds": 10, "milliseconds": 0})]


def test_the_attitude_is_compared_with_the_truth(play, device):
    device.telemetry["precise_attitude"] = attitude_values(20.0)
    result = play(
        TRUTH
        + """
        [[step]]
        read = "precise_attitude"
        attitude = { within_arcsec = 21 }
        [[step]]
        read = "precise_attitude"
        attitude = { within_arcsec = 19 }
        [[step]]
        read = "precise_attitude"
        attitude = { within_arcsec = 1, ra_deg = 83.8, dec_deg = -1.1944444444, roll_deg = 30 }
        """
    )
    assert [item.status for item in result.results] == ["passed", "failed", "passed"]
    # single-precision quaternions carry an attitude to about 0.03 arcsec
    assert result.results[0].figures["cross_boresight_arcsec"] == pytest.approx(20.0, abs=0.1)


def test_the_attitude_is_compared_with_the_truth_of_its_time_in_a_file(play, device, tmp_path):
    rows = [(100.0, from_radec_roll(83.8, -1.3, 30.0)), (101.0, from_radec_roll(83.8, -1.1, 30.0))]
    lines = ["time_of_exposure_s,true_qx,true_qy,true_qz,true_qw"]
    lines += [",".join([str(t), *map(repr, q)]) for t, q in rows]
    (tmp_path / "truth.csv").write_text("\n".join(lines))
    device.telemetry["precise_attitude"] = attitude_values()
    text = (
        "[truth]\nfile = 'truth.csv'\n[[step]]\nread = 'precise_attitude'\nattitude = { within_arcsec = 1 }"
    )
    assert play(text).passed
    device.telemetry["precise_attitude"] = attitude_values(time_of_exposure=100.6)
    assert not play(text).passed


def test_a_truth_log_that_is_given_takes_the_place_of_the_truth_of_the_script(device, tmp_path):
    script, log = tmp_path / "s.toml", tmp_path / "truth.csv"
    script.write_text(TRUTH + "[[step]]\nread = 'precise_attitude'\nattitude = { within_arcsec = 1 }")
    device.telemetry["precise_attitude"] = attitude_values()
    rows = [f"{t}," + ",".join(map(repr, from_radec_roll(10.0, 20.0, 30.0))) for t in (100, 101)]
    log.write_text("\n".join(["time_of_exposure_s,true_qx,true_qy,true_qz,true_qw", *rows]))
    with Rig(LinkOptions(serial=device.open_serial()), ICD) as rig:
        for truth, status in ((None, "passed"), (log, "failed")):
            result = run_steps(load_script(script, ICD), rig, tmp_path, truth_path=truth)
            assert result.results[0].status == status


def test_a_truth_log_that_is_missing_is_rejected_before_the_emulator_starts(tmp_path):
    truth = tmp_path / "missing.csv"
    request = SessionRequest(
        find_script("first_light"), LinkOptions(), start=True, folder=tmp_path / "log", truth=truth
    )
    with pytest.raises(
        BenchError, match=r"missing\.csv: the truth cannot be read: No such file or directory"
    ):
        run_session(request)
    assert not (tmp_path / "log").exists()


@pytest.mark.parametrize("own", ["", "truth.kind=rate"])
def test_the_truth_of_a_script_points_the_emulator_that_is_started(own, tmp_path):
    path = tmp_path / "trial.toml"
    path.write_text(
        f"[emulator]\nset = ['{own or 'parameters.update_rate=2'}']\n"
        "[truth]\nra_deg = 201.3\ndec_deg = -11.2\nroll_deg = 5\n[[step]]\nread = 'rates'\n"
    )
    options = LinkOptions(serial="auto")
    emulator = _emulator(SessionRequest(path, options), load_script(path, ICD), options, tmp_path, tmp_path)
    settings = [setting for option, setting in pairwise(emulator.command) if option == "--set"]
    if own:  # settings of the script's own go before
        assert settings == [own]
        return
    attitude = load_profile("cubestar", settings).truth.attitude.build()
    assert (
        attitude_error(
            unit(attitude.quaternion_xyzw.tolist()), from_radec_roll(201.3, -11.2, 5.0)
        ).total_arcsec
        < 1e-3
    )


def test_the_orbit_of_the_command_line_comes_before_the_settings_of_the_script(tmp_path):
    path = tmp_path / "trial.toml"
    path.write_text("[emulator]\nset = ['orbit.raan_deg=10.0']\n[[step]]\nread = 'rates'\n")
    options = LinkOptions(serial="auto")
    request = SessionRequest(path, options, settings=("orbit=leo",))
    emulator = _emulator(request, load_script(path, ICD), options, tmp_path, tmp_path)
    given = [setting for option, setting in pairwise(emulator.command) if option == "--set"]
    orbit = load_profile("cubestar", given).orbit
    assert (orbit.kind, orbit.raan_deg) == ("kepler", 10.0)


def test_an_invalid_attitude_never_passes(play, device):
    device.telemetry["precise_attitude"] = attitude_values(valid=False, reason="no_match")
    result = play(TRUTH + "[[step]]\nread = 'precise_attitude'\nattitude = { within_arcsec = 1e9 }")
    assert "no_match" in result.results[0].detail
    assert not result.passed


def test_a_unit_that_boots_is_explained_where_an_expectation_fails(play, device):
    device.telemetry["device_status"] = {"mode": "boot"}
    result = play("[[step]]\nread = 'device_status'\nexpect = { mode = 'standby' }")
    assert result.results[0].detail == f"mode is boot, expected standby; {BOOTING}"


def test_a_step_is_retried_until_it_passes_or_times_out(play, device):
    device.mute = 2
    result = play(
        "[[step]]\nread = 'rates'\nwithin_s = 10\nevery_s = 0.01\ntimeout_s = 0.3\n"
        "[[step]]\nread = 'rates'\nexpect = { rate_x = 1 }\nwithin_s = 0.1\nevery_s = 0.01"
    )
    assert [item.status for item in result.results] == ["passed", "failed"]
    assert re.match(r"after \d+\.\d\d s: ", result.results[0].detail)
    assert result.results[1].detail.startswith("not within 0.1 s: rate_x is 0")
    assert re.search(r"\(\d+ attempts; the first was the same\)$", result.results[1].detail)


def test_a_telecommand_that_is_not_answered_is_sent(play):
    result = play("[[step]]\ncommand = 'reset'\n")
    assert result.results[0].detail == "sent; no reply is expected"


def test_repeats_must_all_hold(play, device):
    device.mute = 0
    result = play("[[step]]\nread = 'rates'\nrepeat = 4\nevery_s = 0.0")
    assert result.passed
    device.mute = 1
    result = play("[[step]]\nread = 'rates'\nrepeat = 4\nevery_s = 0.0\ntimeout_s = 0.2")
    assert "time 1 of 4" in result.results[0].detail


def test_parameters_are_set_and_read_back(play, device):
    result = play(
        """
        [[step]]
        set_parameter = "exposure"
        value = 250
        [[step]]
        get_parameter = "exposure"
        expect = { value = 250 }
        [[step]]
        set_parameter = "exposure"
        value = -1
        refused = "invalid_parameter"
        """
    )
    assert [item.status for item in result.results] == ["passed", "passed", "failed"]


def test_samples_go_to_a_csv_file_with_all_digits(play, device, tmp_path):
    device.telemetry["precise_attitude"] = attitude_values(5.0, mode="tracking")
    result = play(
        TRUTH
        + """
        [[step]]
        sample = { telemetry = "precise_attitude", every_s = 0.01, for_s = 0.1, file = "a.csv" }
        attitude = { within_arcsec = 6 }
        [[step]]
        sample = "precise_attitude"
        every_s = 0.01
        for_s = 0.05
        at_least = 0.5
        expect = { mode = "standby" }
        """
    )
    assert [item.status for item in result.results] == ["passed", "failed"]
    with (tmp_path / "a.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == result.results[0].figures["samples"] >= 1
    assert float(rows[0]["q_w"]) == pytest.approx(attitude_values(5.0)["q_w"], abs=1e-7)
    assert (rows[0]["valid"], rows[0]["mode"], float(rows[0]["time_of_exposure"])) == ("1", "tracking", 100.5)
    assert float(rows[0]["latency_ms"]) > 0.0
    assert [item.figures["good_share"] for item in result.results] == [1.0, 0.0]
    assert result.results[0].detail.startswith(
        f"{len(rows)} samples in a.csv, {len(rows)} good, latency_p50_ms="
    )
    assert result.results[0].figures["cross_boresight_max_arcsec"] == pytest.approx(5.0, abs=0.1)


def test_an_image_is_written_and_a_blank_one_fails(play, device, tmp_path):
    assert play("[[step]]\ndownload_image = 'a.png'\nsize = 'size_64'").passed
    assert (tmp_path / "a.png").read_bytes()[:4] == b"\x89PNG"
    device.pixels = bytes(64 * 64)
    result = play("[[step]]\ndownload_image = 'b.png'\nsize = 'size_64'")
    assert "blank" in result.results[0].detail


def test_bytes_are_sent_and_the_answer_compared(play, device):
    device.telemetry["boot_status"] = {"boot_count": 3}
    result = play(
        """
        [[step]]
        send = "1F 7F 81 1F FF"
        answer = "1F 7F .. 03 00 00 00 00 1F FF"
        listen_s = 0.1
        [[step]]
        send = "1F 7F 81 1F FF"
        answer = "1F 7F .. 04 00 00 00 00 1F FF"
        listen_s = 0.1
        [[step]]
        send = "00 01 02"
        answer = ""
        listen_s = 0.1
        """
    )
    assert [item.status for item in result.results] == ["passed", "failed", "passed"]


@pytest.mark.parametrize("dialect", Dialect)
def test_bytes_are_compared_with_the_answer_in_the_dialect_of_the_session(device, tmp_path, dialect):
    device.dialect = dialect
    errors = find_script("errors").read_text()
    (step,) = (text for text in errors.split("[[step]]") if "dialect" not in text and "{ a = " in text)
    path = tmp_path / "trial.toml"
    path.write_text(f"[[step]]\n{step}[[step]]\n{step.replace('01 1F FF', '02 1F FF')}")
    options = LinkOptions(serial=device.open_serial(), dialect=dialect, timeout_s=0.2)
    script = load_script(path, ICD)
    script.defaults.keep_going = True
    with Rig(options, ICD) as rig:
        result = run_steps(script, rig, tmp_path)
    assert [item.status for item in result.results] == ["passed", "failed"]


def test_a_step_that_fails_because_the_unit_replies_in_another_dialect_names_it(device, tmp_path):
    device.dialect = Dialect.A
    path = tmp_path / "trial.toml"
    path.write_text("[[step]]\nread = 'device_status'\nwithin_s = 0.1\nevery_s = 0.01\n")
    with Rig(LinkOptions(serial=device.open_serial()), ICD) as rig:
        (result,) = run_steps(load_script(path, ICD), rig, tmp_path).results
    assert "device_status: the unit replies in dialect a; choose it with --dialect, " in result.detail


def test_a_session_that_resets_or_erases_needs_consent_for_a_unit_that_may_be_real(device, tmp_path):
    path = tmp_path / "trial.toml"
    path.write_text(
        "[[step]]\nread = 'rates'\n[[step]]\ncommand = 'erase_file'\nwith = { all = true }\n"
        "[[step]]\ncommand = 'reset'\nwith = { magic = 90 }\n[[step]]\nread = 'rates'\n"
    )
    request = SessionRequest(path, LinkOptions(serial=device.open_serial()), folder=tmp_path, quiet=True)
    with pytest.raises(ScriptError, match=r"what it stores \(erase_file, reset\): .* --intrusive if it may;"):
        run_session(request)
    assert device.received == []
    assert run_session(replace(request, intrusive=True)).passed
    assert [row for row, _ in device.received] == ["erase_file", "reset"]


def test_actions_that_need_consent_are_those_of_the_device():
    assert set(device_model().actions) >= INTRUSIVE_ACTIONS


def test_links_are_chosen_by_step_and_a_missing_one_is_skipped(play, device, hub):
    channel = device.open_can(hub)
    text = "[[step]]\nread = 'rates'\nlink = 'can'\n[[step]]\nread = 'rates'\nlink = 'both'\n"
    result = play(text, can=channel)
    assert [(item.link, item.status) for item in result.results] == [
        ("can", "passed"), ("serial", "passed"), ("can", "passed"),
    ]  # fmt: skip
    result = play(text)
    assert [(item.link, item.status) for item in result.results] == [("can", "skipped"), ("serial", "passed")]


class Kept(dict):
    """Parameters that the device acknowledges but does not change."""

    def __setitem__(self, _identifier, _value):
        pass


VERDICTS = {
    "a telecommand as bytes": ("command = 'set_mode'\nwith_hex = '63'\nrefused = 'invalid_parameter'", "passed", "refused with 3 (invalid_parameter), as expected"),
    "telemetry that must be refused": ("read = 'rates'\nrefused = 'busy'", "passed", "refused with 6 (busy), as expected"),
    "telemetry that is not refused": ("read = 'quaternion'\nrefused = 'busy'", "failed", "accepted, expected to be refused with busy"),
    "a parameter that keeps its value": ("set_parameter = 'exposure'\nvalue = 250", "failed", "exposure reads back as 100, expected 250"),
    "too few samples": ("sample = 'quaternion'\nevery_s = 0\nfor_s = 0\nmin_samples = 9", "failed", "only 1 samples arrived in 0 s, expected at least 9"),
    "an answer that is only shown": ("send = '1F 7F 80 1F FF'", "passed", "came back: 1F"),
}  # fmt: skip


@pytest.mark.parametrize("name", VERDICTS)
def test_a_step_has_the_verdict_and_detail_of_what_the_device_did(play, device, name):
    step, status, detail = VERDICTS[name]
    device.refuse["rates"] = ErrorCode.BUSY
    device.parameters = Kept(device.parameters)
    (result,) = play(f"[[step]]\n{step}\n").results
    assert (result.status, detail in result.detail) == (status, True), result.detail


@pytest.mark.parametrize(("wanted", "status"), [(7, "passed"), (8, "failed")])
def test_one_unsolicited_message_is_judged_without_a_rate(device, hub, tmp_path, wanted, status):
    path = tmp_path / "trial.toml"
    path.write_text(
        f"[[step]]\nlisten = 'precise_attitude'\nexpect = {{ frame_counter = {wanted} }}\n", encoding="utf-8"
    )
    script = load_script(path, ICD)
    with Rig(LinkOptions(can=device.open_can(hub), timeout_s=PATIENCE_S), ICD) as rig:
        rig.client("can").read("rates")
        timer = threading.Timer(0.2, device.say, ["precise_attitude", {"frame_counter": 7}])
        timer.start()
        (result,) = run_steps(script, rig, tmp_path).results
        timer.join()
    assert (result.status, "rate_hz" in result.figures) == (status, False), result.detail


LISTENING = "[[step]]\nlisten = 'precise_attitude'\n"
IN_A_PAUSE = LISTENING + "within_s = 5\ntimeout_s = 0.3\nevery_s = 0.6\nexpect = { frame_counter = 7 }\n"


@pytest.mark.parametrize(
    ("script", "numbers"),
    [
        (IN_A_PAUSE, [7]),
        (IN_A_PAUSE, range(8)),
        (LISTENING + "within_s = 0\nrepeat = 3\nexpect = { frame_counter = { min = 1 } }\n", range(1, 4)),
    ],
    ids=["one message after the first attempt", "many messages at once", "repetitions"],
)
def test_listen_takes_each_message_from_the_begin_of_the_step(device, hub, tmp_path, script, numbers):
    path = tmp_path / "trial.toml"
    path.write_text(script, encoding="utf-8")

    def say() -> None:
        for number in numbers:
            device.say("precise_attitude", {"frame_counter": number})

    with Rig(LinkOptions(can=device.open_can(hub)), ICD) as rig:
        rig.client("can").read("rates")
        timer = threading.Timer(0.5, say)
        timer.start()
        (result,) = run_steps(load_script(path, ICD), rig, tmp_path).results
        timer.join()
    assert result.status == "passed", result.detail
    assert result.seconds < 2.0


def test_frames_are_sent_and_each_frame_of_the_answer_compared(play, device, hub):
    channel = device.open_can(hub)
    request = f"send = '{4 << 24 | 188 << 16 | 1 << 8 | 4:08X}#'\nlink = 'can'\n"
    answer = f"{5 << 24 | 188 << 16 | 4 << 8 | 1:08X}#............"
    passed, failed = play(
        f"[[step]]\n{request}answer = '{answer}'\n[[step]]\n{request}answer = ['{answer}', '{answer}']\ntimeout_s = 0.2\n",
        channel,
    ).results
    assert (passed.status, failed.status) == ("passed", "failed"), (passed.detail, failed.detail)


def test_a_row_without_a_time_has_no_truth_in_a_file(play, tmp_path):
    (tmp_path / "t.csv").write_text("")
    (result,) = play(
        "[truth]\nfile = 't.csv'\n[[step]]\nread = 'quaternion'\nattitude = { within_arcsec = 3 }\n"
    ).results
    assert result.status == "failed"
    assert "quaternion has no time; read precise_attitude" in result.detail


def test_only_an_emulator_that_the_session_started_can_be_restarted(play):
    result = play("[[step]]\nrestart = 'kill'")
    assert "use --start" in result.results[0].detail


def test_a_link_that_the_bench_lacks_is_rejected(device):
    with (
        Rig(LinkOptions(serial=device.open_serial()), ICD) as rig,
        pytest.raises(BenchError, match="no can link"),
    ):
        rig.client("can")


# --- the command ---


def run_command(*words: str):
    return CliRunner().invoke(build_app(["session"]), ["session", *map(str, words)])


def test_the_command_prints_steps_and_writes_logs_and_junit(device, tmp_path, hub):
    script = tmp_path / "s.toml"
    script.write_text("title = 'Trial'\n[[step]]\nread = 'rates'\nlink = 'both'\n")
    out = tmp_path / "out"
    words = [
        "--serial",
        device.open_serial(),
        "--can",
        device.open_can(hub),
        "--log",
        out,
        "--junit",
        tmp_path / "j.xml",
    ]
    outcome = run_command(script, *words)
    assert outcome.exit_code == 0, outcome.output
    assert "Trial" in outcome.output
    assert "2 passed, 0 failed" in outcome.output
    lines = (out / "serial.log").read_text().splitlines()
    assert any(line.endswith("TX 1F 7F E5 1F FF") for line in lines)
    assert any("step 1: read rates" in line for line in lines)
    assert [frame.id for _, frame in read_candump(out / "can.log")] == [0x04E50104, 0x05E50401]
    assert ET.parse(tmp_path / "j.xml").getroot().get("tests") == "2"


def test_the_command_prints_json_alone_and_exits_1_when_a_step_fails(device, tmp_path):
    script = tmp_path / "s.toml"
    script.write_text("[[step]]\nread = 'rates'\nexpect = { rate_x = 5 }\n")
    outcome = run_command(script, "--serial", device.open_serial(), "--log", tmp_path, "--json")
    assert outcome.exit_code == 1
    data = json.loads(outcome.stdout)
    assert (data["passed"], data["failed"], data["results"][0]["values"]["rate_x"]) == (False, 1, 0.0)


def test_the_command_prints_a_line_for_each_error_of_a_script(tmp_path):
    script = tmp_path / "s.toml"
    script.write_text(
        "[[step]]\nread = 'ratse'\n[[step]]\nraed = 'rates'\n[[step]]\nread = 'rates'\nxpect = 1\n"
    )
    outcome = run_command(script, "--start")
    assert isinstance(outcome.exception, BenchError)
    lines = outcome.exception.args
    assert [line.split(": ")[:2] for line in lines] == [["s.toml", f"step {n}"] for n in (1, 2, 3)]


def test_listening_where_no_row_comes_without_a_request_is_rejected_before_the_first_step(tmp_path):
    script = tmp_path / "s.toml"
    script.write_text("[[step]]\nwait_s = 0\n[[step]]\nlisten = 'scet'\n")
    outcome = run_command(script, "--unit", "oresat", "--can", "virtual:none", "--log", tmp_path / "log")
    assert str(outcome.exception).startswith("s.toml: step 2: listen: unit oresat has only CANopen on CAN")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["nothing"], "session 'nothing': not found"),
        (["first_light"], "no link: use"),
        (
            ["first_light", "--start", "--serial", "off"],
            "no link: the emulator needs --serial auto or --can auto",
        ),
        (["first_light", "--serial", "auto"], "--serial auto needs --start; otherwise name the port"),
        (["first_light", "--serial", "/dev/ttyS77", "--dialect", "d"], "must be a, b or c"),
    ],
)
def test_bad_input_is_rejected(words, message, tmp_path):
    outcome = run_command(*words, "--log", tmp_path / "log")
    assert isinstance(outcome.exception, BenchError | StaridError)
    assert message in str(outcome.exception)
    assert not (tmp_path / "log").exists()
