"""Each command on a page is accepted, and commands that belong together are executed as they stand."""

from __future__ import annotations

import contextlib
import csv
import json
import os
import re
import shlex
import shutil
import socket
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass, replace
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import typer

from starhil import ObcClient
from starhil.emulator.cli import app as starhil
from starhil.hil_tests.rig.emulator_process import EmulatorProcess, installed_command
from starid.cli import app as starid
from tests.emulator.cli.command_line import run_command_line
from tests.process.conftest import NO_IMAGES_OPTIONS, NO_IMAGES_TABLES
from tests.test_docs import programs, run
from tests.test_your_unit import written
from tests.waiting import PATIENCE_S

ROOT = Path(__file__).parents[1]
PAGES = {
    str(path.relative_to(ROOT)): path for path in [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
}
APPS = {"starhil": starhil, "starid": starid}
_FENCED = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_INDENTED = re.compile(r"(?:^ {4}.*\n)+", re.MULTILINE)
_INLINE = re.compile(r"`((?:starhil|starid) [^`]*)`")
_OPERATORS = {"|", ";", "&", "&&", "||"}
_PLACEHOLDER = re.compile(r"[…\[|]|\b[A-Z]{2,}\b")


@dataclass(frozen=True)
class Typed:
    """Lines of a page that its reader types, one after the other."""

    page: str
    lines: tuple[str, ...]


def typed(page: str) -> list[Typed]:
    """Return the blocks of a page with commands of a shell, without the lines of other programs."""
    return [
        Typed(page, lines)
        for block in shell_blocks(page)
        if (lines := tuple(line for line in block if re.search(r"(?:^|\s)(?:starhil|starid)\s", line)))
    ]


def shell_blocks(page: str) -> list[list[str]]:
    """Return the blocks of a page that are indented or for a shell, by lines."""
    text = PAGES[page].read_text(encoding="utf-8")
    fenced = [
        "".join(re.findall(r"^\$ (.*\n)", block, re.MULTILINE)) if language == "console" else block
        for language, block in _FENCED.findall(text)
        if language in ("sh", "console")
    ]
    indented = [
        re.sub(r"^ {4}", "", block, flags=re.MULTILINE)
        for block in _INDENTED.findall(_FENCED.sub("\n", text))
    ]
    return [re.sub(r"\\\n *", "", block).splitlines() for block in [*fenced, *indented]]


def files_of(page: str, *languages: str) -> dict[str, str]:
    """Return the blocks of a page that begin with the name of a file, in a comment, by this name."""
    text = PAGES[page].read_text(encoding="utf-8")
    blocks = [block for language, block in _FENCED.findall(text) if language in languages]
    return {
        name[1]: block for block in blocks if (name := re.match(r"(?:#|/\*) (\S+\.\w+)(?: \*/)?\n", block))
    }


def write_all(files: dict[str, str], folder: Path) -> None:
    """Write files into a folder, by their names."""
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text, encoding="utf-8")


def lines_of(page: str, first: str) -> list[str]:
    """Return the lines of the block of a page whose beginning matches a pattern."""
    (found,) = [lines for lines in shell_blocks(page) if lines and re.match(first, lines[0])]
    return [line for line in found if line]


def calls(line: str) -> Iterator[list[str]]:
    """Yield the calls of `starhil` and `starid` in a line, each with its arguments."""
    words = list(shlex.shlex(line, posix=True, punctuation_chars="|;&"))
    words = shlex.split(line, comments=True) if not set(words) & _OPERATORS else words
    starts = [at for at, word in enumerate(words) if word.rpartition("/")[2] in APPS]
    for start, following in pairwise([*starts, len(words)]):
        call = [words[start].rpartition("/")[2]]
        for word in words[start + 1 : following]:
            if word in _OPERATORS:
                break
            call.append(word)
        yield call


def accept(command: Any, name: str, words: list[str], parent: Any = None) -> None:
    """Parse the arguments of a command, and fail on one that it does not have."""
    context = command.make_context(name, list(words), parent=parent)
    if hasattr(command, "list_commands"):
        named = next((at for at, word in enumerate(words) if word in command.list_commands(context)), None)
        if named is None:
            assert command.invoke_without_command or not words, words
        else:
            inner = command.get_command(context, words[named])
            accept(inner, words[named], words[named + 1 :], context)


