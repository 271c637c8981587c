"""Files `*_cases.py` and `*_cases.toml` beside a definition add cases to those that the definition yields."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from starhil.hil_tests.conformance.link_probe import ReadableSettings
from starhil.hil_tests.conformance.runner import run_case, run_cases
from starhil.hil_tests.conformance.suites import can_suite, serial_suite, settings_of
from starhil.hil_tests.errors import BenchError
from starhil.hil_tests.judge.definition import read_unit
from starhil.protocol.files.bundled import find_unit
from tests.conformance.links import write_unit
from tests.conformance.simulated import SimulatedUnit

pytestmark = pytest.mark.long

OWN = """
from starhil.hil_tests.conformance.case import Case, CaseArea, check_equal

BOOTS = CaseArea("boots", "ICD 1")
ON_CAN = CaseArea("on_can", "ICD 2", links=("can",))
FRAMING = CaseArea("framing", "ICD 3")


@BOOTS.case("first", "the unit has booted once")
def first(probe):
    check_equal(probe.telemetry("attitude")["boots"], BOOTED, "boots")


@ON_CAN.case("none", "not on the serial line")
def none(probe):
    raise AssertionError


@FRAMING.case("junk", "this unit answers junk in a way of its own")
def junk(probe):
    probe.expect_alive()


def generated(unit):
    for name in unit.telemetry:
        yield Case(f"names.{name}", "names", name, "ICD 4", lambda probe, name=name: probe.telemetry(name))


class settings:
    def prepare(self, probe):
        self.before = probe.telemetry("numbers")

    def restore(self, probe):
        probe.command("set_numbers", **self.before)
"""


def unit_with(folder: Path, own: str) -> Path:
    write_unit(folder, "sum")
    (folder / "own_cases.py").write_text(own, encoding="utf-8")
    return folder


@pytest.mark.parametrize(("event", "status"), [("start", "passed"), ("error", "failed")])
def test_a_row_that_reports_the_start_is_awaited_after_a_reset(
    event: str, status: str, tmp_path: Path
) -> None:
    for name, sent_after in (("unit", "start"), ("served", event)):
        folder = Path(shutil.copytree(find_unit("cubestar"), tmp_path / name))
        (folder / "90-start.toml").write_text(
            '[[telemetry]]\nid = 130\nname = "started"\ndoc = "The unit has started."\nprovenance = "ours"\n'
            f'unsolicited = ["{sent_after}"]\nfields = [{{ name = "boots", type = "u16", value = "boot.count" }}]\n'
        )
    unit, served = tmp_path / "unit", tmp_path / "served"
    case = next(item for item in can_suite(read_unit(unit)) if item.id == "can.unsolicited.started")
    with SimulatedUnit("can", unit=unit, served=served) as simulated:
        outcome = run_case(simulated.probe, case)
    assert outcome.status == status


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (
            "telemetri status a=1",
            "telemetri status a=1: 'telemetri' is neither bytes, a CAN frame nor a verb; did you mean telemetry?",
        ),
        ("drain; silence soon", "silence soon: could not convert string to float: 'soon'"),
        ("sleep", "sleep: missing a required argument: 'seconds'"),
        ("sleep -1", "sleep -1: '-1' is not a time in seconds"),
        ("1F 7", "1F 7: '7' is neither bytes, a CAN frame nor a verb"),
        ("480#0", "480#0: '480#0' is neither bytes, a CAN frame nor a verb"),
        ("> 128", "> 128: nothing is sent"),
        ("drain > 128", "drain > 128: nothing may follow >"),
        ("telemetry status", "telemetry status: missing a required argument: 'setting'"),
        ("telemetry status a", "telemetry status a: 'a' is not FIELD=VALUE"),
        ("{clear}; 00 {zzz}", "unknown name 'zzz' in braces"),
        ("00 {}", "braces: Format string contains positional fields"),
        ("{clear}; sleep 1 2", "sleep 1 2: too many positional arguments"),
        ("1F 7F > ack", "1F 7F > ack: 'ack' is neither ROW, ROW!ERROR nor a CAN frame"),
    ],
)
def test_a_wrong_step_of_a_file_is_named_before_the_run(lines: str, message: str, tmp_path: Path) -> None:
    folder = unit_with(tmp_path / "unit", "")
    path = folder / "more_cases.toml"
    path.write_text(
        '[texts]\nclear = "drain"\n[[area]]\nname = "more"\nclause = "ICD 5"\n'
        f'cases = [{{ id = "a", title = "t", lines = "{lines}" }}]\n'
    )
    with pytest.raises(BenchError) as caught:
        serial_suite(read_unit(folder))
    place = "" if "braces" in message else "line 1: "
    assert str(caught.value) == f"{path}: more.a: {place}{message}"


def test_a_step_with_a_row_or_field_that_the_unit_lacks_fails_its_case(tmp_path: Path) -> None:
    folder = unit_with(tmp_path / "unit", "")
    (folder / "more_cases.toml").write_text(
        '[[area]]\nname = "more"\nclause = "ICD 5"\ncases = [\n'
        '    { id = "a", title = "t", lines = "command nothing" },\n'
        '    { id = "b", title = "t", lines = "telemetry nothing a=1" },\n'
        '    { id = "c", title = "t", lines = "telemetry attitude nothing=1" },\n]\n'
    )
    cases = [case for case in serial_suite(read_unit(folder)) if case.area == "serial.more"]
    with SimulatedUnit("serial", unit=folder) as simulated:
        expected = [run_case(simulated.probe, case).detail for case in cases]
    assert "a telecommand 'nothing' in the definition" in expected[0]
    assert "telemetry 'nothing' in the definition" in expected[1]
    assert "no such field" in expected[2]


def test_own_cases_are_run_with_those_of_the_definition(tmp_path: Path) -> None:
    folder = unit_with(tmp_path / "unit", OWN.replace("BOOTED", "1"))
    derived = {case.id for case in serial_suite(read_unit(write_unit(tmp_path / "plain", "sum")))}
    cases = {case.id: case for case in serial_suite(read_unit(folder))}
    own = {
        "serial.boots.first",
        "serial.names.numbers",
        "serial.names.attitude",
        "serial.names.short_attitude",
    }
    assert cases.keys() - derived == own
    assert derived <= cases.keys()
    assert cases["serial.framing.junk"].clause == "ICD 3", "the unit's own case replaces the derived one"
    with SimulatedUnit("serial", unit=folder) as simulated:
        outcomes = run_cases(simulated.probe, [cases[name] for name in sorted(own)])
    assert [outcome.status for outcome in outcomes] == ["passed"] * 4


def test_an_own_case_can_fail(tmp_path: Path) -> None:
    folder = unit_with(tmp_path / "unit", OWN.replace("BOOTED", "7"))
    with SimulatedUnit("serial", unit=folder) as simulated:
        chosen = [case for case in serial_suite(read_unit(folder)) if case.id == "serial.boots.first"]
        (outcome,) = run_cases(simulated.probe, chosen)
    assert (outcome.status, outcome.expected, outcome.seen) == ("failed", "boots 7", "1")


def test_a_units_own_settings_are_restored_and_otherwise_those_that_can_be_read(tmp_path: Path) -> None:
    folder = unit_with(tmp_path / "unit", OWN.replace("BOOTED", "1"))
    assert type(settings_of(read_unit(folder))).__name__ == "settings"
    plain = read_unit(write_unit(tmp_path / "plain", "sum"))
    assert isinstance(settings_of(plain), ReadableSettings)
    for path in (folder, tmp_path / "plain"):
        with SimulatedUnit("serial", unit=path) as simulated:
            simulated.probe.command("set_numbers", a=77)
            cases = [
                case for case in serial_suite(read_unit(path)) if case.id == "serial.commands.set_numbers"
            ]
            (outcome,) = run_cases(simulated.probe, cases)
            assert outcome.status == "passed"
            assert simulated.probe.telemetry("numbers")["a"] == 77


def test_a_definition_in_one_file_runs_no_files_beside_it(tmp_path: Path) -> None:
    folder = unit_with(tmp_path / "unit", "raise SystemError")
    assert serial_suite(read_unit(folder / "unit.toml"))


TEXTS = """
[texts]
boots = "telemetry attitude boots=1"

