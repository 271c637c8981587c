"""The conformance command against the emulator as a process: pty, bus, CANopen; reports; choice of cases."""

from __future__ import annotations

import json
from xml.etree import ElementTree as ET

import pytest

from tests.process.test_sessions import starhil

pytestmark = pytest.mark.process

AREAS = ("framing", "frames", "segments", "stuffing", "errors", "timing", "data", "counters", "reset")


def test_areas_pass_on_pty_bus_and_canopen_and_are_reported(tmp_path):
    chosen = [f"serial.{area}" for area in AREAS if area not in ("frames", "segments")]
    chosen += [f"can.{area}" for area in AREAS if area not in ("framing", "stuffing")]
    chosen += ["canopen.nmt", "canopen.sdo", "canopen.tpdo"]
    junit, html = tmp_path / "c.xml", tmp_path / "c.html"
    links = ["--serial", "auto", "--can", "auto", "--canopen", "44"]
    done = starhil("conformance", *chosen, "--start", *links, "--junit", junit, "--html", html, "--json")
    assert done.stderr == ""
    result = json.loads(done.stdout)
    failed = [
        (item["id"], item["expected"], item["seen"])
        for item in result["outcomes"]
        if item["status"] == "failed"
    ]
    assert (done.returncode, failed) == (0, [])
    assert result["cases"] >= 150
    assert int(ET.parse(junit).getroot().get("tests")) == result["cases"]
    page = html.read_text()
    assert "canopen.sdo" in page
    assert page.count("<details>") > 100


def test_safe_cases_change_nothing(emulator, serial_obc):
    rows = ("device_status", "boot_status", "star_config")
    before = {name: serial_obc.telemetry(name) for name in rows}
    serial_obc.close()
    chosen = ["serial.framing", "serial.telemetry", "serial.identifiers", "serial.timing", "serial.recovery"]
    port = emulator.ready["serial"]
    done = starhil("conformance", *chosen, "--serial", port, "--safe-only", "--json")
    result = json.loads(done.stdout)
    assert (done.returncode, result["failed"]) == (0, 0)
    assert not any(item["intrusive"] for item in result["outcomes"])
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