def commands(*, whole: bool) -> dict[tuple[str, ...], str]:
    """Return the commands without a placeholder, each with a page: `whole` ones in blocks, or those within sentences."""
    pages: dict[tuple[str, ...], str] = {}
    for page, path in PAGES.items():
        text = _FENCED.sub("\n", path.read_text(encoding="utf-8"))
        lines = [line for block in typed(page) for line in block.lines] if whole else _INLINE.findall(text)
        for line in lines:
            pages |= {tuple(call): page for call in calls(line) if not _PLACEHOLDER.search(" ".join(call))}
    return pages


@pytest.mark.parametrize(("whole", "least"), [(True, 60), (False, 80)], ids=["blocks", "sentences"])
def test_every_command_has_the_options_that_the_pages_show(whole, least):
    """A sentence may leave out arguments and values."""
    wrong = []
    named = commands(whole=whole)
    for (program, *words), page in named.items():
        if words == ["--install-completion"]:  # parsing it installs it
            continue
        try:
            accept(typer.main.get_command(APPS[program].build_app(words)), program, words)
        except typer.Exit:  # `--list` prints and exits
            pass
        except Exception as error:  # noqa: BLE001 (which library defines it depends on typer's version)
            incomplete = type(error).__name__ in ("MissingParameter", "NoArgsIsHelpError")
            left_out = incomplete or "requires an argument" in str(error)
            if whole or not left_out:
                wrong.append((page, program, words, str(error)))
    assert wrong == []
    assert len(named) > least


