"""The shipped sessions, each with a new emulator in a thread; `tests/test_page_commands.py` starts processes for some."""

from __future__ import annotations

import json
import re
import shlex
import subprocess
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest

from tests.candump import read_candump
from tests.emulator.cli.command_line import log_lines, run_command_line
from tests.emulator.emulator_thread import EmulatorThread
from tests.process.conftest import NO_IMAGES_OPTIONS, NO_IMAGES_TABLES
from tests.protocol.export.dissection import dissect

pytestmark = pytest.mark.process


QUICK, QUICK_IDEAL = "quick.toml", "quick_ideal.toml"
"""Profiles without images, which these sessions do not look at."""


@pytest.fixture
def profiles(tmp_path, monkeypatch):
    """The profiles without images, in the working directory."""
    monkeypatch.chdir(tmp_path)
    for name, base in ((QUICK, "cubestar"), (QUICK_IDEAL, "ideal")):
        Path(name).write_text(f'extends = "{base}"\n{NO_IMAGES_TABLES}')


def starhil(*words: object) -> subprocess.CompletedProcess[str]:
    """Run `starhil` in this process."""
    status, out, errors = run_command_line(*map(str, words))
    return subprocess.CompletedProcess(words, status, out, "\n".join(log_lines(errors)))


@pytest.mark.parametrize(
    ("name", "links"),
    [
        ("first_light", ["--serial", "auto"]),
        ("slew_tracking", ["--can", "auto", "--profile", QUICK_IDEAL]),
        ("image_download", ["--serial", "auto"]),
        ("parameters", ["--serial", "auto", "--profile", QUICK]),
        ("errors", ["--serial", "auto", "--can", "auto", "--profile", QUICK]),
        ("errors", ["--serial", "auto", "--dialect", "a", "--profile", QUICK]),
    ],
    ids=lambda value: value if isinstance(value, str) else "-".join(word[2:] for word in value[::2]),
)
@pytest.mark.usefixtures("profiles", "emulators_in_threads")
def test_a_session_passes(name, links, tmp_path):
    junit = tmp_path / "junit.xml"
    done = starhil("session", name, "--start", *links, "--log", tmp_path, "--junit", junit, "--json")
    assert done.stderr == ""
    result = json.loads(done.stdout)
    failed = [(item["step"], item["detail"]) for item in result["results"] if item["status"] == "failed"]
    assert (done.returncode, failed) == (0, [])
    assert int(ET.parse(junit).getroot().get("tests")) == result["steps"]
    if "--serial" in links:
        assert " TX 1F 7F " in (tmp_path / "serial.log").read_text()
    if "--can" in links:
        assert sum(1 for _ in read_candump(tmp_path / "can.log")) > result["steps"]
        assert [frame for frame in dissect(tmp_path / "can.log") if frame.malformed] == []


@pytest.mark.usefixtures("profiles", "emulators_in_threads")
def test_the_procedure_for_lissa_s_star_tracker_passes(tmp_path):
    words = (
        *("--unit", "st16", "--start", "--profile", QUICK_IDEAL),
        *("--serial", "auto", "--log", tmp_path, "--json"),
    )
    done = starhil("session", "st16_lissa", *words)
    result = json.loads(done.stdout)
    failed = [(item["step"], item["detail"]) for item in result["results"] if item["status"] == "failed"]
    assert (done.stderr, done.returncode, failed) == ("", 0, [])
    assert " TX C0 0E 11 92 2F 1E 00 00 " in (tmp_path / "serial.log").read_text()


def test_a_session_whose_expectation_does_not_hold_ends_with_status_1(emulator, tmp_path):
    script = tmp_path / "wrong.toml"
    script.write_text("[[step]]\nread = 'identification'\nexpect = { interface_version = 99 }\n")
    done = starhil("session", script, "--serial", emulator.ready["serial"], "--log", tmp_path)
    assert done.returncode == 1
    assert "interface_version is 1, expected 99" in done.stdout
    assert done.stderr == ""


def test_a_session_of_which_no_step_runs_fails(emulator, tmp_path):
    script, junit = tmp_path / "other.toml", tmp_path / "junit.xml"
    script.write_text("[[step]]\nread = 'identification'\nlink = 'can'\n")
    words = ("--serial", emulator.ready["serial"], "--log", tmp_path, "--junit", junit)
    done = starhil("session", script, *words)
    assert done.returncode == 1
    assert "needs a can link" in done.stdout
    assert (ET.parse(junit).getroot().get("failures"), "every step is skipped" in done.stdout) == ("1", True)


FAULTS = """
[emulator]
profile = "ideal"
set = ["parameters.start_mode=lost_in_space", "run.worker=error_model", "camera.distortion=[]"]

[[step]]
read = "precise_attitude"
within_s = 30
expect = { valid = true }

[[step]]
name = "cover the lens"
control = "fault"
with = { optical = { blocked_share = 1.0 } }

[[step]]
read = "precise_attitude"
within_s = 20
expect = { valid = false }

[[step]]
control = "clear_faults"

[[step]]
read = "precise_attitude"
within_s = 20
expect = { valid = true }

[[step]]
name = "a wrong key"
control = "fault"
with = { optical = { blocked_shar = 1.0 } }
"""


