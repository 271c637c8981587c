"""The pytest plugin: fixtures of an emulator or of a unit, but never of the other one."""

from __future__ import annotations

import contextlib
import io
import re
import subprocess
import sys
from pathlib import Path
from unittest import mock

import pytest

from starhil.hil_tests.rig.emulator_process import emulator_command
from tests.emulator.emulator_thread import EmulatorThread
from tests.process.conftest import NO_IMAGES, NO_IMAGES_TABLES
from tests.waiting import PATIENCE_S

pytestmark = pytest.mark.process

ROOT = Path(__file__).resolve().parents[2]
(PAGE_TESTS,) = re.findall(r"```python\n(.*?)```", (ROOT / "docs/pytest.md").read_text(), re.DOTALL)
README_TEST, _ = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
COUNT = PAGE_TESTS.count("def test_")


WITHOUT = [f"-pno:{name}" for name in ("cacheprovider", "hypothesispytest", "xdist", "xdist.looponfail")]
"""Options that load no plugin of others, which takes half of a start."""


def prepared(folder: Path, programs: str | dict[str, str], base: str = "ideal") -> list[str]:
    """Write programs of tests and a profile into a folder; return the words with which pytest runs them there."""
    files = programs if isinstance(programs, dict) else {"test_it.py": programs}
    profile = f'extends = "{base}"\n{NO_IMAGES_TABLES}'
    for name, program in {**files, "quick.toml": profile}.items():
        (folder / name).write_text(program)
    return [*WITHOUT, "-rs", "-v", "--starhil-profile=quick.toml", *files]


def run_pytest(folder: Path, programs: str | dict[str, str], *options: str) -> str:
    """Run programs of tests in another pytest in this process, with emulators in threads; return its output."""
    words = [*prepared(folder, programs), "--capture=no", "--import-mode=importlib", *options]
    output = io.StringIO()
    with (
        contextlib.chdir(folder),
        contextlib.redirect_stdout(output),
        contextlib.redirect_stderr(output),
        mock.patch("starhil.hil_tests.rig.emulator_process.EmulatorProcess", EmulatorThread),
    ):
        pytest.main(words)
    for name in words:
        sys.modules.pop(name.removesuffix(".py"), None)  # the next run has another file of the name
    return output.getvalue()


def test_the_example_of_the_readme_passes_in_a_process_of_its_own(tmp_path):
    command = [sys.executable, "-m", "pytest", *prepared(tmp_path, README_TEST, base="cubestar")]
    done = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )
    assert "1 passed" in done.stdout, done.stdout + done.stderr


def test_what_a_unit_on_a_serial_line_lacks_is_skipped_by_name(tmp_path):
    command = emulator_command(profile="ideal", settings=NO_IMAGES, state_dir=tmp_path / "unit")
    with EmulatorThread(command) as unit:
        out = run_pytest(tmp_path, PAGE_TESTS, "--starhil-serial", unit.ready["serial"])
    assert "1 passed, 4 skipped" in out
    assert "test_an_attitude_is_found PASSED" in out
    assert "--starhil-serial names a unit; give its bus with --starhil-can" in out
    assert "--starhil-serial names a unit, and this test needs an emulator" in out


def test_a_link_that_is_off_has_no_tests(tmp_path):
    out = run_pytest(tmp_path, "def test_one(starhil_can): pass\n", "--starhil-can", "off")
    assert "SKIPPED" in out
    assert "--starhil-can off" in out


ISOLATED = """
import pytest

def test_one(starhil_serial, starhil_control, starhil_truth):
    starhil_serial.set_parameter("exposure", 150)
    starhil_serial.command("set_mode", mode="lost_in_space")
    starhil_control.do("fault", optical={"blocked_share": 1.0})
    starhil_control.do("fault", clock={"jump_s": -5.0, "drift_ppm": 50.0})
    starhil_control.do("fault", telemetry=[{"row": "precise_attitude", "jump_deg": 3.0}])
    starhil_truth.set(kind="fixed", attitude={"ra_deg": 10.0, "dec_deg": 20.0})
    assert starhil_control.do("truth")["ra_deg"] == pytest.approx(10.0)

def test_another(starhil_serial, starhil_control):
    assert starhil_serial.get_parameter("exposure") == 100
    assert starhil_serial.read("device_status")["mode"] == "standby"
    assert starhil_control.do("status")["faults"] == {}
    assert starhil_control.do("truth")["ra_deg"] == pytest.approx(83.8)
"""


