"""Text and names that would end a comment, string or tag, or be executed, through every export."""

from __future__ import annotations

import ast
import importlib.util
import json
import re
import shutil
import subprocess
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree as ET

import canopen
import cantools
import pytest
from markdown_it import MarkdownIt

from starhil.protocol.errors import ProtocolError
from starhil.protocol.export import FOLDER_FORMATS, FORMATS, export, export_folder
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.icd.quoting import c_member
from starhil.protocol.unit import load_unit
from tests.protocol.export.c_driver import COMPILER

pytestmark = pytest.mark.long

HOSTILE = (
    "*/ int x; /*", "/*/ */*", "//", "??/", 'a"b', "it's", "back\\slash\\", "\\", "\\\\", "a\nb", "a\n*/\nb", "a\r\nimport os\r\n",
    "a\u2028import os\x0bb\x0cc\x85d", "\x01\x1b[31m", "]]>", "<![CDATA[", "<!--", "-->", "<script>alert(1)</script>",
    "</title><script>", '" onclick="alert(1)', "`<b>`", "`` <i> `", "`<u>", "[x](javascript:alert(1))", "![x](http://x.invalid/i)",
    "| a | b |", "# heading", "- item", "1. item", "```", "<%= `id` %>", "<%% %>", "<% system('id') -%>", "#{`id`}", "%{x} %s %n",
    "{0} {x} {{", "$(id)", "coding: bogus", "# -*- coding: bogus -*-", "__END__", "=begin\n", "a; b # c", "@MAX_MESSAGE@",
    "unit_x UNIT_x", "class", "int", "3digits", "12", "-1", "é ″ 漢 ☃ \U0001f6f0", "a\u202eb\u200bc", "\ufffe", "&amp; &", "~~a~~", " ", "",
)  # fmt: skip
IDS = [ascii(text) for text in HOSTILE]
LINK = '[link.serial]\nframing = { kind = "cubespace" }\n\n[link.can]\nkind = "cubespace"\n'
ROW = '[[{kind}]]\nid = {number}\nname = "{name}"\ndoc = ""\nprovenance = "ours"\nfields = [{fields}]\n'


def toml(text: str) -> str:
    """Return a text as a string of TOML."""
    return json.dumps(text, ensure_ascii="\U0001f6f0" not in text)


def definition(
    folder: Path, name: str = "unit", text: str = "", rows: str = "", objects: str = ""
) -> InterfaceDefinition:
    """A unit with a text wherever a definition holds free text."""
    quoted = toml(text)
    default = toml("".join(letter for letter in text if letter.isascii()))
    (folder / "unit.toml").write_text(
        f"""
[unit]
name = {toml(name)}
version = {quoted}
doc = {quoted}
source = {quoted}

{LINK}
[[section]]
heading = "Heading {quoted[1:-1]}"
paragraphs = [{quoted}, "a `code` {quoted[1:-1]}"]
columns = ["Column", {quoted}]
rows = [[{quoted}, "b"]]

[[enum]]
name = "level"
doc = {quoted}
values = {{ low = 1, high = 2 }}

[[parameter]]
id = 1
name = "exposure"
doc = {quoted}

[[telecommand]]
id = 1
name = "set_text"
doc = {quoted}
provenance = "confirmed"
source = {quoted}
fields = [
    {{ name = "text", type = "text", size = 40, default = {default}, doc = {quoted} }},
    {{ name = "level", type = "enum8", enum = "level", doc = {quoted} }},
    {{ name = "kind", type = "u8", map = {{ 1 = {quoted}, 2 = "other" }}, doc = {quoted} }},
]

[[telemetry]]
id = 200
name = "number"
doc = {quoted}
provenance = "ours"
fields = [
    {{ name = "number", type = "u16", unit = {quoted}, doc = {quoted}, const = 1 }},
    {{ name = "kind", type = "u8", map = {{ 1 = {quoted}, 2 = "other" }}, doc = {quoted} }},
    {{ type = "bits8", bits = [{{ name = "bit", doc = {quoted} }}, {{ width = 7 }}] }},
]
{rows}
[canopen]
device_type = 0
device_name = {quoted}
vendor_name = {quoted}
vendor_id = 0
product_code = 0
revision = 0
bit_rates = [125000]

[[canopen.object]]
index = 0x2000
name = "2000 {quoted[1:-1]}"
requests = true

[[canopen.object]]
index = 0x2001
name = "2001 {quoted[1:-1]}"
telemetry = "number"

[[canopen.object]]
index = 0x2002
name = "2002 {quoted[1:-1]}"
parameters = true
{objects}""",
        encoding="utf-8",
    )
    return load_unit(folder)


