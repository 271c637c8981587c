"""What the shells complete, as typer's scripts for them ask."""

from __future__ import annotations

import re

import pytest

from starhil.protocol.files.bundled import bundled
from tests.emulator.cli.command_line import run_command_line

pytestmark = pytest.mark.lowest("typer")


def completed(monkeypatch: pytest.MonkeyPatch, shell: str, line: str) -> str:
    """Return what a shell is answered at the end of a line."""
    program = line.split(maxsplit=1)[0]
    monkeypatch.setenv(f"_{program.upper()}_COMPLETE", f"complete_{shell}")
    if shell == "bash":
        monkeypatch.setenv("COMP_WORDS", line)
        monkeypatch.setenv("COMP_CWORD", str(line.count(" ")))
    else:
        monkeypatch.setenv("_TYPER_COMPLETE_ARGS", line)
        monkeypatch.setenv("_TYPER_COMPLETE_FISH_ACTION", "get-args")
    status, out, _ = run_command_line(program=program)
    assert status == 0
    return out


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("starhil conf", ["conformance"]),
        ("starid cal", ["calibrate"]),
        ("starhil run ", list(bundled("profile"))),
        ("starhil run --unit cubestar-", ["cubestar-gen2"]),
        ("starhil run --head real", ["real_lens"]),
        ("starhil run --scenario b", ["bad_day"]),
        ("starhil run --truth-", ["--truth-log"]),
        ("starhil session e", ["errors"]),
        ("starhil unit describe s", ["sagitta", "st16", "st200"]),
        ("starhil docs con", ["console", "control"]),
        ("starid identify --out", ["--output"]),
    ],
)
def test_commands_options_and_names_are_completed(
    monkeypatch: pytest.MonkeyPatch, line: str, words: list[str]
) -> None:
    assert completed(monkeypatch, "bash", line).split() == words


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_other_shells_are_answered_too(monkeypatch: pytest.MonkeyPatch, shell: str) -> None:
    assert "first_light" in completed(monkeypatch, shell, "starhil session fi")


@pytest.mark.parametrize(("words", "kinds"), [(["run"], ["profile", "scenario"]), (["session"], ["session"])])
def test_what_ships_is_listed_with_a_description(words: list[str], kinds: list[str]) -> None:
    status, out, _ = run_command_line(*words, "--list")
    assert status == 0
    lists = [part.splitlines()[1:] for part in re.split(r"(?m)^(?=\w)", out) if part]
    assert [[line.split()[0] for line in lines] for lines in lists] == [[*bundled(kind)] for kind in kinds]
    for lines in lists:  # in columns
        assert len({line.index(line.split(maxsplit=1)[1]) for line in lines}) == 1


@pytest.mark.process
@pytest.mark.parametrize(
    ("words", "kind"),
    [
        (["run", "cubstar"], "profile"),
        (["run", "--scenario", "cubstar"], "scenario"),
        (["session", "cubstar"], "session"),
        (["unit", "describe", "cubstar"], "unit"),
    ],
)
def test_an_unknown_name_is_rejected_in_the_same_words(words: list[str], kind: str) -> None:
    status, _, said = run_command_line(*words)
    assert status == 2
    assert f"{kind} 'cubstar': not found; give a path, or one of: {', '.join(bundled(kind))}" in said
    assert said.count("did you mean cubestar") == (kind in ("profile", "unit"))


def test_pages_are_printed_by_name_or_as_they_are_linked() -> None:
    _, listed, _ = run_command_line("docs")
    assert {"profile", "control", "leaderboard"} <= {line.split()[0] for line in listed.splitlines()}
    for page in ("profile", "profile.md", "docs/profile.md#camera"):
        status, out, _ = run_command_line("docs", page)
        assert (status, out.startswith("# Device profiles\n")) == (0, True)
    assert "page 'contrl': not found; did you mean control" in run_command_line("docs", "contrl")[2]


def test_pages_of_the_api_are_printed_with_the_docstrings() -> None:
    assert "api/hil_tests" in run_command_line("docs")[1]
    status, out, _ = run_command_line("docs", "api/hil_tests.md")
    assert (status, "eval-rst" in out) == (0, False)
    assert "class ObcClient" in out
    assert "wait_for(" in out