[[area]]
name = "own"
clause = "ICD 5"
links = ["serial"]
cases = [
    { id = "right", title = "this unit has booted once", lines = "00 55 (00)*3; silence; sleep 1; drain; {boots}" },
    { id = "wrong", title = "it has not booted often", lines = "{boots}; telemetry attitude boots=1 boots=7", intrusive = true },
    { id = "none", title = "a row that the unit lacks", lines = "{long}" },
]
"""


def test_cases_in_a_text_file_are_run_on_their_link(tmp_path: Path) -> None:
    folder = write_unit(tmp_path, "sum")
    (folder / "own_cases.toml").write_text(TEXTS, encoding="utf-8")
    cases = [case for case in serial_suite(read_unit(folder)) if case.area == "serial.own"]
    assert [(case.id, case.title, case.clause, case.intrusive) for case in cases] == [
        ("serial.own.right", "this unit has booted once", "ICD 5", False),
        ("serial.own.wrong", "it has not booted often", "ICD 5", True),
    ]
    with SimulatedUnit("serial", unit=folder) as simulated:
        outcomes = run_cases(simulated.probe, cases)
    assert [(outcome.status, outcome.expected, outcome.seen) for outcome in outcomes] == [
        ("passed", "", ""),
        (
            "failed",
            "attitude {'boots': 7} (step 2: telemetry attitude boots=1 boots=7, after telemetry attitude boots=1)",
            "{'boots': 1}",
        ),
    ]


@pytest.mark.parametrize(
    ("text", "error"),
    [
        (
            "[[area]]\nname = 1\n",
            r"area\.0\.name: must be a text .*; .*area\.0\.clause: missing",
        ),
        ("area = [", "Invalid"),
        ("[[row]]", "row: unknown key"),
    ],
)
def test_a_text_file_of_cases_with_errors_is_named(text: str, error: str, tmp_path: Path) -> None:
    folder = write_unit(tmp_path, "sum")
    (folder / "own_cases.toml").write_text(text, encoding="utf-8")
    with pytest.raises(BenchError, match=rf"^[^\n]*own_cases\.toml: [^\n]*{error}[^\n]*$"):
        serial_suite(read_unit(folder))


def test_a_file_that_fails_is_named(tmp_path: Path) -> None:
    folder = unit_with(tmp_path / "unit", "import no_such_module")
    with pytest.raises(
        BenchError, match=r"own_cases\.py: ModuleNotFoundError: No module named 'no_such_module'"
    ):
        serial_suite(read_unit(folder))
