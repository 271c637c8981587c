"""`unit check` finds all errors at once; a plugin is a file beside the definition and cannot spoil the check."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

from starhil.emulator.cli.app import build_app
from starhil.protocol.errors import IcdError
from starhil.protocol.icd.device_model import device_model
from starhil.protocol.unit import load_unit
from starhil.protocol.unit.examples import examine

HEAD = '[unit]\nname = "x"\nversion = "1"\ndoc = "x"\n'
ROW = '[[telemetry]]\nid = 1\nname = "row"\ndoc = "x"\nprovenance = "ours"\n'
CUSTOM = """
[link.serial]
framing = { kind = "custom", name = "lines" }
check = { kind = "custom", name = "parity" }
request_header = [{ role = "id", type = "u8" }]
reply_header = [{ role = "id", type = "u8" }]
"""
LINK = '[link.can]\nkind = "cubespace"\n'
PLUGIN = '''
from functools import reduce
from operator import xor

from starhil.protocol.serial.framings import Deframer, Delimited, Framing, Receiving
from starhil.protocol.icd.link_schema import DelimitedFraming
from starhil.protocol.plugin import action, check, framing, quantity


@quantity("seven")
def seven(snapshot):
    return 7


@action("blink")
def blink(device, arguments):
    return None


@check("parity")
def parity(covered):
    return bytes((reduce(xor, covered, 0),))


@framing("lines")
class Lines(Framing):
    """Hexadecimal digits on a line."""

    def __init__(self):
        self.lines = Delimited(DelimitedFraming(kind="delimited", end=[10], encoding="hex"))

    def encode(self, body):
        return self.lines.encode(body)

    def deframer(self, receiving):
        return self.lines.deframer(receiving)
'''
ROWS = """
[[telecommand]]
id = 2
name = "command"
doc = "x"
provenance = "ours"
action = "blink"