@pytest.mark.usefixtures("emulators_in_threads")
def test_a_session_injects_faults_into_the_emulator_that_it_started(tmp_path):
    script = tmp_path / "faults.toml"
    script.write_text(FAULTS)
    done = starhil("session", script, "--start", "--serial", "auto", "--log", tmp_path, "--json")
    result = json.loads(done.stdout)
    assert [item["status"] for item in result["results"]] == 5 * ["passed"] + ["failed"]
    assert result["results"][1]["detail"] == "faults optical blocked_share 1"
    assert "blocked_shar: unknown key; did you mean blocked_share?" in result["results"][5]["detail"]


def test_a_script_whose_truth_nothing_confirms_is_rejected_with_the_command_that_does(tmp_path):
    def rejection(script, *words):
        done = starhil("session", script, *words, "--log", tmp_path / "log")
        assert done.returncode == 2
        assert not (tmp_path / "log").exists()
        return done.stderr

    written = rejection("slew_tracking", "--can", "socketcand:127.0.0.1:1/vcan0")
    assert (
        "slew_tracking.toml: compares attitudes with a truth that the emulator writes: use --start" in written
    )
    assert "starhil run ideal --set truth.kind=rate" in written
    assert f"--truth-log {tmp_path / 'log' / 'truth.csv'}" in written
    stated = rejection("first_light", "--serial", "/dev/no-such-port")
    assert "first_light.toml: compares attitudes with its [truth], and nothing shows that the unit" in stated
    assert "for an emulator that runs by: starhil run cubestar --set" in stated
    opened = starhil(
        "session",
        "first_light",
        "--serial",
        "/dev/no-such-port",
        "--assume-truth",
        "--log",
        tmp_path / "log",
    )
    assert "serial /dev/no-such-port: no such port" in opened.stderr


def test_the_commands_for_an_emulator_that_runs_work_as_the_page_has_them(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    page = (Path(__file__).parents[2] / "docs" / "sessions.md").read_text(encoding="utf-8")
    (pair,) = re.findall(r"^    (starhil run .*--control.*)\n    (starhil session .*)$", page, re.MULTILINE)
    run, session = (shlex.split(line.replace("/tmp/", f"{tmp_path}/"))[1:] for line in pair)
    with EmulatorThread(["starhil", *run, *NO_IMAGES_OPTIONS]):
        done = starhil(*session, "--log", tmp_path / "log")
        assert done.returncode == 0, done.stdout + done.stderr
        moved = starhil("session", "slew_tracking", *session[2:], "--log", tmp_path / "other")
        assert "its profile is cubestar, not ideal" in moved.stderr
        assert "starhil run ideal --set truth.kind=rate" in moved.stderr
        other = starhil("session", "recursive_features", *session[2:], "--log", tmp_path / "other")
        assert other.stderr.startswith(
            "starhil: recursive_features.toml: the emulator does not fit: its run.algorithm is geometric, not rsi; "
            "its run.clock is real, not scaled:4; its truth.kind is fixed, not rate; use --start, or start it by: starhil run cubestar"
        )


def test_the_profile_of_a_script_may_stand_beside_it(tmp_path, monkeypatch):
    (tmp_path / "mine.toml").write_text("[run]\nwrong = 1\n")
    script = tmp_path / "script.toml"
    script.write_text("[emulator]\nprofile = 'mine.toml'\n[[step]]\nwait_s = 0\n")
    monkeypatch.chdir("/")
    done = starhil("session", script, "--start", "--serial", "auto", "--log", tmp_path / "log")
    assert f"{tmp_path / 'mine.toml'}: run.wrong: unknown key" in done.stderr


@pytest.mark.usefixtures("emulators_in_threads")
@pytest.mark.parametrize(
    ("text", "words", "message"),
    [
        (
            "[[step]]\nread = 'quaternoin'\n",
            ["--start"],
            "wrong.toml: step 1: read: unit cubestar: no telemetry row named 'quaternoin'",
        ),
        (
            "[[step]]\nwait_s = 0\n[[step]]\ncontrol = 'clear_faults'\n",
            ["--serial", "/dev/no-such-port"],
            "wrong.toml: step 2: control: only an emulator can do this: use --start, or --control",
        ),
        (
            "[[step]]\nrestart = 'kill'\n",
            ["--serial", "/dev/no-such-port"],
            "wrong.toml: step 1: restart: only an emulator that the bench started",
        ),
        ("[[step]]\nwait_s = 0\n", ["--serial", "/dev/no-such-port"], "/dev/no-such-port"),
        ("[[step]]\nwait_s = 0\n", ["--can", "socketcand:127.0.0.1:1/vcan0"], "cannot connect"),
        ("[[step]]\nwait_s = 0\n", ["--start", "--profile", "no_such_profile"], "no_such_profile"),
        ("[emulator]\nset = ['camera.widht=5']\n[[step]]\nwait_s = 0\n", ["--start"], "widht"),
    ],
    ids=[
        "unknown telemetry",
        "control without emulator",
        "restart without emulator",
        "no port",
        "no hub",
        "no profile",
        "wrong key",
    ],
)
def test_bad_input_ends_with_one_line_and_status_2(text, words, message, tmp_path):
    script = tmp_path / "wrong.toml"
    script.write_text(text)
    status, _, stderr = run_command_line("session", str(script), *words, "--log", str(tmp_path / "log"))
    assert status == 2
    assert message in stderr
    assert len(stderr.strip().splitlines()) == 1
    assert stderr.startswith("starhil: ")
