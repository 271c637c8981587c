"""The conformance command against an emulator: pty, bus, CANopen; reports.

Choice of cases.
"""

from __future__ import annotations

import json
import re
import shutil
import warnings
from itertools import dropwhile
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest

from starhil.hil_tests.client import ObcClient
from starhil.hil_tests.rig.emulator_process import emulator_command
from starhil.protocol.files.bundled import find_unit
from tests.emulator.emulator_thread import EmulatorThread
from tests.process.conftest import NO_IMAGES, NO_IMAGES_OPTIONS
from tests.process.test_sessions import starhil
from tests.waiting import PATIENCE_S

pytestmark = pytest.mark.process


SPEED = 0.5
"""Simulation time per second: slow motion doubles the time-outs on a busy machine."""
SLOW_MOTION = ["--speed", str(SPEED)]
PROGRESS = re.compile(r": \d+ of \d+ after \d+ s$")
"""A line every half minute."""


def run_cases(words: tuple) -> tuple[list[dict], list[str]]:
    """Run cases; return their outcomes and the identifiers of those that failed."""
    done = starhil("conformance", *words, "--json")
    assert [line for line in done.stderr.splitlines() if not PROGRESS.search(line)] == []
    outcomes = json.loads(done.stdout)["outcomes"]
    failed = [item["id"] for item in outcomes if item["status"] == "failed"]
    assert done.returncode == bool(failed)
    return outcomes, failed


def conform(*words: str, reports: tuple = ()) -> list[dict]:
    """Run cases and return their outcomes; none may have failed.

    The rules on timing are those of real hardware, so a stall of a busy test machine breaks them,
    and longer time-outs would loosen them. Cases that failed are therefore run once more, alone,
    and named in a warning.
    """
    outcomes, failed = run_cases((*words, *reports))
    if failed:
        warnings.warn(f"run once more: {', '.join(failed)}", stacklevel=2)
        options = dropwhile(lambda word: not str(word).startswith("--"), words)
        again = {item["id"]: item for item in run_cases((*failed, *options))[0]}
        outcomes = [again[item["id"]] if item["id"] in failed else item for item in outcomes]
    assert [(o["id"], o["expected"], o["seen"], o["log"]) for o in outcomes if o["status"] == "failed"] == []
    return outcomes


AREAS = ("framing", "frames", "segments", "stuffing", "errors", "timing", "data", "counters", "reset")


@pytest.mark.usefixtures("emulators_in_threads")
def test_areas_pass_on_pty_bus_and_canopen_and_are_reported(tmp_path):
    areas = [f"serial.{area}" for area in AREAS if area not in ("frames", "segments")]
    areas += [f"can.{area}" for area in AREAS if area not in ("framing", "stuffing")]
    areas += ["canopen.nmt", "canopen.sdo", "canopen.rpdo", "canopen.design"]
    junit, html = tmp_path / "c.xml", tmp_path / "c.html"
    links = ["--serial", "auto", "--can", "auto", "--canopen", "44"]
    how = ("--start", *links, *SLOW_MOTION, *NO_IMAGES_OPTIONS)
    outcomes = conform(*areas, *how, reports=("--junit", junit, "--html", html))
    assert len(outcomes) >= 120
    assert int(ET.parse(junit).getroot().get("tests")) == len(outcomes)
    page = html.read_text()
    assert "can.data.escapes" in page
    assert page.count("<details>") > 100


def test_a_unit_that_the_run_did_not_start_is_not_changed(tmp_path):
    rows = ("device_status", "boot_status", "star_config")
    areas = ["serial.framing", "serial.telemetry", "serial.identifiers", "serial.timing", "serial.recovery"]
    command = emulator_command(
        seed=1, state_dir=tmp_path, settings=NO_IMAGES, extra=["--clock", f"scaled:{SPEED}"]
    )
    with EmulatorThread(command) as emulator:
        port = emulator.ready["serial"]
        with ObcClient.open(serial=port, timeout_s=PATIENCE_S) as obc:
            before = {name: obc.telemetry(name) for name in rows}
        outcomes = conform(*areas, "--serial", port, *SLOW_MOTION)
        with ObcClient.open(serial=port, timeout_s=PATIENCE_S) as obc:
            after = {name: obc.telemetry(name) for name in rows}
            last = obc.telemetry("acknowledge")["last_telecommand"]
    assert len([item for item in outcomes if item["status"] == "passed"]) > 60
    assert all(item["status"] == "not run" for item in outcomes if item["intrusive"])
    growing = ("uptime", "clock")
    for name in rows:
        assert {k: v for k, v in after[name].items() if k not in growing} == {
            k: v for k, v in before[name].items() if k not in growing
        }
    assert last == 0


@pytest.mark.parametrize("wrong", [False, True])
def test_the_attitude_of_a_running_unit_is_compared_with_its_truth_log_or_a_stated_attitude(wrong, tmp_path):
    """A unit that reports the conjugate fails only where the truth is given."""
    served = Path(shutil.copytree(find_unit("sagitta"), tmp_path / "sagitta"))
    if wrong:
        file = served / "10-link.toml"
        text = file.read_text()
        assert 'quaternion = "attitude"' in text
        file.write_text(text.replace('quaternion = "attitude"', 'quaternion = "rotation"'))
    log = tmp_path / "truth.csv"
    attitude = "truth.attitude={ra_deg=83.8, dec_deg=-1.2, roll_deg=30}"
    command = emulator_command(
        unit=str(served),
        seed=1,
        state_dir=tmp_path,
        truth_log=log,
        settings=["truth.kind=fixed", attitude, *NO_IMAGES],
    )
    with EmulatorThread(command) as emulator:
        words = ("serial.attitude", "--intrusive", "--unit", "sagitta", "--serial", emulator.ready["serial"])
        frames = [
            run_cases((*words, *truth))[1] for truth in ((), ("--truth", log), ("--truth", "83.8,-1.2,30"))
        ]
    failed = ["serial.attitude.solution"] if wrong else []
    assert frames == [[], failed, failed]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "no link: use"),
        (["--start", "--serial", "off", "--can", "off"], "no link: the emulator needs"),
        (["nothing.such", "--serial", "/dev/null"], "no conformance case matches 'nothing.such'"),
        (["--serial", "/dev/no-such-tty"], "/dev/no-such-tty"),
        (["--serial", "auto"], "--serial auto needs --start; otherwise name the port"),
        (["--canopen", "5"], "--canopen needs --can"),
        (["--start", "--truth", "1,2,3"], "--truth is for a unit that runs already"),
        (["--serial", "/dev/null", "--truth", "no.csv"], "no.csv: the truth cannot be read"),
        (
            ["--serial", "/dev/null", "--truth", "1,2"],
            "--truth 1,2: give three numbers in degrees, RA,DEC,ROLL",
        ),
        (["--serial", "/dev/null", "--truth", "0,91,0"], "--truth 0,91,0: give RA, Dec from -90 to 90"),
        (["--serial", "/dev/null", "--dialect", "x"], "must be a, b or c"),
    ],
)
def test_bad_input_ends_with_one_line_and_status_2(words, message):
    done = starhil("conformance", *words)
    assert done.returncode == 2
    assert message in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


def test_a_device_that_does_not_answer_fails(emulator):
    done = starhil(
        "conformance",
        "can.telemetry.rates",
        "--can",
        emulator.ready["can"],
        "--device-address",
        "77",
        "--time-out",
        "0.1",
    )
    assert done.returncode == 1
    assert f"nothing answers on {emulator.ready['can']} at address 77" in done.stdout.replace("\n", "")