[[telemetry]]
id = 1
name = "row"
doc = "x"
provenance = "ours"
fields = [{ name = "a", type = "u8", value = "seven" }]
"""


def written(
    folder: Path, plugin: str | None = PLUGIN, name: str = "unit.py", text: str = CUSTOM + ROWS
) -> Path:
    """Write a unit with a plugin."""
    (folder / "unit.toml").write_text(HEAD + f'plugin = "{name}"\n' + text, encoding="utf-8")
    if plugin is not None:
        (folder / "unit.py").write_text(plugin, encoding="utf-8")
    return folder


def unit_check(*words: object) -> tuple[int, str]:
    """Return exit status and output of `unit check`."""
    result = CliRunner().invoke(build_app(["unit"]), ["unit", "check", *map(str, words)])
    assert result.exception is None or isinstance(result.exception, SystemExit)
    return result.exit_code, result.output


# -- plugins -----------------------------------------------------------------------------------------------------------


def test_a_framing_and_a_check_of_a_plugin_are_used(tmp_path: Path) -> None:
    code, said = unit_check(written(tmp_path))
    assert code == 0, said
    assert "> 0202" not in said
    assert "  > 30 32 30 32 0A\n" in said  # 02, and its parity 02, as digits


FAILING = {
    "raise ZeroDivisionError": ("1 / 0\n", "ZeroDivisionError: division by zero"),
    "exit 0": ("import sys\nsys.exit(0)\n", "SystemExit: 0"),
    "exit": ("raise SystemExit\n", "SystemExit"),
    "generator exit": ("raise GeneratorExit\n", "GeneratorExit"),
    "own base": ("class E(BaseException): pass\nraise E('a\\nb')\n", "E: a b"),
    "syntax": ("def f(:\n", "SyntaxError"),
    "file not found": ("open('/no/such/file')\n", "FileNotFoundError"),
    "null": ("a\0b\n", "Error: source code string cannot contain null bytes"),
    "check raises": (PLUGIN.replace("return bytes((reduce", "raise SystemExit((reduce"), "plugin fails in check parity: SystemExit: (0,)"),
    "check of no bytes": (PLUGIN.replace("return bytes((reduce(xor, covered, 0),))", "return 3"), "check parity must return bytes, not int"),
    "framing constructor": (PLUGIN.replace("self.lines = ", "self.lines = 1 / 0 or "), "fails in framing lines: ZeroDivisionError"),
    "framing encode": (PLUGIN.replace("self.lines.encode(body)", "exit(0)"), "fails in framing lines: SystemExit: 0"),
    "framing deframer": (PLUGIN.replace("self.lines.deframer(receiving)", "None"), "framing lines must make a Deframer, not NoneType"),
    "framing that loses": (PLUGIN.replace("encode(body)", "encode(body[:-1])", 2), "framing lines does not return"),
    "framing of no framing": (PLUGIN.replace("class Lines(Framing)", "class Lines"), "framing lines must be a class derived from starhil.protocol.serial.framings.Framing"),
    "framing of text": (PLUGIN.replace("return self.lines.encode(body)", "return 'a'"), "framing lines must encode to bytes, not str"),
    "framing that is a function": (PLUGIN + "\n\n@framing('lines')\ndef lines():\n    return 1\n", "framing lines must be a class derived from"),
}  # fmt: skip


@pytest.mark.parametrize(("source", "message"), FAILING.values(), ids=FAILING)
def test_a_plugin_that_fails_is_one_line_and_status_1(tmp_path: Path, source: str, message: str) -> None:
    code, output = unit_check(written(tmp_path, source.replace("encode(body[:-1]):", "encode(self, body):")))
    assert code == 1
    assert message in output
    assert "Traceback" not in output
    assert sum(message in line for line in output.splitlines()) == 1


@pytest.mark.parametrize(
    ("source", "message"),
    [
        (
            "snapshot.frame.result.matched",
            "quantity seven without a frame: AttributeError: 'NoneType' object",
        ),
        (
            "0 if snapshot.frame is None else snapshot.frame.stars",
            "quantity seven with an attitude: AttributeError",
        ),
        ("'seven'", "row.a: 'seven' is not a number"),
        ("len(snapshot.stars) + 300", ""),
        ("None", ""),
    ],
)
def test_each_quantity_of_a_plugin_is_called(tmp_path: Path, source: str, message: str) -> None:
    folder = written(tmp_path, PLUGIN.replace("return 7", f"return {source}"))
    code, said = unit_check(folder)
    assert (code, message in said) == (int(bool(message)), True), said
    assert unit_check("--no-plugin", folder)[0] == 0


def test_a_framing_without_its_methods_is_one_line(tmp_path: Path) -> None:
    code, said = unit_check(written(tmp_path, PLUGIN.replace("def encode", "def code")))
    assert (code, "fails in framing lines: TypeError: Can't instantiate abstract class Lines" in said) == (
        1,
        True,
    )


def test_an_interrupted_check_stops(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        load_unit(written(tmp_path, "raise KeyboardInterrupt\n"))


def elsewhere(folder: Path, place: str) -> str:
    """Put a plugin where it may not be, and return its name in the definition."""
    outside = folder.parent / "outside.py"
    outside.write_text("raise AssertionError('ran')\n", encoding="utf-8")
    (folder / "sub").mkdir()
    (folder / "sub" / "unit.py").write_text(outside.read_text(encoding="utf-8"), encoding="utf-8")
    (folder / "link.py").symlink_to(outside)
    (folder / "linked").symlink_to(folder.parent)
    return {"absolute": str(outside)}.get(place, place)


@pytest.mark.parametrize(
    "place",
    ["../outside.py", "absolute", "sub/unit.py", "sub/../unit.py", "linked/outside.py", "link.py", ".", "..", ""],
)  # fmt: skip
def test_a_plugin_is_a_file_beside_the_definition(tmp_path: Path, place: str) -> None:
    folder = tmp_path / "unit"
    folder.mkdir()
    name = elsewhere(folder, place)
    (folder / "unit.toml").write_text(HEAD + f'plugin = "{name}"\n' + ROW, encoding="utf-8")
    with pytest.raises(IcdError, match=r"unit\.toml: unit\.plugin: .* a file beside the definition"):
        load_unit(folder)


def test_a_plugin_that_is_a_loop_of_links_cannot_be_read(tmp_path: Path) -> None:
    folder = written(tmp_path, plugin=None)
    (folder / "unit.py").symlink_to("unit.py")
    with pytest.raises(IcdError, match=r"unit\.py: cannot be read: Too many levels of symbolic links"):
        load_unit(folder)


def test_a_link_to_a_plugin_beside_the_definition_and_a_link_to_the_unit_are_followed(tmp_path: Path) -> None:
    folder = tmp_path / "unit"
    folder.mkdir()
    written(folder, name="link.py")
    (folder / "link.py").symlink_to("unit.py")
    (tmp_path / "alias").symlink_to("unit")
    assert examine(tmp_path / "alias")[1] == []


def test_a_pipe_or_a_folder_as_plugin_is_rejected_at_once(tmp_path: Path) -> None:
    folder = written(tmp_path, plugin=None)
    os.mkfifo(folder / "unit.py")
    assert "unit.py: cannot be read: not a regular file" in examine(folder)[1][0]
    (folder / "unit.py").unlink()
    (folder / "unit.py").mkdir()
    assert "unit.py: cannot be read: Is a directory" in examine(folder)[1][0]


def test_without_the_plugin_nothing_of_it_runs_and_the_rest_is_checked(tmp_path: Path) -> None:
    folder = written(tmp_path, "raise AssertionError('ran')\n")
    code, output = unit_check(folder, "--no-plugin")
    assert code == 0, output
    assert "unit.py was not run: its names, and examples on its link, are not checked" in output
    (folder / "more.toml").write_text(
        ROW.replace("row", "other").replace("1", "3") + 'fields = ["u9 a"]\n', encoding="utf-8"
    )
    code, output = unit_check(folder, "--no-plugin")
    assert code == 1
    assert "telemetry other: field 'u9 a': type" in output


# -- all errors at once ------------------------------------------------------------------------------------------------

MANY = {
    "unit.toml": HEAD
    + """