def compiled(files: dict[str, str], folder: Path) -> None:
    """Compile header and source as C, with the compiler's own macros."""
    for name, text in files.items():
        (folder / name).write_text(text, encoding="utf-8")
    if COMPILER is None:
        pytest.skip("no C compiler (cc, gcc or clang) here: the exported C is not compiled")
    source = next(name for name in files if name.endswith(".c"))
    compile_source(COMPILER, "-std=c99", source, folder)


def compile_source(compiler: str, standard: str, source: str, folder: Path) -> None:
    """Check the syntax of a source file with all warnings as errors."""
    command = [compiler, standard, "-Wall", "-Wextra", "-Werror", "-fsyntax-only", source]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert (done.stderr, done.returncode) == ("", 0)


def c(icd: InterfaceDefinition, folder: Path) -> None:
    files = dict(export_folder(icd, "c"))
    assert len(files) == 2
    assert all(re.fullmatch(r"[a-z]\w*\.[ch]", name, re.ASCII) for name in files)
    compiled(files, folder)


def config_words(line: str) -> list[str]:
    """Words of a line as the ConfigParser of COSMOS separates them."""
    return [
        found.strip() for found in re.findall(r"\"(?:[^\\\"]|\\.)*\"|'(?:[^\\']|\\.)*'|\S+", line, re.VERBOSE)
    ]


COUNTS = {"COMMAND": (4, 5), "TELEMETRY": (4, 5), "PARAMETER": (7, 11), "ITEM": (5, 8), "UNITS": (3, 3), "STATE": (3, 3),
          "APPEND_ID_PARAMETER": (8, 8), "APPEND_ID_ITEM": (6, 6), "APPEND_ITEM": (5, 6), "POLY_READ_CONVERSION": (3, 3)}  # fmt: skip
"""Fewest and most words of a line in a COSMOS definition, by keyword."""


def cosmos_text(text: str) -> None:
    text = text.replace("<%= target_name %>", "TARGET")
    assert "<%" not in text
    for line in text.split("\n"):
        if not line or line.startswith("#"):
            continue
        words = config_words(line)
        low, high = COUNTS[words[0]]
        assert low <= len(words) <= high, line
        assert all(len(word) > 1 for word in words if word.startswith('"'))


def cosmos(icd: InterfaceDefinition, folder: Path) -> None:
    text = export(icd, "cosmos")
    cosmos_text(text)
    if importlib.util.find_spec("openc3") is None:  # `make cosmos` has it
        return
    config = importlib.import_module("openc3.packets.packet_config").PacketConfig()
    (folder / "cosmos.txt").write_text(text, encoding="utf-8")
    config.process_file(str(folder / "cosmos.txt"), "STARHIL")
    assert config.warnings == []
    assert config.commands["STARHIL"].keys() == {"SET_TEXT", "REQUEST_NUMBER"}


def ruby(text: str) -> str:
    """Leave of Ruby what is outside of its single-quoted strings, in which only \\\\ and \\' are escapes."""
    return re.sub(r"'(?:[^'\\]|\\.)*'", "''", text)


def cosmos_plugin(icd: InterfaceDefinition, folder: Path) -> None:
    files = export_folder(icd, "cosmos-plugin")
    plain = ruby(next(text for path, text in files.items() if path.endswith(".gemspec")))
    calm = definition(folder)
    assert plain == ruby(
        next(text for path, text in export_folder(calm, "cosmos-plugin").items() if path.endswith(".gemspec"))
    )
    for path, text in files.items():
        assert re.fullmatch(r"[\w./-]+", path, re.ASCII), path
        for tag in re.findall("<%.*", text):
            assert re.match(r"<%= (?:target_name|port|baud|reply_timeout|dialect) %>", tag), tag
        if path.endswith(".py"):
            (folder / "protocol.py").write_text(text, encoding="utf-8")
            tree = ast.parse((folder / "protocol.py").read_bytes())  # as Python reads it, with coding lines
            kinds = (ast.Import, ast.ImportFrom, ast.Assign, ast.ClassDef, ast.FunctionDef)
            assert all(isinstance(node, kinds) for node in tree.body)
            assert [node.names[0].name for node in tree.body if isinstance(node, ast.Import)] == [
                "re",
                "threading",
                "time",
            ]
            assert tree.body[-1].name.isidentifier()
        elif "cmd_tlm" in path:
            cosmos_text(text)


def dbc(icd: InterfaceDefinition, folder: Path) -> None:
    (folder / "unit.dbc").write_text(export(icd, "dbc"), encoding="utf-8")
    database = cantools.database.load_file(folder / "unit.dbc", strict=True)
    assert {message.name for message in database.messages} == {
        "TC_set_text", "ACK_set_text", "NACK_set_text", "REQ_number", "TLM_number", "NACK_number",
    }  # fmt: skip
    signals = {signal.name: signal for signal in database.get_message_by_name("TLM_number").signals}
    assert signals.keys() == {"number", "kind", "bit"}
    assert len(signals["kind"].choices) == 2


