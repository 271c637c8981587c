"""The conformance command against the emulator as a process: pty, bus, CANopen; reports; choice of cases."""

from __future__ import annotations

import json
from xml.etree import ElementTree as ET

import pytest

from tests.process.test_sessions import starhil

pytestmark = pytest.mark.process


def conform(*words: str, reports: tuple = ()) -> list[dict]:
    """Run cases and return their outcomes; what failed is run once more, alone.

    Time-outs are part of many cases, and a machine that is busy with other tests can stop a process for longer than
    they last. A real defect fails both times.
    """
    done = starhil("conformance", *words, *reports, "--json")
    assert done.stderr == ""
    outcomes = json.loads(done.stdout)["outcomes"]
    failed = [item["id"] for item in outcomes if item["status"] == "failed"]
    assert done.returncode == bool(failed)
    if failed:
        options = words[next(n for n, word in enumerate(words) if word.startswith("--")) :]
        again = starhil("conformance", *failed, *options, "--json")
        outcomes = [item for item in outcomes if item["id"] not in failed] + json.loads(again.stdout)[
            "outcomes"
        ]
    assert [(o["id"], o["expected"], o["seen"]) for o in outcomes if o["status"] == "failed"] == []
    return outcomes


AREAS = ("framing", "frames", "segments", "stuffing", "errors", "timing", "data", "counters", "reset")


def test_areas_pass_on_pty_bus_and_canopen_and_are_reported(tmp_path):
    chosen = [f"serial.{area}" for area in AREAS if area not in ("frames", "segments")]
    chosen += [f"can.{area}" for area in AREAS if area not in ("framing", "stuffing")]
    chosen += ["canopen.nmt", "canopen.sdo"]
    junit, html = tmp_path / "c.xml", tmp_path / "c.html"
    links = ["--serial", "auto", "--can", "auto", "--canopen", "44"]
    outcomes = conform(*chosen, "--start", *links, reports=("--junit", junit, "--html", html))
    assert len(outcomes) >= 120
    assert int(ET.parse(junit).getroot().get("tests")) == len(outcomes)
    page = html.read_text()
    assert "can.data.escapes" in page
    assert page.count("<details>") > 100


def test_safe_cases_change_nothing(emulator, serial_obc):
    rows = ("device_status", "boot_status", "star_config")
    before = {name: serial_obc.telemetry(name) for name in rows}
    serial_obc.close()
    chosen = ["serial.framing", "serial.telemetry", "serial.identifiers", "serial.timing", "serial.recovery"]
    port = emulator.ready["serial"]
    assert not any(item["intrusive"] for item in conform(*chosen, "--serial", port, "--safe-only"))
    from hil_tests.client import ObcClient

    with ObcClient.open(serial=port, timeout_s=5.0) as obc:
        after = {name: obc.telemetry(name) for name in rows}
        last = obc.telemetry("acknowledge")["last_telecommand"]
    growing = ("uptime", "clock")
    for name in rows:
        assert {k: v for k, v in after[name].items() if k not in growing} == {
            k: v for k, v in before[name].items() if k not in growing
        }
    assert last in (0, 103)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "no link given"),
        (["nothing.such", "--serial", "/dev/null"], "no conformance case matches 'nothing.such'"),
        (["--serial", "/dev/no-such-tty"], "/dev/no-such-tty"),
        (["--serial", "auto"], "needs --start"),
        (["--canopen", "5"], "--canopen needs --can"),
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
    assert "seen     nothing" in done.stdout