[conventions]
epoch = "y2k"

[[class]]
name = "get"
kind = "telemetry"
code = 1

[[class]]
name = "set"
kind = "telecommand"
code = 1

[errors]
bad_id = 1

[link.serial]
framing = { kind = "length" }
request_header = [{ role = "id", type = "u8" }]
reply_header = []

[[parameter]]
id = 1
name = "exposur"
""",
    "rows.toml": """
[[telemetry]]
id = 1
name = "one"
doc = "x"
provenance = "ours"
sise = 3
fields = [
    { name = "a", type = "u9", value = "mode" },
    { name = "b", type = "u8", value = "uptim" },
    { name = "c", type = "u8", scal = 2, value = "stars.match" },
    { name = "d", type = "bytes", value = "stars.matched" },
    { name = "e", type = "u8" },
]

[[telemetry]]
id = "two"
name = "two"
doc = "x"
fields = []

[[telemetry]]
id = 3
name = "three"
doc = "x"
provenance = "ours"
include = ["one", "two", "four"]

[[telecommand]]
id = 4
name = "five"
doc = "x"
provenance = "ours"
action = "set_clok"

[[telecommand]]
id = 5
name = "six"
doc = "x"
provenance = "ours"
action = "set_mode"
fields = [{ name = "a", type = "u8", min = 3, default = 1, doc = "x" }]

[[telecommand]]
id = 6
name = "seven"
doc = "x"
provenance = "ours"
fields = [{ name = "a", type = "enum8", enum = "broken" }]

