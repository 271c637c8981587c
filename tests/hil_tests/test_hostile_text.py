"""Control characters in titles, names and details: escaped on a terminal, replaced in JUnit files."""

from __future__ import annotations

import io
from xml.etree import ElementTree as ET

import pytest
from rich.console import Console

from starhil.hil_tests.conformance.report import print_outcome, write_junit_report
from starhil.hil_tests.conformance.runner import Outcome
from starhil.hil_tests.reports import FAILED, TestCase, write_junit
from starid.cli.command_line import exit_for_bad_input
from tests.emulator.cli.command_line import run_command_line
from tests.process.conftest import NO_IMAGES

HOSTILE = "a\x1b]0;b\x07\x00\x9b2J\u202ec\ufffe\ud800"
SHOWN = "a\\x1b]0;b\\x07\\x00\\x9b2J\\u202ec\\ufffe\\ud800"
IN_XML = "a\ufffd]0;b\ufffd\ufffd\x9b2J\u202ec\ufffd\ufffd"


def hostile_outcome() -> Outcome:
    return Outcome(
        id="a.b",
        area="a",
        title=HOSTILE,
        clause=HOSTILE,
        intrusive=False,
        status=FAILED,
        expected=HOSTILE,
        seen=HOSTILE,
        seconds=0.0,
        log=(HOSTILE,),
    )


def test_every_text_of_a_junit_file_is_well_formed(tmp_path):
    file = tmp_path / "j.xml"
    write_junit(file, HOSTILE, [TestCase(HOSTILE, HOSTILE, FAILED, HOSTILE, 0.0, HOSTILE)], 0.0)
    root = ET.parse(file).getroot()
    case = root.find("testsuite/testcase")
    assert root.get("name") == root.find("testsuite").get("name") == IN_XML
    assert case.get("classname") == case.get("name") == IN_XML
    assert case.find("failure").get("message") == case.find("failure").text == IN_XML
    assert case.find("system-out").text == IN_XML
    write_junit_report(file, [hostile_outcome()])
    assert IN_XML in ET.parse(file).getroot().find("testsuite/testcase").get("name")


def test_a_case_of_conformance_is_shown_with_its_control_characters_escaped():
    out = io.StringIO()
    print_outcome(Console(file=out, highlight=False), hostile_outcome(), verbose=True)
    assert out.getvalue() == (f"✗ a.b  {SHOWN} [{SHOWN}]\n    expected {SHOWN}\n    seen     {SHOWN}\n")


@pytest.mark.process
def test_title_and_steps_of_a_session_are_shown_with_their_control_characters_escaped(tmp_path):
    script = tmp_path / "s.toml"
    text = r'"a\u001b]0;b\u0007\u009b2J\u202ec\nd"'
    script.write_text(
        f"title = {text}\n[emulator]\nset = {[*NO_IMAGES]}\n[[step]]\nname = {text}\nwait_s = 0\n",
        encoding="ascii",
    )
    status, out, err = run_command_line("session", str(script), "--start", "--log", str(tmp_path))
    assert status in (0, 1), err
    assert not set(out) & set("\x1b\x07\x9b\u202e")
    shown = r"a\x1b]0;b\x07\x9b2J\u202ec\nd"
    assert out.splitlines()[0] == shown
    assert shown in out.splitlines()[1]


def test_an_error_is_shown_with_its_control_characters_escaped(capsys):
    with pytest.raises(SystemExit):
        exit_for_bad_input("starhil", HOSTILE[:-1])
    assert capsys.readouterr().err == f"starhil: {SHOWN.removesuffix(chr(92) + 'ud800')}\n"
