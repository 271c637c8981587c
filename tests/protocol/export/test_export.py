"""Exports of the interface definition, each read back by somebody else's reader on the same packets as our codec."""

from __future__ import annotations

import math
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path
from typing import Any

import canmatrix.formats
import canopen
import cantools
import pytest
from space_packet_parser.xtce import definitions, validation

from starhil.protocol.can.cubespace import CanDeviceReceiver, encode_reply_frames, encode_request_frames
from starhil.protocol.errors import ProtocolError
from starhil.protocol.export import FOLDER_FORMATS, FORMATS, export, export_folder
from starhil.protocol.export.describe import anchor, example_text, field_cells
from starhil.protocol.export.packets import key_bits, key_of
from starhil.protocol.files.bundled import DEFAULT_UNIT, bundled_units
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.icd.codec import Field, Row
from starhil.protocol.icd.quoting import cosmos_state
from starhil.protocol.icd.values import Value, to_f32
from starhil.protocol.messages import ErrorCode, Reply, ReplyKind, Request
from starhil.protocol.serial.cubespace import Dialect
from starhil.protocol.serial.stack import SerialStack
from starhil.protocol.unit import load_unit
from starhil.protocol.unit.examples import exchanges

pytestmark = [pytest.mark.long, pytest.mark.lowest("jinja2")]

ICD = load_unit()
TELEMETRY = [row for row in ICD.rows if row.kind == "telemetry"]
TELECOMMANDS = [row for row in ICD.rows if row.kind == "telecommand"]
OBC, DEVICE = 1, 4


def by_name(row: Row) -> str:
    return row.name


def packets(row: Row) -> Iterator[tuple[dict[str, Value], bytes]]:
    """Values that differ from field to field, with the bytes that our codec makes of them."""
    for turn in range(4):
        values = {
            name: _value(field, number, turn) for number, (name, field) in enumerate(row.named_fields.items())
        }
        yield values, row.encode(values)