[[enum]]
name = "broken"
doc = "x"
values = {}
""",
    "torn.toml": "[[telemetry\n",
    "canopen.toml": "[canopen]\nvendor_id = -1\n",
}
SAID = [
    "unit.toml: conventions.epoch: 'y2k'", "unit.toml: class set: code 1", "unit.toml: errors.bad_id", "unit.toml: parameter exposur",
    "unit.toml: link.serial.request_header: framing length needs", "rows.toml: telemetry.one.sise: unknown key; did you mean size",
    "rows.toml: telemetry.one.fields.a.type", "telemetry one: field b: no quantity named 'uptim'", "fields.c.scal: unknown key",
    "telemetry one: field c: no quantity named 'stars.match'", "telemetry one: field d: type bytes needs a size",
    "telemetry one: field e: no `value`", "rows.toml: telemetry.two.id", "telecommand five: no action named 'set_clok'",
    "telecommand six: action set_mode needs the argument mode", "six: example: six.a: 1 is outside", "telecommand seven: no `action`",
    "rows.toml: enum.broken.values", "torn.toml: not valid TOML", "canopen.toml: canopen.device_type: missing",
    "canopen.toml: canopen.vendor_id",
]  # fmt: skip


def test_all_errors_of_all_stages_are_listed_at_once(tmp_path: Path) -> None:
    for name, text in MANY.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    problems = examine(tmp_path)[1]
    assert [message for message in SAID if not any(message in text for text in problems)] == []
    assert len(set(problems)) == len(problems)
    assert not any("\n" in text for text in problems)
    # nothing is said only because something else is broken: `four` may be in the torn file, `two` and `broken` are wrong themselves
    assert [
        text
        for text in problems
        if "'four'" in text or "'two'" in text.partition("(given")[0] or "'broken'" in text or "three" in text
    ] == []
    others = [text for text in problems if not any(message in text for message in SAID)]
    assert [text for text in others if "canopen" not in text] == []


def test_a_name_that_no_file_can_define_is_missing(tmp_path: Path) -> None:
    (tmp_path / "unit.toml").write_text(HEAD + ROW + 'include = ["four"]\n', encoding="utf-8")
    assert examine(tmp_path)[1] == [f"{tmp_path}/unit.toml: telemetry row: include: no row named 'four'"]


def test_a_wrong_unit_table_hides_no_other_error(tmp_path: Path) -> None:
    text = HEAD.replace('"1"', "1") + ROW.replace('provenance = "ours"\n', "") + 'fields = ["u9 a"]\n'
    (tmp_path / "unit.toml").write_text(text, encoding="utf-8")
    version, field = examine(tmp_path)[1]
    assert "unit.version: must be a text" in version
    assert "field 'u9 a': type" in field


def test_a_row_needs_no_list_of_fields(tmp_path: Path) -> None:
    row = '[[telecommand]]\nid = 1\nname = "row"\ndoc = "x"\nprovenance = "ours"\naction = "nothing"\n'
    (tmp_path / "unit.toml").write_text(HEAD + row, encoding="utf-8")
    assert examine(tmp_path)[1] == []
    assert load_unit(tmp_path).telecommands["row"].size == 0


# -- the wording of single errors --------------------------------------------------------------------------------------

SLIP = """
[link.serial]
framing = { kind = "slip", KEYS }
request_header = [{ role = "id", type = "u8" }]
reply_header = [{ role = "id", type = "u8" }]
"""
FIELDS = 'fields = [{ name = "error", type = "u8", value = "stars.matched" }]\n'


def said_of(folder: Path, text: str) -> list[str]:
    (folder / "unit.toml").write_text(HEAD + text, encoding="utf-8")
    return [line.removeprefix(f"{folder}/unit.toml: ") for line in examine(folder)[1]]


def test_of_two_types_only_the_one_that_is_given_is_said_to_be_wrong(tmp_path: Path) -> None:
    (said,) = said_of(tmp_path, ROW + FIELDS + 'unsolicited = ["valid"]\n')
    assert said.startswith("telemetry.row.unsolicited.0: must be one of 'start', ")
    assert said.endswith("(given: 'valid'); did you mean validity?")


def test_an_unknown_kind_is_suggested(tmp_path: Path) -> None:
    text = SLIP.replace("KEYS", "end = 0xC0").replace(
        "request_header", 'check = { kind = "fletcher" }\nrequest_header'
    )
    (said,) = said_of(tmp_path, ROW + FIELDS + text)
    assert said.endswith("(given: 'fletcher'); did you mean fletcher16?")


def test_an_unknown_parameter_is_named_beside_a_limit_that_does_not_fit(tmp_path: Path) -> None:
    field = 'fields = [{ name = "a", type = "u16", scale = 0.1, max = 50000, parameter = "exposur" }]\n'
    assert said_of(tmp_path, ROW + field) == [
        "telemetry row: field a: no parameter named 'exposur'; did you mean exposure?",
        "telemetry row: field a: max 50000 does not fit type u16 with its scale",
    ]


@pytest.mark.parametrize(
    "keys", ["end = 0xDB", "substitutes = [0xDB, 0xDD]", "substitutes = [0xDC, 0xDB]", "xor = 0x1B"]
)
def test_bytes_of_slip_that_are_equal_are_rejected(tmp_path: Path, keys: str) -> None:
    (said,) = said_of(tmp_path, ROW + FIELDS + SLIP.replace("KEYS", keys))
    assert said.endswith("link.serial.framing: end, escape and substitutes must differ")


@pytest.mark.parametrize("fault", ["size = 7\n", 'unsolicited = ["valid"]\n', "sice = 1\n"])
def test_a_duplicate_id_is_reported_beside_another_error_of_its_row(tmp_path: Path, fault: str) -> None:
    other = ROW.replace('"row"', '"other"') + FIELDS
    said = said_of(tmp_path, other + ROW + FIELDS + fault)
    assert len(said) == 2
    assert said[1] == "telemetry row: ID 1 is already used by other"


def test_a_value_that_a_map_lacks_is_reported_as_the_one_that_stands_for_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = device_model()
    mode = model.enums["mode"]
    numbers = {**mode.values, "survey": 1 + max(mode.values.values())}
    original = mode.model_copy(update={"values": numbers, "instead": {**mode.instead, "survey": "standby"}})
    newer = replace(model, enums={**model.enums, "mode": original})
    monkeypatch.setattr("starhil.protocol.icd.definition.device_model", lambda: newer)
    members = '"1" = ["boot", "standby"], "2" = "lost_in_space", "3" = "tracking", "9" = "error"'
    field = f'{{ name = "mode", type = "u8", value = "mode", map = {{ {members} }} }}'
    (tmp_path / "x.toml").write_text(
        f"{HEAD}{LINK}{ROW}fields = [{field}]\n".replace("id = 1\n", "id = 130\n"), encoding="utf-8"
    )
    row = load_unit(tmp_path).telemetry["row"]
    assert row.named_fields["mode"].aliases.items() >= {"standby": "boot", "survey": "boot"}.items()
    del original.instead["survey"]
    with pytest.raises(IcdError, match="no number for survey"):
        load_unit(tmp_path)
