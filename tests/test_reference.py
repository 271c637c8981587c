"""The reference pages have the keys that the code accepts, and their examples work."""

from __future__ import annotations

import json
import re
import socket
from pathlib import Path

import pytest

from starhil.emulator.cli import reference
from starhil.emulator.control.scenario import load_scenario
from starhil.emulator.profile import load_profile
from starhil.hil_tests.errors import ScriptError
from starhil.hil_tests.rig.emulator_process import EmulatorProcess, emulator_command
from starhil.hil_tests.session.script import load_script
from starhil.protocol.export import export
from starhil.protocol.unit import load_unit
from tests.emulator.cli.command_line import run_command_line
from tests.process.conftest import NO_IMAGES
from tests.waiting import PATIENCE_S

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"

WHOLE_ACTIONS = {
    "control": "control = 'fault'",
    "command": 'command = "reset"',
    "read": 'read = "identification"',
    "listen": 'listen = "quaternion"',
    "sample": 'sample = "quaternion"\nevery_s = 1\nfor_s = 1',
    "set_parameter": 'set_parameter = "exposure"\nvalue = 100',
    "get_parameter": 'get_parameter = "exposure"',
    "download_image": 'download_image = "image.png"',
    "send": 'send = "00"',
    "wait_s": "wait_s = 1",
    "restart": 'restart = "term"',
}
"""A step of each action, without the keys that may be left out."""


def test_the_tables_of_the_reference_pages_match_the_code():
    pages = [page for page in DOCS.glob("*.md") if reference.BLOCK.search(page.read_text(encoding="utf-8"))]
    assert {"cli.md", "control.md", "profile.md"} <= {page.name for page in pages}
    for page in pages:
        text = page.read_text(encoding="utf-8")
        assert text == reference.with_tables(text), (
            f"{page.name} is out of date; run: python tools/make_reference.py"
        )


def test_every_table_that_can_be_written_stands_on_a_page():
    text = "".join(page.read_text(encoding="utf-8") for page in DOCS.glob("*.md"))
    assert set(re.findall(r"<!-- (?:begin|built): (\w+)", text, re.MULTILINE)) == set(reference.TABLES)


@pytest.mark.parametrize(
    ("page", "entries"),
    [
        ("cli", ["| `--truth-log` |", "starid identify [options] IMAGE"]),
        ("quantities", ["| `attitude.sigma_cross` |", "| `set_clock` |", "| `exposure` |", "### `Snapshot`"]),
        ("units", ["| `scalar_sign` |", '### `check = { kind = "crc" }`']),
    ],
)
def test_starhil_docs_prints_the_tables_that_the_files_lack(page, entries):
    status, printed, said = run_command_line("docs", page)
    assert (status, said) == (0, "")
    assert [entry for entry in entries if entry not in printed] == []
    assert "<!-- built" not in printed


@pytest.mark.parametrize(
    ("words", "unit"),
    [(["icd"], "cubestar"), (["icd", "st16"], "st16"), (["docs/icd/sagitta.md"], "sagitta")],
)
def test_starhil_docs_prints_the_interface_definition_of_a_unit(words, unit):
    assert run_command_line("docs", *words) == (0, export(load_unit(unit), "markdown"), "")
    assert f"icd/{unit}" in run_command_line("docs")[1].split()


@pytest.mark.parametrize(
    "page",
    [*sorted(DOCS.glob("*.md")), ROOT / "README.md", ROOT / "CONTRIBUTING.md"],
    ids=lambda page: page.name,
)
def test_every_file_that_a_page_names_exists(page):
    text = page.read_text(encoding="utf-8")
    folders = "starid|emulator|protocol|hil_tests|configs|tools|tests|docs"
    named = set(re.findall(rf"`((?:{folders})/[\w./*-]+)`", text))
    missing = {name for name in named if not any(ROOT.glob(name.rstrip("/")))}
    assert not missing


# --- session scripts ---


def keys_accepted(folder: Path, script: str) -> set[str]:
    """Keys that are known where the script has the key `no_such_key`, as its rejection lists them."""
    path = folder / "script.toml"
    path.write_text(script, encoding="utf-8")
    with pytest.raises(ScriptError, match="no_such_key: unknown key") as rejection:
        load_script(path, load_unit())
    (found,) = (text for text in rejection.value.args if "no_such_key" in text)
    return set(found.partition("; known: ")[2].split(", "))


def rows_under(heading: str) -> list[list[str]]:
    """Rows of all tables of sessions.md under a heading, by cells, without their heads."""
    text = (DOCS / "sessions.md").read_text(encoding="utf-8")
    section = re.split(rf"^##+ {re.escape(heading)}$", text, flags=re.MULTILINE)[1]
    section = re.split(r"^##+ ", section, flags=re.MULTILINE)[0]
    tables = re.findall(r"^\|(?:-+\|)+\n((?:\|.*\n)+)", section, re.MULTILINE)
    return [
        [cell.strip() for cell in line.strip("|").split("|")]
        for table in tables
        for line in table.splitlines()
    ]


def keys_shown(heading: str) -> set[str]:
    """Keys in the first column under a heading."""
    shown = re.findall(r"`\[*(\w+)\]*`", " ".join(row[0] for row in rows_under(heading)))
    return set(shown)


