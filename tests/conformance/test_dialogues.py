"""Files `*_cases.toml` of a unit add cases in one language for all links; an error in one is located."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from starhil.hil_tests.conformance.canopen_dialogue import CanopenDialogue, dialogue_cases
from starhil.hil_tests.conformance.canopen_suite import CANOPEN_CASES, canopen_suite
from starhil.hil_tests.conformance.case_file import text_cases
from starhil.hil_tests.conformance.dialogue import LinkDialogue
from starhil.hil_tests.conformance.runner import run_case, run_cases
from starhil.hil_tests.errors import BenchError
from starhil.hil_tests.judge.definition import read_unit
from starhil.protocol.files.bundled import find_unit
from tests.conformance.simulated import SimulatedUnit

pytestmark = pytest.mark.long

DOCS = (Path(__file__).parents[2] / "docs" / "units.md").read_text(encoding="utf-8")
EXAMPLE = next(block.split("```")[0] for block in DOCS.split("```toml\n") if block.startswith("[[area]]"))
AREA = '[[area]]\nname = "modes"\nlinks = ["canopen"]\nclause = "ICD 4.2"\n'
OWN = (
    AREA
    + """
[[area.cases]]
id = "wrong"
title = "a value that was not written"
lines = '''
set 1017:0 555 u16
holds 1017:0 1 u16
set 1017:0 111 u16
finally
set 1017:0 777 u16
holds 1017:0 2 u16
'''

[[area]]
name = "nmt"
links = ["canopen"]
clause = "ICD 4.3"

[[area.cases]]
id = "boot-up"
title = "this unit boots in a way of its own"
clause = "ICD 4.4"
lines = "40 00 10 00 > 43 *"
"""
)
PYTHON = """
from starhil.hil_tests.conformance.case import CaseArea

DEVICE = CaseArea("device", "ICD 4.6", links=("canopen",))
OTHER = CaseArea("other", "ICD 4.7")


@DEVICE.case("type", "1000h has 4 bytes")
def device_type(probe):
    assert len(probe.read(0x1000)) == 4


@OTHER.case("none", "not on CANopen")
def none(probe):
    raise AssertionError


def generated(unit):
    raise AssertionError