def eds(icd: InterfaceDefinition, folder: Path) -> None:
    (folder / "unit.eds").write_text(export(icd, "eds"), encoding="utf-8")
    dictionary = canopen.import_od(str(folder / "unit.eds"), node_id=1)
    assert {0x2000, 0x2001, 0x2002} <= dictionary.indices.keys()
    assert all(line == "" or line[0] in ";[" or "=" in line for line in export(icd, "eds").split("\n"))


def xtce(icd: InterfaceDefinition, _folder: Path) -> None:
    root = ET.fromstring(export(icd, "xtce").encode())
    names = [element.get("name") for element in root.iter()]
    assert all(re.fullmatch(r"[^./:\[\] ]+", name) for name in names if name is not None)
    assert len(root.findall(".//{*}MetaCommand")) == 1


class Tags(HTMLParser):
    """Collects the tags and attributes of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.found: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found |= {tag, *(f"{tag} {key}" for key, _ in attrs)}
        for key, value in attrs:
            assert key != "href" or str(value).startswith("#"), value

    def handle_comment(self, data: str) -> None:
        raise AssertionError(data)

    def unknown_decl(self, data: str) -> None:
        raise AssertionError(data)


PAGE = {
    "html", "html lang", "head", "meta", "meta charset", "title", "style", "body", "h1", "h2", "h2 id", "h3", "h3 id", "p", "p class",
    "nav", "a", "a href", "table", "tr", "tr class", "th", "td", "code",
}  # fmt: skip
RENDERED = {
    "h1",
    "h2",
    "h3",
    "p",
    "ul",
    "li",
    "a",
    "a href",
    "table",
    "thead",
    "tbody",
    "tr",
    "th",
    "td",
    "code",
}


def html(icd: InterfaceDefinition, _folder: Path) -> None:
    assert Tags(export(icd, "html")).found <= PAGE


def markdown(icd: InterfaceDefinition, folder: Path) -> None:
    render = MarkdownIt("commonmark", {"html": True}).enable(["table", "strikethrough"]).render
    harmless = definition(folder, text="x" if icd.doc else "")  # a column without texts is left out
    page, calm = (render(export(unit, "markdown")) for unit in (icd, harmless))
    assert Tags(page).found <= RENDERED
    for tag in ("h1", "h2", "h3", "table", "tr", "td", "li"):
        assert page.count(f"<{tag}>") == calm.count(f"<{tag}>"), tag


CHECKS: dict[str, Callable[[InterfaceDefinition, Path], None]] = {
    "markdown": markdown, "html": html, "dbc": dbc, "eds": eds, "xtce": xtce, "cosmos": cosmos, "c": c, "cosmos-plugin": cosmos_plugin,
}  # fmt: skip


def test_every_format_is_checked() -> None:
    assert CHECKS.keys() == {*FORMATS, *FOLDER_FORMATS}


@pytest.mark.parametrize("text", HOSTILE, ids=IDS)
def test_hostile_text_stays_text(tmp_path: Path, text: str) -> None:
    icd = definition(tmp_path, name=text, text=text)
    for check in CHECKS.values():
        check(icd, tmp_path)


def row(kind: str, name: str, number: int, *fields: str) -> str:
    return ROW.format(kind=kind, name=name, number=number, fields=", ".join(fields))


WORDS = re.findall(
    r"\w+",
    """