@pytest.mark.parametrize(
    ("heading", "script"),
    [
        ("The script as a whole", "no_such_key = 1\n[[step]]\nwait_s = 1"),
        ("Keys of `[emulator]`", "[emulator]\nno_such_key = 1\n[[step]]\nwait_s = 1"),
        ("Keys of `[truth]`", "[truth]\nno_such_key = 1\n[[step]]\nwait_s = 1"),
        ("Keys of `[defaults]`", "[defaults]\nno_such_key = 1\n[[step]]\nwait_s = 1"),
        ("Expectations", '[[step]]\nread = "quaternion"\nexpect = { q_x = { no_such_key = 1 } }'),
        ("Attitudes", '[[step]]\nread = "quaternion"\nattitude = { no_such_key = 1 }'),
    ],
)
def test_sessions_has_the_keys_that_scripts_may_have(heading, script, tmp_path):
    assert keys_shown(heading) == keys_accepted(tmp_path, script)


def test_sessions_has_every_action(tmp_path):
    path = tmp_path / "script.toml"
    path.write_text('[[step]]\nname = "nothing"', encoding="utf-8")
    with pytest.raises(ScriptError) as rejection:
        load_script(path, load_unit())
    actions = set(re.search(r"exactly one action of (.*);", str(rejection.value))[1].split(", "))
    shown = [re.match(r"`(\w+) =", row[0]) for row in rows_under("Actions")]
    assert {match[1] for match in shown if match} == actions == set(WHOLE_ACTIONS)


@pytest.mark.parametrize("action", WHOLE_ACTIONS)
def test_sessions_has_the_keys_of_each_action(action, tmp_path):
    shown = {
        re.search(r"`(\w+)`", row[1])[1]
        for row in rows_under("Actions")
        if action in re.findall(r"`(\w+)`", row[0]) and len(row) == 4
    }
    everywhere = keys_shown("Keys of every step")
    accepted = keys_accepted(tmp_path, f"[[step]]\n{WHOLE_ACTIONS[action]}\nno_such_key = 1")
    assert shown | everywhere | {action} == accepted


def test_sessions_gives_the_defaults_of_a_step(tmp_path):
    path = tmp_path / "script.toml"
    path.write_text('[[step]]\nread = "quaternion"', encoding="utf-8")
    script = load_script(path, load_unit())
    shown = {row[0].strip("`"): row[1] for row in rows_under("Keys of every step")}
    for key in ("every_s", "repeat", "retries"):
        assert float(shown[key]) == getattr(script.steps[0], key)
    shown = {row[0].strip("`"): row[1] for row in rows_under("Keys of `[defaults]`")}
    assert float(shown["timeout_s"]) == script.defaults.timeout_s
    assert float(shown["retries"]) == script.defaults.retries
    assert shown["keep_going"] == str(script.defaults.keep_going).lower()


# --- examples ---


def example(page: str, first_line: str) -> str:
    """Text of the TOML block of a page that begins with a line."""
    text = (DOCS / page).read_text(encoding="utf-8")
    (found,) = [
        block for block in re.findall(r"```toml\n(.*?)```", text, re.DOTALL) if block.startswith(first_line)
    ]
    return found


def test_the_example_of_a_profile_is_accepted(tmp_path):
    path = tmp_path / "my_unit.toml"
    path.write_text(example("profile.md", "# my_unit.toml"), encoding="utf-8")
    profile = load_profile(str(path))
    assert (profile.name, profile.camera.fov_deg, profile.camera.width) == ("my_unit", 20.0, 937)


def test_the_example_of_a_scenario_is_accepted(tmp_path):
    path = tmp_path / "glare.toml"
    path.write_text(example("control.md", "# glare.toml"), encoding="utf-8")
    assert [event.run_time_s for event in load_scenario(str(path)).at] == [20.0, 40.0]


@pytest.mark.process
def test_the_control_channel_answers_as_the_page_shows():
    text = (DOCS / "control.md").read_text(encoding="utf-8")
    pairs = re.findall(r"^→ (.*)\n← (.*)$", text, re.MULTILINE)
    assert len(pairs) == 2
    command = emulator_command(settings=NO_IMAGES, extra=["--control", "auto", "--clock", "stepped"])
    with EmulatorProcess(command) as emulator, socket.socket(socket.AF_UNIX) as channel:
        channel.settimeout(PATIENCE_S)
        channel.connect(emulator.ready["control"].removeprefix("unix:"))
        lines = channel.makefile("rw")
        for request, answer in pairs:
            lines.write(request + "\n")
            lines.flush()
            line = lines.readline().strip()
            begin, _, end = answer.partition("…")
            assert json.loads(line)["ok"] is json.loads(answer)["ok"]
            assert line.startswith(begin), line
            assert line.endswith(end), line
        lines.write("{}\n")
        lines.flush()
        known = json.loads(lines.readline())["error"].removeprefix("do: must be one of ").split(", ")
    rows = text.partition("| `do` |")[2].partition("\n\n")[0]
    assert re.findall(r"^\| `(\w+)`", rows, re.MULTILINE) == known