def test_the_readme_types_no_file_that_its_reader_lacks():
    """What a command reads, an earlier one has written."""
    made: set[str] = set()
    lacking, read = [], 0
    for call in (call for block in typed("README.md") for line in block.lines for call in calls(line)):
        for option, word in pairwise(call):
            if not re.search(r"\.(?:png|jpe?g|tiff?|fits|toml|csv|mcap)$", word):
                continue
            if option in ("-o", "--html", "--junit", "--record"):
                made.add(word)
            else:
                read += 1
                lacking += [call] if word not in made else []
    assert lacking == []
    assert read >= 3


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Work in a folder with the files that the pages name."""
    monkeypatch.chdir(tmp_path)
    for page, path in PAGES.items():
        write_all(files_of(page, "toml"), tmp_path)
        for _language, text in _FENCED.findall(path.read_text(encoding="utf-8")):
            if text.startswith("CCSDS_AEM_VERS"):
                (tmp_path / "slew.aem").write_text(text, encoding="utf-8")
            if text.startswith('title = "Quick check"'):
                (tmp_path / "my_session.toml").write_text(text, encoding="utf-8")
    (tmp_path / "acquiring.toml").write_text(
        'extends = "ideal"\n[parameters]\nstart_mode = "lost_in_space"\n'
    )
    for profile in ("cubestar", "ideal"):
        (tmp_path / f"{profile}_quick.toml").write_text(f'extends = "{profile}"\n{NO_IMAGES_TABLES}')
    (tmp_path / "lens.toml").write_text('extends = "ideal"\n')  # as `starid calibrate` writes it
    written(tmp_path / "lynx")
    assert run_command_line("unit", "new", "my_unit")[0] == 0
    return tmp_path


def test_every_start_of_an_emulator_is_accepted(folder, monkeypatch):
    """Its files, keys and combinations of options are valid; no emulator is made."""
    accepted = []

    async def serve(make):
        accepted.append(make)
        return 0

    monkeypatch.setattr("starhil.emulator.cli.run.serve", serve)
    monkeypatch.setattr("starhil.emulator.sensor.pipeline.worker_process.take_worker", lambda: None)
    blocks = [block for page in PAGES for block in typed(page)]
    starts = {
        tuple(call[1:]): block.page
        for block in blocks
        for line in block.lines
        for call in calls(line)
        if call[:2] == ["starhil", "run"] and "…" not in line
    }
    wrong = [
        (page, words, said)
        for words, page in starts.items()
        for status, _, said in [run_command_line(*words)]
        if status != 0
    ]
    assert wrong == []
    assert len(accepted) == len(starts) > 20


class Shell:
    """Types lines: `starhil run` starts an emulator in the background, which the next one ends; all emulators render no images."""

    def __init__(self, stack: contextlib.ExitStack, instead: dict[str, str]) -> None:
        self._emulators = stack.enter_context(contextlib.ExitStack())
        self.instead = instead
        """Texts of the pages that stand for others here."""
        self.ready: dict[str, str] = {}
        """The ready line of the emulator."""

    def type(self, line: str, statuses: tuple[int, ...] = (0,)) -> str:
        """Type a line; return what it prints, of an emulator nothing."""
        for shown, actual in self.instead.items():
            line = line.replace(shown, actual)
        words = shlex.split(line, comments=True)
        if words[:2] == ["starhil", "run"]:
            self.end()
            command = [installed_command(), *words[1:], *NO_IMAGES_OPTIONS]
            self._process = self._emulators.enter_context(EmulatorProcess(command))
            self.ready = self._process.ready
            return ""
        if words[:2] == ["starhil", "session"] and "--start" in words and "--profile" not in words:
            words += ["--profile", f"{'cubestar' if words[2] == 'first_light' else 'ideal'}_quick.toml"]
        if words[0] in APPS:
            status, out, stderr = run_command_line(*words[1:], program=words[0])
        else:
            path = f"{Path(installed_command()).parent}:{os.environ['PATH']}"
            done = subprocess.run(
                ["bash", "-c", line],
                capture_output=True,
                text=True,
                timeout=PATIENCE_S,
                check=False,
                env={**os.environ, "PATH": path},
            )
            status, out, stderr = done.returncode, done.stdout, done.stderr
        assert status in statuses, (line, out, stderr)
        return out

    def end(self) -> None:
        """End the emulator, as Ctrl-C does."""
        self._emulators.close()

    def ended(self) -> None:
        """Wait for the end of an emulator that a request ends."""
        assert self._process.process.wait(timeout=PATIENCE_S) == 0
        self._process.kill()


@pytest.fixture
def shell(folder):
    """A shell in the folder, with ports and buses of its own."""
    with contextlib.ExitStack() as stack, socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
        probe.close()
        instead = {
            "/tmp/": f"{folder}/",
            "127.0.0.1:7700": f"127.0.0.1:{port}",
            "127.0.0.1/7700": f"127.0.0.1/{port}",
        }
        yield Shell(stack, instead)


@pytest.mark.process
def test_the_sessions_of_the_readme_pass_and_test_an_emulator_that_runs(shell):
    first, second, third = lines_of("README.md", "starhil session first_light")
    for line in (first, second):
        assert " passed" in shell.type(line)
    assert Path("out/slew/junit.xml").exists()
    watch = lines_of("docs/console.md", "starhil run --view")[1]
    shell.instead |= {"127.0.0.1:8080": "127.0.0.1:0", "--can vcan0": "--can auto"}
    shell.type(watch)
    bus, view = shell.ready["can"], shell.ready["view"]
    shell.instead = {
        "/tmp/startracker": shell.ready["serial"],
        "--can vcan0": f"--can {bus}",
        "http://127.0.0.1:8080/?token=…": view,
    }
    assert " passed" in shell.type(third)
    session, _ = lines_of("docs/console.md", "starhil session my_session.toml")
    assert " passed" in shell.type(session)
    assert " passed" in shell.type(lines_of("docs/sessions.md", "starhil session first_light")[2])
    assert Path("out/mine/junit.xml").exists()


@pytest.mark.process
def test_faults_are_injected_from_bash(shell):
    start, *bash = lines_of("docs/fdir.md", "starhil run --control")
    shell.type(start)
    assert json.loads(shell.type("\n".join(bash)))["ok"] is True
    (status,) = lines_of("docs/control.md", "exec 3<>")
    assert json.loads(shell.type(status))["mode"] == "lost_in_space"


@pytest.mark.process
def test_a_unit_is_made_checked_and_run(shell):
    shutil.rmtree("my_unit")
    *commands, run = lines_of("docs/units.md", "starhil unit list")
    for line in commands:
        assert shell.type(line)
    shell.type(f"{run} --can off")
    assert shell.ready["unit"].endswith("my_unit")


@pytest.mark.process
@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
def test_the_way_from_an_icd_to_a_ci_job(shell, folder):
    """The files of the page, the commands that it types, and what its job runs, but for what installs packages."""
    page = "docs/from-icd-to-ci.md"
    new, *commands = (line for block in shell_blocks(page) for line in block)
    files = files_of(page, "toml", "c", "python", "yaml")
    job = re.findall(
        r"^ +- run: ((?!pip|python).*)$", files[".github/workflows/star-tracker.yml"], re.MULTILINE
    )
    assert set(commands) - set(job) == {"starhil unit check heron"}
    shutil.rmtree("heron")
    shell.type(new)
    write_all(files | {"heron.toml": f"{files['heron.toml']}\n{NO_IMAGES_TABLES}"}, folder)
    shell.type("starhil unit check heron")
    printed = [shell.type(line) for line in job]
    assert [line.split()[0] for line in job] == ["starhil", "mkdir", "starhil", "starhil", "pytest"]
    assert " 0 failed" in printed[2]
    assert "3 passed, 0 failed" in printed[3]
    assert "3 passed" in printed[4]
    assert {path.name for path in Path("out").glob("*.xml")} == {
        "conformance.xml",
        "session.xml",
        "pytest.xml",
    }


@pytest.mark.process
def test_a_recording_is_replayed_changed_and_with_another_profile(shell):
    shell.type(lines_of("docs/simulators.md", "starhil run --record")[0])
    with ObcClient.open(serial=shell.ready["serial"], timeout_s=PATIENCE_S) as obc:
        exposure = obc.get_parameter("exposure")
    shell.end()
    assert "entries played: identical" in shell.type(
        lines_of("docs/simulators.md", "starhil replay recorded$")[0]
    )
    changed, other = lines_of("docs/simulators.md", "starhil replay recorded --set")
    shell.type(changed, (1,))
    rows = csv.DictReader(Path("differences.csv").read_text().splitlines())
    assert ("parameter", "value", str(float(exposure)), "150.0") in {
        (row["row"], row["field"], row["recorded"], row["now"]) for row in rows
    }
    shell.type(other, (0, 1))
    Path("recordings").mkdir()
    Path("recorded").rename("recordings/recorded")
    shell.type(lines_of("docs/simulators.md", "for session in")[0])


@pytest.mark.process
def test_the_attitudes_of_a_file_are_run_and_converted(shell):
    shell.type(lines_of("docs/truth-files.md", "starhil run ideal")[0])
    ((program, printed),) = programs("truth-files.md")
    text = program.text.replace("/tmp/starhil-control", shell.ready["control"].removeprefix("unix:"))
    assert run(replace(program, text=text), {}) == printed
    shell.ended()
    for line in lines_of("docs/truth-files.md", "starhil truth convert"):
        if "-44007" not in line or find_spec("spiceypy") is not None:
            shell.type(line)
    assert {"true.aem", "measured.aem"} <= {path.name for path in Path().iterdir()}


@pytest.mark.process
def test_a_low_orbit_is_rendered_run_and_read(shell):
    render, run_, cut = lines_of("docs/sky.md", "starhil render --profile leo.toml")
    (corrected,) = lines_of(
        "docs/sky.md", "timeout -s INT 30 starhil run leo.toml --serial off --can off --truth-log corr"
    )
    shell.type(render)
    assert Path("leo.png").read_bytes().startswith(b"\x89PNG")
    for line, log in ((run_, "uncorrected.csv"), (corrected, "corrected.csv")):
        for seconds in (12, 60, 300):  # a slow machine has not started within the first
            Path(log).unlink(missing_ok=True)
            limited = line.replace("INT 30", f"INT {seconds}")
            shell.type(f"{limited} --clock scaled:4 {' '.join(NO_IMAGES_OPTIONS)}", (0, 124))
            if Path(log).exists() and Path(log).stat().st_size > 1000:
                break
    head, *rows = shell.type(cut).splitlines()
    assert head == "frame,valid,total_arcsec"
    assert rows
    assert Path("corrected.csv").stat().st_size > 1000