def _value(field: Field, number: int, turn: int) -> Value:
    match field.kind:
        case "flag":
            return bool(field.const) if field.const is not None else bool((number + turn) % 2)
        case "enum":
            assert field.enum is not None
            return list(field.enum.values)[(number + turn) % len(field.enum.values)]
        case "text":
            return "star"[: field.size]
        case "bytes":
            return bytes((17 * index + 31 * turn) % 256 for index in range(field.size))
        case "float":
            low, high = field.physical_limits
            value = min(max((-1.5 + turn) * (number + 1) * 1.25, low), high)
            return to_f32(value) if field.slot.type == "f32" else value
        case _:
            low, high = field.raw_limits
            return field.to_physical(low + (high - low) * (turn + 1) // (5 + number % 3))


def same(theirs: object, ours: Value) -> bool:
    if isinstance(ours, float):
        return isinstance(theirs, (int, float)) and math.isclose(theirs, ours, rel_tol=1e-9, abs_tol=1e-9)
    return theirs == ours


@cache
def text(name: str) -> str:
    return export(ICD, name)


@cache
def on_disk(name: str, folder: Path) -> Path:
    file = folder / f"icd.{name}"
    file.write_text(text(name), encoding="utf-8")
    return file


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("icd")


# -- DBC ---------------------------------------------------------------------------------------------------------------


def _dbc_signals(row: Row, values: dict[str, Value]) -> dict[str, Value]:
    signals: dict[str, Value] = {}
    for name, field in row.named_fields.items():
        value = values[name]
        if isinstance(value, bytes):
            signals |= {f"{name}_{index}": byte for index, byte in enumerate(value)}
        else:
            signals[name] = int(value) if field.kind == "flag" else value
    return signals


@cache
def _cantools() -> Any:
    return cantools.database.load_string(text("dbc"), database_format="dbc", strict=True)


def _joined(frames: list[Any]) -> bytes:
    return frames[0].data if len(frames) == 1 else b"".join(frame.data[:-1] for frame in frames)


@pytest.mark.parametrize("row", [*TELECOMMANDS, *TELEMETRY], ids=by_name)
def test_cantools_decodes_our_frames(row: Row) -> None:
    database = _cantools()
    for values, data in packets(row):
        if row.kind == "telemetry":
            frames = encode_reply_frames(Reply(ReplyKind.TELEMETRY, row.id, data, destination=OBC), DEVICE)
        else:
            frames = encode_request_frames(Request.of(row.id, data), OBC, DEVICE)
        message = database.get_message_by_frame_id(frames[0].id)
        assert message.name == f"{'TLM' if row.kind == 'telemetry' else 'TC'}_{row.name}"
        assert (message.length, message.is_extended_frame) == (row.size, True)
        read = message.decode(_joined(frames), decode_choices=True) if row.size else {}
        expected = _dbc_signals(row, values)
        assert read.keys() == expected.keys()
        for name, value in expected.items():
            assert same(str(read[name]) if isinstance(value, str) else read[name], value), name


def test_cantools_makes_commands_that_our_device_accepts() -> None:
    database = _cantools()
    for row in TELECOMMANDS:
        for values, data in packets(row):
            message = database.get_message_by_name(f"TC_{row.name}")
            theirs = message.encode(_dbc_signals(row, values), strict=False) if row.size else b""
            assert theirs == data, row.name


def test_cantools_names_every_frame_of_a_dialogue() -> None:
    database = _cantools()
    request = Request.of(230)
    dialogue = [
        (encode_request_frames(request, OBC, DEVICE), "REQ_quaternion"),
        (
            encode_reply_frames(Reply(ReplyKind.NACK, 230, code=ErrorCode.BUSY, destination=OBC), DEVICE),
            "NACK_quaternion",
        ),
        (encode_request_frames(Request.of(1, b"\x5a"), OBC, DEVICE), "TC_reset"),
        (encode_reply_frames(Reply(ReplyKind.ACK, 1, destination=OBC), DEVICE), "ACK_reset"),
        (
            encode_reply_frames(Reply(ReplyKind.NACK, 1, code=ErrorCode.CRC, destination=OBC), DEVICE),
            "NACK_reset",
        ),
    ]
    for frames, name in dialogue:
        message = database.get_message_by_frame_id(frames[0].id)
        assert message.name == name
        if name.startswith("NACK"):
            assert str(message.decode(frames[0].data)["error"]) in ("busy", "crc")
    assert CanDeviceReceiver(DEVICE).feed(dialogue[0][0][0], 0.0) == [Request.of(230, b"", OBC)]


def test_canmatrix_reads_the_same_layout(folder: Path) -> None:
    matrix = canmatrix.formats.loadp_flat(str(on_disk("dbc", folder)))
    for row in TELEMETRY:
        frame = matrix.frame_by_name(f"TLM_{row.name}")
        assert frame is not None
        assert frame.size == row.size
        assert frame.arbitration_id.extended
        for name, field in row.named_fields.items():
            if field.slot.type == "bytes":
                continue
            signal = frame.signal_by_name(name)
            assert signal.get_startbit() == 8 * field.offset + field.shift, name
            assert signal.size == (field.width or 8 * field.size)
            assert signal.is_float == (field.kind == "float")
            assert float(signal.factor) == pytest.approx(field.scale)
            assert float(signal.offset) == pytest.approx(field.bias)
            assert (signal.unit or "") == field.unit
            if field.enum is not None:
                assert {int(value): str(label) for value, label in signal.values.items()} == dict(
                    field.enum.names
                )


# -- XTCE --------------------------------------------------------------------------------------------------------------


@cache
def _xtce(file: Path) -> Any:
    return definitions.XtcePacketDefinition.from_xtce(file, root_container_name="Packet")


def test_the_xtce_is_valid_against_the_published_schema(folder: Path) -> None:
    schema = Path(validation.__file__).parent / "schemas" / "SpaceSystem.xsd"
    result = validation.validate_xtce(
        on_disk("xtce", folder),
        local_xsd=schema,
        print_results=False,
        raise_on_error=False,
        allow_schema_download=False,
    )
    assert [str(error) for error in result.errors] == []
    assert result.valid


@pytest.mark.parametrize("row", TELEMETRY, ids=by_name)
def test_an_xtce_reader_reads_our_telemetry(row: Row, folder: Path) -> None:
    definition = _xtce(on_disk("xtce", folder))
    for values, data in packets(row):
        packet = definition.parse_bytes(bytes((row.id,)) + data)
        assert int(packet["identifier"]) == row.id
        for name, value in values.items():
            read = packet[f"{row.name}_{name}"]
            theirs = bool(read) if isinstance(value, bool) else str(read) if isinstance(value, str) else read
            assert same(bytes(theirs) if isinstance(value, bytes) else theirs, value), name


# -- EDS ---------------------------------------------------------------------------------------------------------------


def test_the_eds_is_read_by_canopen_and_passes_the_checker(folder: Path) -> None:
    file = on_disk("eds", folder)
    dictionary = canopen.import_od(str(file), node_id=5)
    names = {item.name for item in dictionary.values()}
    assert "Parameters" in names or any("arameter" in name for name in names)
    assert dictionary[0x1018][1] is not None
    checker = Path(sys.executable).with_name("dcfchk")
    result = subprocess.run([checker, "-n", "5", file], capture_output=True, text=True, check=False)
    assert (result.returncode, result.stderr.strip(), result.stdout.strip()) == (0, "", "")


# -- COSMOS ------------------------------------------------------------------------------------------------------------


@cache
def _cosmos(file: Path) -> Any:
    config = pytest.importorskip(
        "openc3.packets.packet_config", reason="openc3 reads the COSMOS text; it is not installed"
    )
    definition = config.PacketConfig()
    definition.process_file(str(file), "STARHIL")
    assert definition.warnings == []
    return definition


def test_cosmos_reads_our_telemetry(folder: Path) -> None:
    definition = _cosmos(on_disk("cosmos", folder))
    for row in TELEMETRY:
        packet = definition.telemetry["STARHIL"][row.name.upper()]
        assert packet.defined_length == 1 + row.size
        for values, data in packets(row):
            packet.buffer = bytes((row.id,)) + data
            assert packet.identify(packet.buffer)
            for name, value in values.items():
                read = packet.read(name.upper(), "CONVERTED")
                expected = str(value).upper() if isinstance(value, (bool, str)) else value
                assert same(bytes(read) if isinstance(value, bytes) else read, expected), f"{row.name}.{name}"


def test_cosmos_makes_our_telecommands(folder: Path) -> None:
    definition = _cosmos(on_disk("cosmos", folder))
    for row in TELECOMMANDS:
        packet = definition.commands["STARHIL"][row.name.upper()]
        for values, data in packets(row):
            packet.restore_defaults()
            for name, value in values.items():
                packet.write(name.upper(), str(value).upper() if isinstance(value, (bool, str)) else value)
            theirs = bytes(packet.buffer)
            assert theirs[0] == row.id
            scaled = [field for field in row.named_fields.values() if field.scaled]
            if not scaled:
                assert theirs[1:] == data, row.name
            read = row.decode(theirs[1:])
            for field in scaled:  # COSMOS cuts fractions of the raw value off
                assert read[field.name] == pytest.approx(values[field.name], abs=1.001 * field.scale), (
                    field.name
                )
            assert row.encode({**values, **{field.name: read[field.name] for field in scaled}}) == theirs[1:]


def test_the_cosmos_text_has_every_row_once_and_no_overlap() -> None:
    bits: dict[str, list[tuple[int, int]]] = {}
    current = ""
    for line in text("cosmos").splitlines():
        if match := re.match(r"(?:COMMAND|TELEMETRY) STARHIL (\w+) ", line):
            current = match[1].lower()
            assert current not in bits
            bits[current] = []
        elif match := re.match(r"  (?:PARAMETER|ITEM) (\w+) (\d+) (\d+) ", line):
            bits[current].append((int(match[2]), int(match[3])))
    assert bits.keys() == {row.name for row in ICD.rows} | {f"request_{row.name}" for row in TELEMETRY}
    for row in TELEMETRY:
        assert bits[f"request_{row.name}"] == []
    for row in ICD.rows:
        places = sorted(bits[row.name])
        assert sum(size for _, size in places) == 8 * row.size
        assert all(a + size == b for (a, size), (b, _) in pairwise(places))


# -- for people --------------------------------------------------------------------------------------------------------


class _Page(HTMLParser):
    """Checks that tags close, and collects links, targets and cells."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.links: set[str] = set()
        self.targets: set[str] = set()
        self.rows: list[int] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in ("meta", "!doctype"):
            self.open.append(tag)
        about = dict(attrs)
        self.links.add((about.get("href") or "").removeprefix("#"))
        self.targets.add(about.get("id") or "")

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def test_the_page_is_complete_and_its_links_resolve() -> None:
    page = _Page()
    page.feed(text("html"))
    assert page.open == []
    assert page.links <= page.targets
    assert {anchor(row) for row in ICD.rows} <= page.targets


def test_markdown_tables_have_even_columns_and_every_field() -> None:
    lines = text("markdown").splitlines()
    width = 0
    for line in lines:
        if line.startswith("|"):
            columns = len(re.findall(r"(?<!\\)\|", line)) - 1
            assert width in (0, columns), line
            width = columns
        else:
            width = 0
    for row in ICD.rows:
        section = markdown_section(row)
        assert f", {row.provenance}" in section
        for name, field in row.named_fields.items():
            (line,) = (line for line in section.splitlines() if f"| {name} |" in line)
            assert (f"| {field.provenance} |" in line) is (field.provenance != row.provenance)


def markdown_section(row: Row) -> str:
    """The text about a row, to which the table of rows leads; rows that differ only in their number share it."""
    (anchor,) = re.findall(rf"^\| {row.id} \| \[{row.name}\]\(#(.*?)\)", text("markdown"), re.MULTILINE)
    sections = text("markdown").split("\n### ")
    headings = (
        re.sub(r"[^\w -]", "", section.partition("\n")[0]).lower().replace(" ", "-") for section in sections
    )
    return dict(zip(headings, sections, strict=True))[anchor]


@pytest.mark.parametrize("name", ["markdown", "html"])
def test_human_readable_exports_contain_parameters_and_enumerations(name: str) -> None:
    for word in (*ICD.parameters, *ICD.enums):
        assert word in text(name)


@pytest.mark.parametrize("name", [name for name in FORMATS if name != "eds"])
def test_every_export_states_how_out_of_range_numbers_are_sent(name: str) -> None:
    """Rates are clipped, counters wrap; a telecommand's field is refused, which needs no word a field."""
    document = text(name)
    assert re.search(
        r"rate_x.*-3\.2768 to 3\.2767.*clipped|rate_x.*[Cc]lipped to -3\.2768 to 3\.2767",
        document,
        re.IGNORECASE,
    )
    assert re.search(
        r"runtime_s.*0 to 65535.*wraps|runtime_s.*[Ww]raps beyond 65535", document, re.IGNORECASE
    )


def test_markdown_gives_the_range_of_every_integer_in_telemetry() -> None:
    for row in TELEMETRY:
        section = markdown_section(row)
        for name, field in row.named_fields.items():
            if field.kind == "integer":
                (line,) = [line for line in section.splitlines() if f"| {name} |" in line]
                assert re.search(r" to \S+, (clipped|wraps) \| ", line), line


def test_rows_that_differ_only_in_their_number_are_described_once() -> None:
    assert markdown_section(ICD.telemetry["hole_map_1"]) == markdown_section(ICD.telemetry["hole_map_8"])
    assert markdown_section(ICD.telemetry["hole_map_8"]).startswith(
        "247 to 254 (0xF7 to 0xFE) hole_map_1 to hole_map_8\n"
    )
    assert markdown_section(ICD.telemetry["star_1_raw"]) != markdown_section(ICD.telemetry["star_2_raw"])


BITS = """
[unit]
name = "x"
version = "1"
doc = "x"
provenance = "ours"

[[telemetry]]
id = 200
name = "row"
doc = "x"
fields = [
    "u8 first",
    { type = "bits16", order = "big", bits = [{ name = "a", width = 3 }, { name = "b", width = 7 }, { width = 5 }, { name = "c" }] },
    { type = "bits32", order = "big", bits = [{ width = 6 }, { name = "d", width = 20 }, { name = "e", width = 6 }] },
    { type = "bits16", order = "little", bits = [{ name = "f", width = 3 }, { width = 7 }, { name = "g", width = 6 }] },
]
"""


def bits_unit(folder: Path, text: str = BITS) -> InterfaceDefinition:
    """A unit with bit fields of both orders, and groups of bits across bytes."""
    (folder / "unit.toml").write_text(text)
    return load_unit(folder)


def documented_places(position: str) -> Iterator[tuple[int, int]]:
    """Yield byte and bit of each bit of a documented position such as `30.6–31.1`, the least significant first."""
    (byte, bit), *rest = ([int(part) for part in place.split(".")] for place in position.split("–"))
    last = tuple(rest[0]) if rest else (byte, bit)
    yield byte, bit
    while (byte, bit) != last:
        bit += 1
        if bit == 8:
            byte, bit = byte + (1 if last[0] > byte else -1), 0
        yield byte, bit


def check_documented_bits(icd: InterfaceDefinition) -> int:
    """Set each bit field alone and compare the bytes with its documented position; return the number of fields."""
    checked = 0
    for row in icd.rows:
        bits = {name: field for name, field in row.named_fields.items() if field.width}
        others = row.sample() | {name: field.to_physical(0) for name, field in bits.items()}
        base = row.encode(others, check=False)
        documented = {cells[1]: cells[0] for cells in field_cells(row)}
        for name, field in bits.items():
            places = list(documented_places(documented[name]))
            assert len(places) == field.width
            for raw in (1, 2**field.width - 1, 0b0110_1001_1010_0101_1100_0011_0101 % 2**field.width):
                value = bytearray(base)
                for number, (byte, bit) in enumerate(places):
                    value[byte] |= (raw >> number & 1) << bit
                found = row.encode({**others, name: field.to_physical(raw)}, check=False)
                assert found == value, f"{row.name}.{name}"
            checked += 1
    return checked


def test_documented_positions_of_bits_are_those_on_the_wire(tmp_path: Path) -> None:
    assert sum(check_documented_bits(load_unit(name)) for name in bundled_units()) > 500
    assert check_documented_bits(bits_unit(tmp_path)) == 7
    tutorial = (Path(__file__).parents[3] / "docs" / "your-unit.md").read_text()
    assert check_documented_bits(
        bits_unit(tmp_path, "\n".join(re.findall(r"```toml\n(.*?)```", tutorial, re.DOTALL)))
    )


def test_bits_across_bytes_are_read_by_xtce_and_rejected_by_name(tmp_path: Path) -> None:
    icd = bits_unit(tmp_path)
    file = tmp_path / "x.xml"
    file.write_text(export(icd, "xtce"))
    row = icd.telemetry["row"]
    definition = definitions.XtcePacketDefinition.from_xtce(file, root_container_name="Packet")
    for values, data in packets(row):
        packet = definition.parse_bytes(bytes((200,)) + data)
        assert {name: packet[f"row_{name}"] for name in values} == values
    wrong = bits_unit(
        tmp_path, BITS.replace('{ width = 7 }, { name = "g"', '{ name = "h", width = 7 }, { name = "g"')
    )
    for format_, language in (("xtce", "XTCE"), ("cosmos", "COSMOS")):
        with pytest.raises(
            ProtocolError, match=f"telemetry row: field h: {language} has no bits across the bytes"
        ):
            export(wrong, format_)


def test_cosmos_names_fields_without_a_description(tmp_path: Path) -> None:
    said = export(bits_unit(tmp_path), "cosmos")
    assert re.search(r'ITEM FIRST 8 8 UINT "first\. Clipped to 0 to 255\."', said)
    assert re.search(r'ITEM UNUSED_\d+ \d+ \d+ UINT "Unused\."', said)


# -- examples ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", bundled_units())
def test_example_messages_decode_to_the_values_that_are_printed(name: str) -> None:
    icd = load_unit(name)
    document = export(icd, "markdown")
    described = re.findall(r"^### .*\) (\w+)", document, re.MULTILINE)
    for exchange in exchanges(icd):
        row = exchange.row
        answers = [answer for answer in row.answers if answer != "echo"]
        if row.name in described:
            assert example_text(exchange) in document
        if (
            row.kind == "telecommand"
            or answers != ["reply"]
            or row.action is not None
            or exchange.link == "CAN"
        ):
            continue
        stack = SerialStack(icd)
        request = icd.request(row)
        receiver = stack.host()
        receiver.overhear(request)
        events = receiver.feed(bytes.fromhex("".join(exchange.answers)), 0.0)
        replies = [
            event for event in events if isinstance(event, Reply) and event.kind is ReplyKind.TELEMETRY
        ]
        assert [row.decode(reply.data) for reply in replies] == [exchange.values], row.name


@pytest.mark.parametrize("name", bundled_units())
def test_example_values_show_the_packing(name: str) -> None:
    """Neighbouring bytes of an integer differ, and none is zero unless its limits want it."""
    for row in load_unit(name).rows:
        values = row.sample()
        assert row.decode(row.encode(values, saturate=row.kind == "telemetry")) == values
        for key, field in row.named_fields.items():
            free = (
                field.kind == "integer"
                and field.const is None
                and field.minimum is None
                and field.maximum is None
            )
            if free and not field.width:
                data = row.encode(values)[field.offset : field.offset + field.size]
                assert 0 not in data, f"{row.name}.{key}"
                assert len(set(data)) == len(data), f"{row.name}.{key}"


# -- what a reader needs beside the rows -------------------------------------------------------------------------------


def test_the_icd_names_conventions_classes_lengths_and_error_codes(tmp_path: Path) -> None:
    tutorial = (Path(__file__).parents[3] / "docs" / "your-unit.md").read_text()
    tables = re.findall(r"```toml\n(.*?)```", tutorial.partition("## A unit that streams")[0], re.DOTALL)
    icd = bits_unit(tmp_path, "\n".join(tables))
    for said in (export(icd, "markdown"), export(icd, "html")):
        plain = re.sub(r"<[^>]+>", " ", said.replace("\\", "").replace("&#x27;", "'"))
        for words in (
            "q* ⊗ v_ICRS ⊗ q ", "the q of the attitude matrix A(q)", "+z, +x, +y of the sensor frame", "2000-01-01, UTC",
            "big-endian", "number of bytes of header, data", "7 (07h)", "boots to standby", "with measure",
        ):  # fmt: skip
            assert words in plain, words
        assert re.search(r"command\W+telecommand\W+01h\W+81h\W+81h", plain)
        assert re.search(r"request\W+telemetry\W+02h\W+82h\W+C2h", plain)


# -- all ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", FORMATS)
def test_the_same_definition_gives_the_same_text(name: str) -> None:
    assert export(ICD, name) == text(name)


def test_an_unknown_format_is_rejected() -> None:
    with pytest.raises(ProtocolError, match="no export format 'pdf'; choose one of markdown"):
        export(ICD, "pdf")


def test_a_changed_row_changes_every_export(tmp_path: Path) -> None:
    from starhil.protocol.files.bundled import find_unit

    for file in find_unit("cubestar").glob("*.toml"):
        (tmp_path / file.name).write_text(
            file.read_text().replace('name = "sample_period"', 'name = "frame_interval"')
        )
    changed = load_unit(tmp_path)
    for name in FORMATS:
        if name != "eds":  # the object dictionary places rows of the definition by its own file
            assert "frame_interval" in export(changed, name).lower()
            assert "sample_period" not in export(changed, name).lower()


# -- other units -------------------------------------------------------------------------------------------------------

UNITS = [name for name in bundled_units() if name != DEFAULT_UNIT]
WITHOUT = {
    "dbc": ("has no CAN link", lambda icd: icd.link.can is None),
    "eds": ("has no CANopen", lambda icd: icd.canopen is None),
}
"""Formats that hold no unit without a link: the reason that is given, and whether a unit has it."""


@cache
def unit(name: str) -> InterfaceDefinition:
    return load_unit(name)


@pytest.mark.parametrize(("name", "dialects"), [("cubestar", "abc"), ("cubestar-gen2", "c")])
def test_the_replies_in_the_tables_for_people_are_those_of_the_link(name: str, dialects: str) -> None:
    """Bytes that are the ID, data or error code of a reply are replaced by their names."""
    telemetry, telecommand, data = 0x80, 0x60, bytes((0xDA,))
    replies = (
        Reply(ReplyKind.TELEMETRY, telemetry, data),
        Reply(ReplyKind.ACK, telecommand),
        Reply(ReplyKind.NACK, telecommand, code=ErrorCode.INVALID_PARAMETER),
        Reply(ReplyKind.UNSOLICITED, telemetry, data),
        Reply(ReplyKind.EVENT, telemetry, data),
    )
    code = ErrorCode.INVALID_PARAMETER.to_bytes().hex()
    names = {"80": "id", "60": "id", "da": "data", code: "code"}
    stack = SerialStack(load_unit(name))
    tables = export(load_unit(name), "markdown")
    _, _, *rows = tables[tables.index("| Dialect |") :].split("\n\n")[0].splitlines()
    assert [row.split(" | ")[0] for row in rows] == [f"| {dialect}" for dialect in dialects]
    for row, dialect in zip(rows, map(Dialect, dialects), strict=True):
        shown = stack.in_dialect(dialect)
        assert shown is not None
        cells = [
            " ".join(
                names.get(byte, byte.upper()) for byte in stack.encode_reply(reply, dialect).hex(" ").split()
            )
            if reply.kind in shown.headers
            else "none"
            for reply in replies
        ]
        assert row == f"| {dialect.value} | {' | '.join(cells)} |"
    request = stack.encode_request(Request.of(telecommand, data)).hex(" ").split()
    shown_request = " ".join(names.get(byte, byte.upper()) for byte in request)
    assert f"A request is {shown_request}, with every byte 1F" in tables


@pytest.mark.parametrize("name", UNITS)
@pytest.mark.parametrize("format_", FORMATS)
def test_a_format_holds_a_unit_or_names_what_the_unit_lacks(format_: str, name: str) -> None:
    reason, lacks = WITHOUT.get(format_, ("", lambda _icd: False))
    if lacks(unit(name)):
        with pytest.raises(ProtocolError, match=f"^unit {name}: {reason}"):
            export(unit(name), format_)
        return
    said = export(unit(name), format_).lower()
    if format_ != "eds":
        assert all(row.name in said for row in unit(name).rows)


@pytest.mark.parametrize("name", UNITS)
@pytest.mark.parametrize("format_", FOLDER_FORMATS)
def test_a_folder_format_holds_a_unit_or_names_what_it_lacks(format_: str, name: str) -> None:
    lacks = {"oresat": "^unit oresat: has no serial link", "st200": r"^link\.serial: requests that are texts"}
    if name in lacks:
        with pytest.raises(ProtocolError, match=lacks[name]):
            export_folder(unit(name), format_)
    else:
        assert export_folder(unit(name), format_)


@pytest.mark.parametrize("name", UNITS)
def test_the_xtce_of_a_unit_is_read_as_its_packets_are(name: str, tmp_path: Path) -> None:
    icd = unit(name)
    file = tmp_path / "unit.xml"
    file.write_text(export(icd, "xtce"), encoding="utf-8")
    schema = Path(validation.__file__).parent / "schemas" / "SpaceSystem.xsd"
    result = validation.validate_xtce(
        file, local_xsd=schema, print_results=False, raise_on_error=False, allow_schema_download=False
    )
    assert [str(error) for error in result.errors] == []
    definition = definitions.XtcePacketDefinition.from_xtce(file, root_container_name="Packet")
    for row in icd.telemetry.values():
        for values, data in packets(row):
            packet = definition.parse_bytes(key_of(icd, row).to_bytes(key_bits(icd) // 8, "big") + data)
            for key, value in values.items():
                read = packet[f"{row.name}_{key}"]
                theirs = (
                    bool(read) if isinstance(value, bool) else str(read) if isinstance(value, str) else read
                )
                if row.named_fields[key].kind == "text":
                    theirs = bytes(read).rstrip(b"\0").decode()
                assert same(bytes(theirs) if isinstance(value, bytes) else theirs, value), f"{row.name}.{key}"


@pytest.mark.parametrize("name", UNITS)
def test_cosmos_reads_the_packets_of_a_unit(name: str, tmp_path: Path) -> None:
    icd = unit(name)
    file = tmp_path / "unit.txt"
    file.write_text(export(icd, "cosmos"), encoding="utf-8")
    definition = _cosmos(file)
    for row in icd.telemetry.values():
        packet = definition.telemetry["STARHIL"][row.name.upper()]
        for values, data in packets(row):
            packet.buffer = key_of(icd, row).to_bytes(key_bits(icd) // 8, "big") + data
            for key, value in values.items():
                field = row.named_fields[key]
                read = packet.read(key.upper(), "CONVERTED")
                expected = (
                    cosmos_state(str(value)) if isinstance(value, bool) or field.enum is not None else value
                )
                assert same(bytes(read) if isinstance(value, bytes) else read, expected), f"{row.name}.{key}"
