"""Output paths, encodings and numbers: what holds for every command of both programs."""

from __future__ import annotations

import io
import json
import os
import re
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import typer
from rich.console import Console

from starhil.emulator.benchmarks import algorithms
from starhil.emulator.benchmarks.algorithms import ALGORITHMS
from starhil.emulator.cli import app, output
from starid.cli import app as library
from starid.cli import command_line
from starid.cli.output import progress_shown, show_every_character
from starid.errors import StaridError
from tests.emulator.cli.command_line import log_lines, run_command_line
from tests.emulator.workers import WORKER
from tests.waiting import PATIENCE_S

PROGRAM = [sys.executable, "-c", "from starhil.emulator.cli import main; main()"]
STDOUT = "/proc/self/fd/1"
WRITTEN = {"--output", "--junit", "--html", "--truth-log"}
"""Options that name a file to write; `hub --log` is one too, the other logs are not."""


def starhil(*arguments: str, **environment: str) -> subprocess.CompletedProcess[bytes]:
    return subprocess.run(
        [*PROGRAM, *arguments], capture_output=True, timeout=PATIENCE_S, env={**os.environ, **environment}
    )


def program_of(command: str) -> str:
    """The program that has a sub-command."""
    return "starid" if command in library.COMMANDS else "starhil"


def refusal(*arguments: str) -> str:
    """The one line on standard error of a command that is rejected."""
    status, out, said = run_command_line(*arguments, program=program_of(arguments[0]))
    assert (status, out, said[-1:]) == (2, "", "\n"), said
    (line,) = log_lines(said)
    return line + "\n"


def commands(group: Any = None, path: str = "") -> list[tuple[str, Any]]:
    """Every command of both programs with its path."""
    if group is None:
        programs = (app.build_app(), library.build_app())
        return [each for program in programs for each in commands(typer.main.get_command(program))]
    each: list[tuple[str, Any]] = []
    for name, command in group.commands.items():
        below = f"{path} {name}".strip()
        each += commands(command, below) if hasattr(command, "commands") else [(below, command)]
    return each


def test_every_option_that_names_a_file_to_write_states_the_rule() -> None:
    files = {
        f"{path} {option.opts[0]}": str(option.help)
        for path, command in commands()
        for option in command.params
        if (WRITTEN & {*option.opts} or (path, option.name) == ("hub", "log"))
        and not option.is_flag
        and not str(option.help).startswith("Folder")
    }
    assert len(files) >= 11
    assert [name for name, said in files.items() if "Missing folders are created" not in said] == []


@pytest.mark.parametrize(
    "arguments",
    [
        "icd export eds -o",
        "render --ra 83.8 --dec -1.2 --size 64 -o",
        "database build --overlap 50 -o",
    ],
)
def test_missing_folders_are_made_and_a_file_in_their_place_is_rejected(
    arguments: str, tmp_path: Path
) -> None:
    path = tmp_path / "a" / "b" / "out.png"
    program = program_of(arguments.split(maxsplit=1)[0])
    status, _, said = run_command_line(*arguments.split(), str(path), program=program)
    assert status == 0, said
    assert path.stat().st_size > 0
    assert [each.name for each in path.parent.iterdir()] == ["out.png"]
    assert refusal(*arguments.split(), str(path / "c" / "out.png")).startswith(f"{program}: {path / 'c'}")
    assert "is a folder" in refusal(*arguments.split(), str(path.parent))


@pytest.mark.process
def test_an_export_to_the_standard_output_is_in_utf_8_whatever_its_encoding_is(
    capfdbinary: pytest.CaptureFixture[bytes],
) -> None:
    plain = starhil("icd", "export", "markdown", PYTHONIOENCODING="ascii").stdout
    assert run_command_line("icd", "export", "markdown", "-o", STDOUT) == (0, "", "")
    assert capfdbinary.readouterr().out == plain
    assert run_command_line("icd", "export", "markdown") == (0, plain.decode("utf-8"), "")
    assert not plain.isascii()


