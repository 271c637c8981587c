"""Reports of the commands: refused before the run, and written even if the emulator fails."""

from __future__ import annotations

import json
import os
import pty
import subprocess
import sys
from xml.etree import ElementTree as ET

import pytest
from typer.testing import CliRunner

from starhil.emulator.cli.app import build_app
from starhil.hil_tests.conformance import conformance_run
from starhil.hil_tests.errors import BenchError
from starhil.hil_tests.reports import write_report
from starhil.hil_tests.rig.emulator_process import EmulatorProcess
from starhil.hil_tests.rig.private_can_bus import hub_thread
from starhil.hil_tests.session import session_run
from tests.waiting import PATIENCE_S

DIES = "import sys; print('ready can={}', flush=True); print('no more sky', file=sys.stderr); sys.exit(7)"


def run_command(*words: object):
    return CliRunner().invoke(build_app(list(map(str, words))), list(map(str, words)))


@pytest.mark.parametrize(
    "words", [("conformance", "--junit"), ("conformance", "--html"), ("session", "first_light", "--junit")]
)
def test_a_report_that_cannot_be_written_is_rejected_before_the_run(words, tmp_path, monkeypatch):
    def never(*_arguments, **_options):
        raise AssertionError("the run began")

    monkeypatch.setattr(conformance_run, "_start_emulator", never)
    monkeypatch.setattr(session_run, "Rig", never)
    monkeypatch.chdir(tmp_path)
    outcome = run_command(*words, ".", "--start")
    assert isinstance(outcome.exception, BenchError), outcome.exception
    assert "is a folder" in str(outcome.exception)


def test_settings_are_those_of_the_emulator_that_conformance_starts(monkeypatch):
    arguments = {}

    def stop(**options):
        arguments.update(options)
        raise BenchError("enough")

    monkeypatch.setattr(conformance_run, "emulator_command", stop)
    words = (
        "conformance",
        "--serial",
        "auto",
        "--set",
        "truth.kind=rate",
        "--set",
        "parameters.update_rate=3",
    )
    assert str(run_command(*words, "--start").exception) == "enough"
    assert arguments["settings"] == ["truth.kind=rate", "parameters.update_rate=3"]
    assert "--set needs --start" in str(run_command(*words[:2], "/dev/ttyX", *words[3:]).exception)


@pytest.mark.process
def test_an_emulator_that_dies_at_the_last_step_fails_the_session_and_its_report(tmp_path, monkeypatch):
    script = tmp_path / "s.toml"
    script.write_text("[[step]]\nwait_s = 0\n", encoding="ascii")
    junit = tmp_path / "out" / "j.xml"
    with hub_thread() as channel:
        process = EmulatorProcess([sys.executable, "-c", DIES.format(channel)])
        monkeypatch.setattr(session_run, "_emulator", lambda *_arguments: process)
        run = session_run.run_steps

        def run_after_its_end(*arguments, **options):
            process.process.wait(timeout=PATIENCE_S)
            return run(*arguments, **options)

        monkeypatch.setattr(session_run, "run_steps", run_after_its_end)
        words = ("--start", "--can", channel, "--log", tmp_path, "--junit", junit, "--json")
        outcome = run_command("session", script, *words)
    assert outcome.exit_code == 1, outcome.output
    *_, end = json.loads(outcome.stdout)["results"]
    assert (end["step"], end["status"]) == (2, "failed")
    assert "unexpectedly with status 7: no more sky" in end["detail"]
    assert ET.parse(junit).getroot().get("failures") == "1"


@pytest.mark.long
def test_a_port_where_nothing_answers_ends_the_conformance_run_with_its_reports(tmp_path):
    junit, html = tmp_path / "c.xml", tmp_path / "c.html"
    master, slave = pty.openpty()
    try:
        port = os.ttyname(slave)
        words = ("--serial", port, "--junit", junit, "--html", html, "--time-out", "0.05")
        outcome = run_command("conformance", *words)
    finally:
        os.close(master)
        os.close(slave)
    assert outcome.exit_code == 1, outcome.output
    assert f"nothing answers on {port}" in outcome.output
    suite = ET.parse(junit).getroot()
    assert (suite.get("failures"), int(suite.get("skipped"))) == ("1", int(suite.get("tests")) - 1)
    page = html.read_text(encoding="utf-8")
    assert f"not run: nothing answers on {port}" in page
    left_out = page.count("not run: it changes the device; --intrusive runs it")
    assert left_out > 300
    notice = f"{left_out} of {int(suite.get('tests')) - 1} cases are left out, because they change the device"
    assert outcome.output.endswith(f"{notice}; --intrusive runs them\n")
    assert f"<tr><th>left out</th><td>{notice}" in page


@pytest.mark.parametrize(
    ("module", "words"), [(session_run, ("session", "first_light")), (conformance_run, ("conformance",))]
)
def test_an_emulator_started_for_a_run_uses_the_dialect_of_the_run(module, words, monkeypatch):
    def refuse(command):
        raise BenchError(" ".join(command))

    monkeypatch.setattr(module, "EmulatorProcess", refuse)
    outcome = run_command(*words, "--start", "--serial", "auto", "--dialect", "c")
    assert " --dialect c " in str(outcome.exception)


def test_a_report_into_a_device_leaves_the_device(tmp_path):
    null, full = tmp_path / "null", tmp_path / "full"
    null.symlink_to("/dev/null")
    full.symlink_to("/dev/full")
    write_report(null, b"<report/>")
    with pytest.raises(BenchError, match="No space left"):
        write_report(full, b"<report/>")
    assert null.is_char_device()
    assert full.is_char_device()
    assert sorted(tmp_path.iterdir()) == [full, null]


@pytest.mark.process
def test_a_report_into_the_standard_output_comes_between_the_lines_printed_there(tmp_path):
    file = tmp_path / "output"
    code = (
        "from pathlib import Path; from starhil.hil_tests.reports import write_report; "
        "print('before'); write_report(Path('/dev/stdout'), b'<report/>'); print('after')"
    )
    with file.open("wb") as stream:
        subprocess.run([sys.executable, "-c", code], stdout=stream, check=True, timeout=PATIENCE_S)
    assert file.read_text() == "before\n<report/>after\n"
    assert [each.name for each in tmp_path.iterdir()] == ["output"]


def test_a_report_over_a_link_replaces_the_file_that_it_leads_to(tmp_path):
    target, link = tmp_path / "file.xml", tmp_path / "link.xml"
    link.symlink_to(target)
    write_report(link, b"<report/>")
    assert link.is_symlink()
    assert target.read_bytes() == b"<report/>"
