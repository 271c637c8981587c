"""Results of a failed run: reports, and the last lines of stderr of the emulator."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from starhil.hil_tests.conformance import conformance_run
from starhil.hil_tests.conformance.conformance_run import ConformanceRequest, run_conformance
from starhil.hil_tests.conformance.report import write_html_report, write_junit_report
from starhil.hil_tests.errors import BenchError, EmulatorProcessError
from starhil.hil_tests.reports import prepare_report, write_junit, write_report
from starhil.hil_tests.rig.emulator_process import EmulatorProcess
from starhil.hil_tests.rig.rig import LinkOptions, Rig
from starhil.protocol.unit import load_unit
from tests.waiting import PATIENCE_S

READY = "import sys, time; print('ready serial=none', flush=True); "
DIES = READY + "print('Segmentation of the sky', file=sys.stderr); sys.exit(7)"
STARTS_SLOWLY = (
    "import sys; print('starting: 5 s', file=sys.stderr, flush=True); print('0 WARNING', file=sys.stderr, flush=True); "
    + READY
    + "time.sleep(600)"
)
LASTS = READY + "time.sleep(600)"
LAST_ERRORS = "unexpectedly with status 7: Segmentation of the sky"


def emulator(text: str) -> EmulatorProcess:
    return EmulatorProcess([sys.executable, "-c", text])


def rig(text: str) -> Rig:
    return Rig(LinkOptions(serial="auto"), load_unit(), emulator=emulator(text))


def wait_for_its_end(process: EmulatorProcess, error: Exception | None = None) -> None:
    """Wait until the emulator ends, then raise the error if there is one."""
    if process.command[-1] == DIES:
        process.process.wait(timeout=PATIENCE_S)
    if error is not None:
        raise error


@pytest.mark.process
def test_an_emulator_that_ended_unexpectedly_is_reported_with_its_last_errors():
    with pytest.raises(EmulatorProcessError, match=LAST_ERRORS), rig(DIES) as own:
        wait_for_its_end(own.emulator)
    assert own.emulator.process.stdout.closed
    assert own.emulator.process.stderr.closed


@pytest.mark.process
def test_the_progress_of_a_slow_start_is_shown_without_other_messages(capfd):
    process = emulator(STARTS_SLOWLY)
    process.start()
    process.kill()
    assert capfd.readouterr() == ("", "starting: 5 s\n")
    assert process.errors == ["0 WARNING"]


@pytest.mark.process
def test_the_end_of_an_emulator_is_the_reason_of_later_errors():
    with pytest.raises(EmulatorProcessError, match=LAST_ERRORS), rig(DIES) as own:
        wait_for_its_end(own.emulator, BenchError("no reply"))


@pytest.mark.process
@pytest.mark.parametrize("text", [DIES, LASTS])
def test_another_error_is_not_hidden_by_it(text):
    with pytest.raises(ZeroDivisionError), rig(text) as own:
        wait_for_its_end(own.emulator, ZeroDivisionError())
    assert not own.emulator.running
    assert own.emulator.process.stderr.closed


@pytest.mark.process
def test_an_end_that_a_restart_has_reported_is_not_reported_again():
    with rig(DIES) as own:
        wait_for_its_end(own.emulator)
        with pytest.raises(EmulatorProcessError, match=LAST_ERRORS):
            own.restart("term")


@pytest.mark.process
def test_a_conformance_run_whose_emulator_ended_keeps_its_outcomes_and_reports_the_end(monkeypatch):
    def start(_request, stack):
        process = stack.enter_context(emulator(DIES))
        wait_for_its_end(process)
        process.ready.clear()  # it opened no link
        return process

    monkeypatch.setattr(conformance_run, "_start_emulator", start)
    reported = []
    outcomes = run_conformance(ConformanceRequest(serial="auto", start=True), reported.append).outcomes
    assert [(outcome.id, outcome.status) for outcome in outcomes] == [("emulator.end", "failed")]
    assert LAST_ERRORS in outcomes[0].seen
    assert reported == outcomes


def test_an_html_report_has_the_facts_of_the_run(tmp_path):
    facts = {
        "date": "2026-11-23T09:30:00+00:00",
        "definition": "unit 1.1",
        "device on can": "firmware_major <2>",
    }
    write_html_report(tmp_path / "r.html", [], facts)
    page = (tmp_path / "r.html").read_text(encoding="utf-8")
    assert "<tr><th>definition</th><td>unit 1.1</td></tr>" in page
    assert "<td>firmware_major &lt;2&gt;</td>" in page


WRITERS = pytest.mark.parametrize(
    "write",
    [
        prepare_report,
        lambda path: write_report(path, b"x"),
        lambda path: write_junit(path, "suite", [], 0.0),
        lambda path: write_junit_report(path, []),
        lambda path: write_html_report(path, [], {"links": "serial x"}),
    ],
    ids=["before", "any", "junit", "conformance-junit", "html"],
)


@WRITERS
def test_the_folder_of_a_report_is_made(write, tmp_path):
    path = tmp_path / "out" / "deeper" / "report"
    write(path)
    assert path.parent.is_dir()
    assert [item.name for item in path.parent.iterdir()] == ([] if write is prepare_report else ["report"])


@WRITERS
def test_a_folder_cannot_be_a_report(write, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for path in (Path(), tmp_path):
        with pytest.raises(BenchError, match="is a folder; name the file of the report"):
            write(path)


@WRITERS
def test_a_folder_that_cannot_be_made_is_reported_in_one_line(write, tmp_path):
    (tmp_path / "file").write_text("", encoding="ascii")
    for path in (tmp_path / "file" / "report", tmp_path / "file" / "deeper" / "report"):
        with pytest.raises(BenchError, match=r"report: its folder cannot be created: [A-Z].*"):
            write(path)


def test_a_report_that_cannot_be_finished_leaves_the_old_one(tmp_path, monkeypatch):
    path = tmp_path / "report"
    write_report(path, b"old")

    def full(_path, _data):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(BenchError, match="cannot be written: No space left on device"):
        write_report(path, b"new")
    assert [(item.name, item.read_bytes()) for item in tmp_path.iterdir()] == [("report", b"old")]