def test_an_image_on_the_standard_output_has_its_report_on_the_standard_error(
    capfdbinary: pytest.CaptureFixture[bytes],
) -> None:
    arguments = ("render", "--ra", "83.8", "--dec", "-1.2", "--size", "64", "-o", STDOUT, "--json")
    status, out, said = run_command_line(*arguments)
    assert (status, out) == (0, "")
    image = capfdbinary.readouterr().out
    assert image.startswith(b"\x89PNG")
    assert image.endswith(b"IEND\xaeB`\x82")
    (report,) = log_lines(said)
    assert json.loads(report)["width"] == 64


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "cp437", "utf-8"])
def test_an_output_of_any_encoding_shows_every_character(encoding: str) -> None:
    status, out, said = run_command_line("catalog", "--star", "11767", encoding=encoding, program="starid")
    assert (status, said) == (0, "")
    assert "37.97" in out


def test_characters_that_an_encoding_lacks_are_spelled_out(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr("sys.stdout", stream)
    show_every_character()
    print("1σ 0.12″ ≤ 3° 漢 \udcff", file=stream, flush=True)
    assert stream.buffer.getvalue() == b'1sigma 0.12" <= 3 deg \\u6f22 \\udcff\n'  # type: ignore[attr-defined]


def test_every_command_rejects_numbers_that_are_not_finite() -> None:
    assert [path for path, command in commands() if not isinstance(command, command_line.FiniteCommand)] == []


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        ("catalog --limit nan", "'--limit': must be finite"),
        ("catalog --cone 1 inf 3", "'--cone': must be finite"),
        ("campaign lost-in-space --require-valid nan", "'--require-valid': must be finite"),
        ("features --ra 1 --dec 2 --kappa=-inf", "'--kappa': must be finite"),
        ("catalog --limit 1_0", "'--limit': '1_0' is not a number"),
        ("catalog --cone 1 1_0 3", "'--cone': '1_0' is not a number"),
        ("campaign lost-in-space --frames 1_0", "'--frames': '1_0' is not a number"),
        ("conformance --canopen=1_0", "'--canopen': '1_0' is not a number"),
    ],
)
def test_a_number_that_other_programs_do_not_read_is_rejected(arguments: str, why: str) -> None:
    assert f"invalid value for {why}" in refusal(*arguments.split())


def test_the_epoch_0_is_not_the_default_one() -> None:
    assert "epoch" in refusal("features", "--ra", "83", "--dec", "0", "--epoch", "0")


@pytest.mark.parametrize("arguments", ["identify gone.png", "render --ra 1 --dec 2 --profile gone.toml"])
def test_an_invalid_image_name_is_rejected_before_rendering(arguments: str, tmp_path: Path) -> None:
    path = tmp_path / "folder" / "out.gif"
    assert "not '.gif'" in refusal(*arguments.split(), "-o", str(path))
    assert not path.parent.exists()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("database build --overlap 99.9999999", "give less overlap or wider frames"),
        ("database build --overlap 50 --fov 1e-5", "give less overlap or wider frames"),
        ("features --ra 1 --dec 2 --fov 1e9", "--fov 1e+09: must be above 0"),
        ("features --ra 1e300 --dec 2", "right ascension of the frame's centre"),
        ("render --ra 1 --dec 2 --fov 1e-9 -o out.png", "--fov 1e-09: must be at least 0.1"),
        ("catalog --path /dev/zero", "cannot be read (not a regular file)"),
        ("calibrate gone.png --fov 1 -o /proc/x/y", "its folder cannot be created"),
    ],
)
def test_nonsensical_arguments_are_rejected_in_one_line(arguments: str, said: str) -> None:
    assert said in refusal(*arguments.split())