"""


def case_file(folder: Path, dialogue: str) -> Path:
    path = folder / "modes_cases.toml"
    path.write_text(
        f"{AREA}[[area.cases]]\nid = 'one'\ntitle = 'One'\nlines = '''\nneed 1017\n{dialogue}\n'''\n"
    )
    return path


def test_dialogues_of_a_unit_are_run_with_the_other_cases(tmp_path: Path) -> None:
    folder = Path(shutil.copytree(find_unit("oresat"), tmp_path / "unit"))
    (folder / "modes_cases.toml").write_text(OWN, encoding="utf-8")
    (folder / "filter_cases.toml").write_text(EXAMPLE, encoding="utf-8")
    (folder / "device_cases.py").write_text(PYTHON, encoding="utf-8")
    cases = {case.id: case for case in canopen_suite(read_unit(folder))}
    plain = {case.id for case in canopen_suite(read_unit("oresat"))}
    assert cases.keys() - plain == {"canopen.filter.kept", "canopen.device.type", "canopen.modes.wrong"}
    own = [cases[f"canopen.{name}"] for name in ("filter.kept", "device.type", "nmt.boot-up", "modes.wrong")]
    assert [(case.clause, case.intrusive) for case in own] == [
        ("ICD 4.5", True),
        ("ICD 4.6", False),
        ("ICD 4.4", False),
        ("ICD 4.2", False),
    ]
    with SimulatedUnit("canopen", unit=folder) as simulated:
        outcomes = run_cases(simulated.probe, own)
    assert [item.status for item in outcomes] == ["passed", "passed", "passed", "failed"], outcomes


def test_the_lines_after_finally_are_held_after_a_failure_which_is_reported(tmp_path: Path) -> None:
    path = tmp_path / "modes_cases.toml"
    path.write_text(OWN, encoding="utf-8")
    case = next(case for case in dialogue_cases(path) if case.id == "modes.wrong")
    with SimulatedUnit("canopen") as simulated:
        outcome = run_case(simulated.probe, case)
        assert simulated.probe.number(0x1017) == 777
    assert outcome.expected == "1017h:00h 1 (step 2: holds 1017:0 1 u16, after set 1017:0 555 u16)"
    assert outcome.seen == "555"


@pytest.mark.parametrize("link", ["serial", "can", "canopen"])
@pytest.mark.parametrize(
    ("lines", "expected"),
    [
        ("command clear_counters; telemetry identification node_type=0x53 interface_version=1", ""),
        ("telemetry identification node_type=84", "identification {'node_type': 84}"),
        ("telemetry nothing a=1", "telemetry 'nothing' in the definition"),
        ("command nothing", "a telecommand 'nothing' in the definition"),
    ],
)
def test_rows_by_name_are_steps_on_each_link(lines: str, expected: str, link: str, tmp_path: Path) -> None:
    path = case_file(tmp_path, lines)
    path.write_text(path.read_text().replace('"canopen"', f'"{link}"').replace("need 1017", "drain"))
    dialogue = CanopenDialogue if link == "canopen" else LinkDialogue
    (case,) = text_cases(path, link, {}, dialogue)
    with SimulatedUnit(link) as simulated:
        outcome = run_case(simulated.probe, case)
    assert outcome.status == ("failed" if expected else "passed"), outcome
    assert outcome.expected.startswith(expected)


def test_steps_after_finally_follow_a_failure_on_a_serial_line_too(tmp_path: Path) -> None:
    path = case_file(tmp_path, "1F 7F 80 1F FF > 129; finally; 1F 7F 81 1F FF > 129  # the row asked for")
    path.write_text(path.read_text().replace('"canopen"', '"serial"').replace("need 1017", "drain"))
    (case,) = text_cases(path, "serial", {})
    with SimulatedUnit("serial") as simulated:
        outcome = run_case(simulated.probe, case)
    assert outcome.expected.endswith("(step 2: 1F 7F 80 1F FF > 129, after drain)")
    assert [line.split("-> ")[1] for line in outcome.log if "->" in line] == [
        "1F 7F 80 1F FF",
        "1F 7F 81 1F FF",
    ]


@pytest.mark.parametrize(
    ("line", "fault"),
    [
        ("sett 1017:0 5 u16", "'sett' is neither bytes, a CAN frame nor a verb; did you mean set"),
        ("40 {text} > sometimes", "not bytes in hexadecimal or a CAN frame: 'sometimes'"),
        ("40 {text}", "an answer or the code of an abort is missing"),
        ("40 {text} > abort", "an answer or the code of an abort is missing"),
        ("{request}#0", "'{request}#0' is neither bytes, a CAN frame nor a verb"),
        ("> {tpdo_id}#0", "not bytes in hexadecimal or a CAN frame: '000#0'"),
        ("40 {text} > abort TOGLE", "40 {text} > abort TOGLE: 'TOGLE'"),
        ("set 1017:0", "missing a required argument: 'values'"),
        ("set 1017:0 70000 u16", "int too big to convert"),
        ("set 1017 5 u16", "not enough values to unpack"),
        ("set 1017:0 5 f32", "unknown kind 'f32'"),
        ("if 10 set 1017:0 5 u16", "'10' is not INDEX or INDEX:SUBINDEX"),
        ("nmt start", "invalid literal for int"),
        ("sleep 0.1 0.2", "too many positional arguments"),
        ("drain > VALUES", "nothing may follow >"),
        ("map {tpdo} 1 evnt=5", "unknown setting 'evnt'"),
        ("wait", "missing a required"),
        ("sleep -1", "'-1' is not a time in seconds"),
    ],
)
def test_an_error_in_a_line_names_file_case_and_line(line: str, fault: str, tmp_path: Path) -> None:
    with pytest.raises(BenchError) as caught:
        dialogue_cases(case_file(tmp_path, line))
    assert str(caught.value).startswith(f"{tmp_path}/modes_cases.toml: modes.one: line 2: ")
    assert fault in str(caught.value)


def test_an_unknown_name_in_braces_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(BenchError, match=r"modes\.one: unknown name 'txt' in braces; did you mean text"):
        dialogue_cases(case_file(tmp_path, "40 {txt} > *"))
    with pytest.raises(BenchError, match="unknown name 'row_id' in braces"):
        dialogue_cases(case_file(tmp_path, "40 {row_id} > *"))


@pytest.mark.parametrize(
    ("old", "new", "fault"),
    [
        ("clause =", "claus =", "area.modes.claus: unknown key; did you mean clause"),
        (
            '["canopen"]',
            '["can_open"]',
            "area.modes.links.0: must be one of 'serial', 'can', 'canopen' (given: 'can_open')",
        ),
        ("title = 'One'", "", "area.modes.cases.one.title: missing"),
        ("[[area]]", "[[area]", "Expected ']]'"),
    ],
)
def test_an_error_in_a_file_is_located(old: str, new: str, fault: str, tmp_path: Path) -> None:
    path = case_file(tmp_path, "drain")
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(BenchError) as caught:
        dialogue_cases(path)
    assert str(path) in str(caught.value)
    assert fault in str(caught.value)


def test_a_file_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    with pytest.raises(BenchError, match=r"none_cases\.toml: cannot be read: No such file"):
        dialogue_cases(tmp_path / "none_cases.toml")


def test_cases_for_any_unit_are_in_order_of_their_areas() -> None:
    areas = list(dict.fromkeys(case.area.removeprefix("canopen.") for case in CANOPEN_CASES))
    assert areas == [
        "eds", "nmt", "error-control", "sync", "time", "sdo", "sdo-block", "od", "emcy", "tpdo", "rpdo", "design", "store", "lss",
    ]  # fmt: skip