def test_those_of_the_page_pass_with_an_emulator_and_each_test_begins_after_a_reset(tmp_path):
    out = run_pytest(tmp_path, {"test_page.py": PAGE_TESTS, "test_isolated.py": ISOLATED})
    assert f"{COUNT + 2} passed" in out


FAILS = """
import pytest

from starhil.hil_tests.errors import BenchError

def test_refused(starhil_serial):
    starhil_serial.set_parameter("exposure", 70000, checked=False)

def test_no_such_action(starhil_control):
    starhil_control.do("dance")

def test_no_such_row(starhil_serial):
    starhil_serial.read("identificaton")

def test_no_such_field(starhil_serial):
    assert starhil_serial.read("identification")["runtme_s"] == 0

def test_no_such_field_in_a_condition(starhil_serial):
    starhil_serial.wait_for("precise_attitude", lambda reading: reading["vald"], within_s=1)

def test_no_such_field_of_a_telecommand(starhil_serial):
    starhil_serial.command("set_mode", mod="standby")

@pytest.mark.starhil(profile="idel")
def test_no_such_profile(starhil_serial):
    pass

@pytest.mark.starhil(settings=["run.sede=1"])
def test_no_such_key(starhil_serial):
    pass
"""


def test_the_traceback_of_an_error_ends_at_the_test_and_a_fixture_has_none(tmp_path):
    out = run_pytest(tmp_path, FAILS, "--tb=short")
    assert "6 failed, 2 errors" in out
    frames = re.findall(r"^(\S+\.py):\d+: in", out, re.MULTILINE)
    assert frames == 6 * ["test_it.py"]
    assert "NackError: set_parameter: refused by the device" in out
    assert "BenchError: control channel: dance: " in out
    assert "no telemetry row named 'identificaton'; did you mean identification" in out
    assert "no field of identification named 'runtme_s'; did you mean runtime_s" in out
    assert "no field of precise_attitude named 'vald'; did you mean valid" in out
    assert "set_mode.mod: no such field; did you mean mode?" in out
    assert "\nprofile 'idel': not found; " in out
    assert "\n--set run.sede=1: run.sede: unknown key; did you mean seed?" in out
    assert "During handling" not in out


@pytest.mark.parametrize(
    ("option", "said"),
    [
        ("--starhil-unit=cubstar", "ERROR: --starhil-unit: unit 'cubstar': not found; "),
        ("--starhil-profile=idel", "ERROR: --starhil-profile: profile 'idel': not found; "),
        ("--starhil-dialect=z", "argument --starhil-dialect: invalid choice: 'z'"),
        (
            "--starhil-serial=",
            "argument --starhil-serial: must not be empty; omit the option for an emulator",
        ),
        ("--starhil-timeout=-1", "argument --starhil-timeout: must be 0.01 to 1e+06 s, not -1"),
        ("--starhil-timeout=nan", "argument --starhil-timeout: must be 0.01 to 1e+06 s, not nan"),
    ],
)
def test_a_wrong_option_ends_the_run_before_any_test(tmp_path, option, said):
    out = run_pytest(tmp_path, FAILS, option)
    assert said in out
    assert "Traceback" not in out
    assert "test_refused" not in out


MISTYPED = [
    'settings="camera.fov_deg=10"',
    "settings=[5]",
    "settings=None",
    "profile=5",
    'profile="\\0"',
    "sets=[]",
]


def test_a_marker_with_a_wrong_value_fails_in_one_line(tmp_path):
    """A text in place of a list was taken for settings of a letter each; others ended in a traceback."""
    tests = "".join(
        f"@pytest.mark.starhil({mark})\ndef test_{number}(starhil_serial): pass\n"
        for number, mark in enumerate(MISTYPED)
    )
    out = run_pytest(tmp_path, f"import pytest\n{tests}")
    assert f"{len(MISTYPED)} errors" in out
    said = 'the marker starhil takes profile="NAME" and settings=["section.key=value", …]'
    assert out.splitlines().count(said) == len(MISTYPED)
    assert "Traceback" not in out