auto break case char const continue default do double else enum extern float for goto if inline int long register restrict return
short signed sizeof static struct switch typedef union unsigned void volatile while bool true false class delete new private
public this try catch template operator virtual namespace and or not xor bitand bitor compl and_eq or_eq xor_eq not_eq asm export
friend mutable typename typeid using explicit protected throw wchar_t concept requires constexpr decltype noexcept nullptr alignas
alignof static_assert thread_local typeof unix linux i386 errno stdin stdout stderr uint8_t int64_t size_t complex int_ int__
unix_ values data size raw result
""",
)


def test_fields_may_have_the_names_of_keywords_types_and_macros(tmp_path: Path) -> None:
    fields = [f'"u8 {word}"' for word in WORDS]
    icd = definition(tmp_path, rows=row("telemetry", "words", 201, *fields))
    for format_ in ("c", "eds", "xtce", "html"):
        CHECKS[format_](icd, tmp_path)
    if COMPILER is not None:
        compile_source(COMPILER, "-std=gnu11", "unit.c", tmp_path)  # with the macros unix and linux
    if shutil.which("c++"):
        (tmp_path / "unit.cpp").write_text('#include "unit.h"\n', encoding="utf-8")
        compile_source("c++", "-std=gnu++17", "unit.cpp", tmp_path)
    members = [c_member(word) for word in WORDS]
    assert len(set(members)) == len(WORDS)
    decode = next(text for name, text in export_folder(icd, "c").items() if name.endswith(".c"))
    assert [word for word in members if f"values->{word} = " not in decode] == []
    assert cantools.database.load_string(export(icd, "dbc")).get_message_by_name("TLM_words").signals


MAP = '{ name = "state", type = "u8", map = { 1 = "a", 2 = "b" } }'
ENUM = '[[enum]]\nname = "mode_state"\ndoc = "x"\nvalues = { a = 8, b = 9 }\n'


def enum(name: str, member: str) -> str:
    return f'[[enum]]\nname = "{name}"\ndoc = "x"\nvalues = {{ {member} = 1 }}\n'


COLLISIONS = [
    ("c", ENUM + row("telemetry", "mode", 201, MAP), "map of mode.state", "enumeration mode_state"),
    ("c", enum("bad", "length"), "enumeration bad: 'length'", "the C export itself"),
    ("c", enum("mode", "a_b") + enum("mode_a", "b"), "enumeration mode_a: 'b'", "enumeration mode: 'a_b'"),
    ("c", enum("tc", "set_text_id"), "telecommand set_text", "enumeration tc: 'set_text_id'"),
    ("c", enum("request", "capacity"), "enumeration request: 'capacity'", "the C export itself"),
    ("c", row("telemetry", "x", 201, '{ name = "y", type = "u8", map = { 1 = "a b", 2 = "a-b" } }'), "map of x.y: 'a-b'", "map of x.y: 'a b'"),
    ("dbc", row("telemetry", "x", 201, '"bytes map 3"', '"u8 map_1"'), "telemetry x: field map_1", "telemetry x: field map"),
    ("xtce", row("telemetry", "a", 201, '"u8 b_c"') + row("telemetry", "a_b", 202, '"u8 c"'), "telemetry a_b: field c", "telemetry a: field b_c"),
    ("xtce", row("telemetry", "set_text_packet", 201, '"u8 c"'), "telemetry set_text_packet", "telecommand set_text"),
    ("cosmos", row("telecommand", "request_number", 3, ""), "telemetry number", "telecommand request_number"),
    ("cosmos", row("telemetry", "x", 201, '"u8 packet_id"'), "telemetry x: field packet_id", "the COSMOS export itself"),
    ("cosmos", row("telemetry", "x", 201, '"u8 received_count"'), "telemetry x: field received_count", "the COSMOS export itself"),
    ("cosmos", row("telemetry", "x", 201, '"u8 a__b"', '"u8 a_b"'), "telemetry x: field a_b", "telemetry x: field a__b"),
    ("cosmos", row("telemetry", "x", 201, '{ name = "y", type = "u8", map = { 1 = "a b", 2 = "a_b" } }'), "telemetry x: field y: 'a_b'", "telemetry x: field y: 'a b'"),
    ("eds", '[[canopen.object]]\nindex = 0x2003\nname = "2002 "\nparameters = true\n', "object 2003h", "object 2002h"),
    ("cosmos-plugin", row("telemetry", "answer", 201, '"u8 c"'), "telemetry answer", "the COSMOS export itself"),
    ("cosmos-plugin", row("telemetry", "file_burst", 201, '"u8 c"'), "telemetry file_burst", "the COSMOS export itself"),
]  # fmt: skip


@pytest.mark.parametrize(("format_", "rows", "one", "other"), COLLISIONS)
def test_two_things_with_one_name_are_rejected_by_both_names(
    tmp_path: Path, format_: str, rows: str, one: str, other: str
) -> None:
    icd = definition(tmp_path, **{"objects" if "canopen" in rows else "rows": rows})
    with pytest.raises(ProtocolError) as caught:
        (export if format_ in FORMATS else export_folder)(icd, format_)
    text = str(caught.value)
    assert "\n" not in text
    assert f"{one}: has the same name as {other} in " in text
    assert text.endswith("; rename one of them")


def test_a_default_text_arrives_in_the_c_as_it_is(tmp_path: Path) -> None:
    text = 'a"\n\\?? unit_x 7'
    icd = definition(tmp_path, "x", text)
    files = dict(export_folder(icd, "c"))
    files["main.c"] = (
        '#include "x.h"\n#include <stdio.h>\nint main(void)\n{\n    x_tc_set_text_t values = X_TC_SET_TEXT_INIT;\n'
        "    return fputs(values.text, stdout) < 0;\n}\n"
    )
    for name, content in files.items():
        (tmp_path / name).write_text(content, encoding="utf-8")
    if COMPILER is None:
        pytest.skip("no C compiler (cc, gcc or clang) here: the exported C is not compiled")
    subprocess.run(
        [COMPILER, "-std=c99", "-Wall", "-Werror", "-o", "main", "main.c"], cwd=tmp_path, check=True
    )
    assert subprocess.run([tmp_path / "main"], capture_output=True, check=True).stdout == text.encode()