@pytest.fixture
def slow_worker(worker: Callable[..., object], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Start workers that fail once there is a file, whose path is returned, and report progress at once."""
    gate = tmp_path / "gate"
    waits = f"import pathlib, time\nwhile not pathlib.Path({str(gate)!r}).exists():\n    time.sleep(0.01)\n"
    worker(WORKER + waits + "send(Failure('no catalogue'))\n")
    monkeypatch.setenv("STARHIL_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr("starid.cli.output.PROGRESS_S", 0.05)
    monkeypatch.setattr("starid.cli.output.LOG_S", 0.0)
    return gate


def test_a_slow_start_reports_its_progress_on_stderr(
    slow_worker: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    compiled = iter((0, 7))

    def count(_since: float) -> int:
        try:
            return next(compiled)
        except StopIteration:
            slow_worker.touch()
            return 7

    monkeypatch.setattr("starid.storage.cache.kernels_written_since", count)
    status, out, said = run_command_line("run", "--can", "off")
    assert (status, out) == (2, "")
    first, second, *_, last = said.splitlines()
    assert re.fullmatch(r"starting: \d+ s", first)
    assert re.fullmatch(r"starting: \d+ s, kernels added to the cache: 7; later runs use them", second)
    assert last.endswith("no catalogue")


def test_what_a_command_compiles_is_reported(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """`campaign` and `bench` compiled for two minutes in silence."""
    written = iter((1, 2, 2))
    counted = threading.Event()

    def written_since(_begin_s: float) -> int:
        try:
            return next(written)
        except StopIteration:
            counted.set()
            return 2

    monkeypatch.setattr("starid.cli.output.PROGRESS_S", 0.001)
    monkeypatch.setattr("starid.cli.output.LOG_S", 0.0)
    monkeypatch.setattr("starid.storage.cache.kernels_written_since", written_since)
    assert output.compiles(counted.wait)(PATIENCE_S)
    lines = (
        rf"compiling: \d+ s, kernels added to the cache: {number}; later runs use them\n" for number in (1, 2)
    )
    assert re.fullmatch("".join(lines), capsys.readouterr().err)


def test_progress_is_a_line_at_a_time_in_a_log_and_a_bar_on_a_terminal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """`endurance` ran for an hour in silence."""
    for interval_s, expected in ((3600.0, ""), (0.0, "lives: 1 of 3 after 0 s\nlife 2: 2 of 3 after 0 s\n")):
        monkeypatch.setattr("starid.cli.output.LOG_S", interval_s)
        with progress_shown("lives") as show:
            show(1, 3)
            show(2, 3, "life 2")
        assert capsys.readouterr() == ("", expected)
    terminal = Console(file=io.StringIO(), force_terminal=True, color_system=None, width=60)
    with progress_shown("lives", terminal) as show:
        show(1, 3)
    assert re.search(r"1/3 .*lives", terminal.file.getvalue())
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize(
    "words",
    [
        "campaign", "campaign lost-in-space", "campaign algorithms", "campaign orbit", "campaign tracking",
        "bench centroid", "bench frame", "endurance", "render --ra 1 --dec 1 -o image.png", "replay run",
    ],
)  # fmt: skip
def test_a_command_that_compiles_kernels_says_so(words: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def reported() -> None:
        raise StaridError("what it compiles is reported")

    monkeypatch.setattr(output, "compiling_reported", reported)
    assert run_command_line(*words.split()) == (2, "", "starhil: what it compiles is reported\n")


def test_the_figures_of_the_algorithms_fit_into_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    """With a column for each figure, a line had 255 characters."""
    names = ["valid_pct", "right_pct", "within_pct", "across_deg", "about_deg", "stated_deg"]
    names += [
        "normalised_squared_error",
        "true_kept_pct",
        "false_kept_pct",
        "median_ms",
        "p99_ms",
        "kilobytes",
    ]
    some = dict.fromkeys(names, 100.12345) | dict.fromkeys(("frames", "wrong", "in_region", "triggers"), 7)
    errors = ("valid_error_pct", "right_error_pct", "within_error_pct", "normalised_squared_error_error")
    rows = [
        {"scene": f"{scene} deg/s", "algorithm": algorithm, **some, **dict.fromkeys(errors, error)}
        for scene, error in (("0", 0.04), ("2", None))
        for algorithm in ALGORITHMS
    ]
    rows[0]["across_deg"] = rows[0]["about_deg"] = None
    monkeypatch.setattr(algorithms, "run_algorithms", lambda *_arguments: rows)
    status, out, _ = run_command_line("campaign", "algorithms")
    assert status == 1  # 7 refined attitudes are wrong
    assert max(map(len, out.splitlines())) <= 110
    shown = [re.split(r" {3,}", line.strip()) for line in out.splitlines() if line.strip()]
    assert ["valid, %", *["100.1 ± 0.0"] * 3] in shown
    assert ["valid, %", *["100.1"] * 3] in shown
    assert ["kept of true, false stars, %", *["100, 100"] * 3] in shown
    assert ["median error across, about, °", *["100.1235, 100.1235"] * 2] in shown
