"""How `starhil` reports errors that no command has reported itself."""

from __future__ import annotations

import re
import shutil
import sys
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from starhil.emulator.cli import app
from starhil.emulator.cli.run import DeviceOptions
from starhil.protocol.files.bundled import find_unit
from tests.emulator.cli.command_line import run_command_line

pytestmark = pytest.mark.lowest("typer")


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (FileNotFoundError(2, "No such file or directory", "a/b.txt"), "a/b.txt: No such file or directory"),
        (OSError(28, "No space left on device"), "No space left on device"),
        (PermissionError(13, "Permission denied", "a", None, "b"), "a -> b: Permission denied"),
        (OSError("two\nlines"), "two lines"),
        (TimeoutError(), "TimeoutError"),
        (MemoryError("Unable to allocate 26.1 GiB"), "not enough memory: Unable to allocate 26.1 GiB"),
        (MemoryError(), "not enough memory"),
    ],
)
def test_an_operating_system_error_is_one_line_and_status_2(
    error: Exception, message: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    built = typer.Typer()

    @built.command()
    def fail() -> None:
        raise error

    monkeypatch.setattr(app, "build_app", lambda _words: built)
    monkeypatch.setattr("sys.argv", ["starhil"])
    with pytest.raises(SystemExit) as caught:
        app.main()
    printed = capsys.readouterr()
    assert caught.value.code == 2
    assert (printed.out, printed.err) == ("", f"starhil: {message}\n")


def test_a_recording_without_the_package_of_its_extra_is_rejected_before_the_start(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, "mcap", None)  # as if it were not installed
    monkeypatch.delitem(sys.modules, "mcap.writer", raising=False)
    status, out, err = run_command_line(
        "run", "--record", str(tmp_path / "run.mcap"), "--serial", "off", "--can", "off"
    )
    assert (status, out) == (2, "")
    assert err == "starhil: mcap is not installed; run: pip install 'starhil[mcap]'\n"


@pytest.mark.parametrize("name", ["", ".", ".."])
def test_a_folder_given_as_a_file_is_named(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = name or str(tmp_path)
    monkeypatch.setattr("sys.argv", ["starhil", "icd", "export", "markdown", "-o", folder])
    with pytest.raises(SystemExit) as caught:
        app.main()
    printed = capsys.readouterr()
    assert caught.value.code == 2
    assert printed.out == ""
    assert printed.err == f"starhil: {folder}: is a folder; name a file with -o\n"


@pytest.mark.parametrize(
    "arguments",
    [
        ("truth", "convert", "truth.csv", "--date", "2026-01-01T00:00:00Z", "-o", "truth.csv"),
        ("icd", "export", "markdown", "--unit", ".", "-o", "nos3.toml"),
        ("replay", ".", "--csv", "truth.csv"),
    ],
)
def test_no_command_writes_over_what_it_reads(
    arguments: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`truth convert` replaced its source."""
    monkeypatch.chdir(tmp_path)
    shutil.copy(find_unit("nos3") / "nos3.toml", tmp_path)
    Path("truth.csv").write_text("t,qx,qy,qz,qw\n0,0,0,0,1\n1,0,0,0,1\n")
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    status, out, err = run_command_line(*arguments)
    assert (status, out) == (2, "")
    option = "--csv" if "--csv" in arguments else "-o"
    assert err == f"starhil: {arguments[-1]}: is a file that is read; name another one with {option}\n"
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("rum", "no such command 'rum'. Did you mean 'run'? (see starhil --help)"),
        ("run --sed 3", "run: no such option"),
        ("run --dialect d", "--dialect d: must be a, b or c"),
        (
            "run --canopen 999",
            "run: invalid value for '--canopen': ",
        ),
        (
            "conformance --time-out 1e300",
            "conformance: invalid value for '--time-out': ",
        ),
        ("bench bus --seconds 1e300", "bench bus: invalid value for '--seconds': "),
        ("render --ra x", "render: invalid value for '--ra': "),
        ("render", "render: missing option '--ra'"),
        ("icd export nope", "icd export: invalid value for 'FORMAT': 'nope' is not one of 'markdown'"),
        ("icd export", "icd export: missing argument 'FORMAT'"),
        ("campaign lost-in-space --frames 1.5", "campaign lost-in-space: invalid value for '--frames'"),
    ],
)
def test_a_rejected_option_is_one_line_and_status_2(
    arguments: str, message: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["starhil", *arguments.split()])
    with pytest.raises(SystemExit) as caught:
        app.main()
    printed = capsys.readouterr()
    assert caught.value.code == 2
    assert printed.out == ""
    assert printed.err.startswith(f"starhil: {message}")
    assert printed.err.endswith(" --help)\n") or message.startswith("--")  # that of our own check says all
    assert printed.err.count("\n") == 1


@pytest.mark.parametrize(
    ("raised", "status"), [(typer.Exit(1), 1), (KeyboardInterrupt(), 130), (None, 0), (typer.Abort(), 130)]
)
def test_the_process_exits_with_the_status_of_the_command(
    raised: BaseException | None, status: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    built = typer.Typer()

    @built.command()
    def work() -> None:
        if raised is not None:
            raise raised

    monkeypatch.setattr(app, "build_app", lambda _words: built)
    monkeypatch.setattr("sys.argv", ["starhil"])
    with pytest.raises(SystemExit) as caught:
        app.main()
    assert caught.value.code == status


def test_without_a_command_the_help_is_printed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["starhil"])
    with pytest.raises(SystemExit) as caught:
        app.main()
    assert caught.value.code == 2
    assert "Usage: starhil" in capsys.readouterr().out


def test_the_version_is_printed(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("sys.argv", ["starhil", "--version"])
    with pytest.raises(SystemExit) as caught:
        app.main()
    assert caught.value.code == 0
    assert re.fullmatch(r"starhil \d+\.\d+\.\d+(\.dev\d+)?\n", capsys.readouterr().out)


@pytest.mark.parametrize(
    ("words", "view"),
    [
        ([], "off"),
        (["--view"], "auto"),
        (["--view", "--seed", "3"], "auto"),
        (["--view", "127.0.0.1:8080", "demo"], "127.0.0.1:8080"),
    ],
)
def test_the_address_of_the_console_is_optional(words: list[str], view: str) -> None:
    command = typer.main.get_command(app.build_app())
    context = command.make_context("starhil", ["run", *words])
    run = command.get_command(context, "run")
    assert run.make_context("run", words, parent=context).params["view"] == view


def test_help_shows_flags_without_a_type_and_positional_arguments_in_capitals() -> None:
    for command, shown in (
        ("run", "[PROFILE]"),
        ("session", "SCRIPT"),
        ("replay", "FOLDER"),
    ):
        text = CliRunner().invoke(app.build_app(), [command, "--help"]).stdout
        assert "<bool>" not in text
        assert shown in text.split("Usage:")[1].splitlines()[0]


def test_the_help_of_run_begins_with_what_most_runs_need(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    text = CliRunner().invoke(app.build_app(), ["run", "--help"]).stdout
    first, *others = text.partition("─ Options ─")[2].split("╭─")
    common = "unit serial can symlink orbit set truth-log scenario view record list help"
    assert re.findall(r"--([\w-]+) ", first) == common.split()
    assert len(others) == 3
    assert "written, for example because the disk is full; the run goes on without it." in text


def test_the_unit_of_the_command_line_replaces_that_of_the_profile():
    assert DeviceOptions(unit="sagitta").profile("ideal", 1).unit == "sagitta"
