"""Descriptions of rows and fields, shared by the human-readable formats."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from starhil.protocol.export.wire import texts_of
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.icd.codec import Field, Row
from starhil.protocol.icd.values import EnumDefinition, Parameter, Section, Value
from starhil.protocol.unit.examples import Exchange, exchanges

FIELD_COLUMNS: Final = ("Byte", "Field", "Type", "Unit", "Value", "Range", "Source", "Meaning", "Example")
PARAMETER_COLUMNS: Final = ["ID", "Parameter", "Type", "Unit", "Range", "Default", "Meaning"]


def introduction(icd: InterfaceDefinition) -> Iterator[str]:
    """Paragraphs before the tables."""
    first = icd.first_telemetry_id
    kinds = (
        f" IDs below {first} are telecommands, IDs from {first} on are telemetry."
        if first is not None
        else ""
    )
    yield f"Multi-byte fields are {icd.conventions.byte_order}-endian.{kinds}"
    yield from texts_of("introduction")["paragraphs"]


def examples(icd: InterfaceDefinition) -> dict[str, list[Exchange]]:
    """Return the example exchanges of each row, by its name."""
    found: dict[str, list[Exchange]] = {row.name: [] for row in icd.rows}
    for exchange in exchanges(icd):
        found[exchange.row.name].append(exchange)
    return found


def example_text(exchange: Exchange) -> str:
    request, answers = (
        ", ".join(f"`{frame}`" for frame in frames) for frames in (exchange.request, exchange.answers)
    )
    if exchange.row.only_sent:
        return f"Example on {exchange.link}, without a request: {answers}."
    return f"Example on {exchange.link}: request {request}; answer {answers or 'none'}."


def value_text(value: Value) -> str:
    """Format a value of a field for people."""
    if isinstance(value, bytes):
        return value.hex(" ").upper()
    return number(value) if isinstance(value, float) else str(value)


def number(value: float) -> str:
    """Format a number with up to 10 significant digits."""
    return f"{value:.10g}"


def title(row: Row) -> str:
    """Return the heading of a row: its class, if it has one, ID and name."""
    message_class = f"{row.message_class} " if row.message_class else ""
    return f"{message_class}{row.id} (0x{row.id:02X}) {row.name}"


def anchor(row: Row) -> str:
    """Return the anchor of a row in a page; it is unique."""
    return f"row-{row.kind}-{row.message_class}-{row.id}"


def facts(row: Row) -> str:
    size = f"{row.size} byte{'' if row.size == 1 else 's'}" if row.size else "No data"
    sent = ", only sent" if row.only_sent else ""
    return f"{size}{sent}, {row.provenance}{f': {row.source}' if row.source else ''}"


def beyond(row: Row, field: Field) -> str:
    """Return how telemetry treats a number beyond its range: "clipped", "wraps" or nothing."""
    constant = field.const is not None
    if row.kind != "telemetry" or constant or field.kind not in ("integer", "float", "bits"):
        return ""
    if field.wrap:
        return "wraps"
    bounded = field.minimum is not None or field.maximum is not None
    return "clipped" if field.kind != "float" or bounded else ""


def meaning(row: Row, field: Field) -> str:
    """Return description and behaviour beyond the range, for formats without a range column."""
    low, high = (number(limit) for limit in field.physical_limits) if beyond(row, field) else ("", "")
    match beyond(row, field):
        case "wraps":
            return f"{field.doc} Wraps beyond {high}.".lstrip()
        case "clipped":
            return f"{field.doc} Clipped to {low} to {high}.".lstrip()
        case _:
            return field.doc


def field_cells(row: Row) -> Iterator[tuple[str, ...]]:
    """Cells of each field of a row under FIELD_COLUMNS."""
    sample = row.sample()
    for field in row.fields:
        about = field.doc
        if field.parameter is not None:
            about = f"{about} Parameter {field.parameter}."
        yield (
            _position(field),
            field.name or "unused",
            _type(field),
            field.unit,
            _value(field),
            _range(row, field),
            field.provenance if field.name else "",
            about if field.name else "Sent as 0.",
            value_text(sample[field.name]) if field.name else "",
        )


def parameter_cells(parameter: Parameter) -> list[str]:
    limits = f"{number(parameter.minimum)} to {number(parameter.maximum)}"
    if parameter.enum is not None:
        limits = enum_text(parameter.enum)
    elif parameter.type == "bool":
        limits = "0 or 1"
    default = parameter.default
    return [
        str(parameter.id),
        parameter.name,
        parameter.type,
        parameter.unit,
        limits,
        str(default) if isinstance(default, str) else number(float(default)),
        parameter.doc,
    ]


def enum_text(enum: EnumDefinition) -> str:
    """Members of an enumeration in one line."""
    return ", ".join(f"{value} {name}" for name, value in enum.values.items())


def reference(icd: InterfaceDefinition) -> Iterator[Section]:
    parameters = [parameter_cells(parameter) for parameter in icd.parameters.values()]
    yield Section(heading="Parameters", columns=PARAMETER_COLUMNS, rows=parameters)
    enums = [[enum.name, enum_text(enum), enum.doc] for enum in icd.enums.values()]
    yield Section(heading="Enumerations", columns=["Name", "Numbers", "Meaning"], rows=enums)


def sections(icd: InterfaceDefinition) -> Iterator[tuple[str, list[Row]]]:
    """The two groups of rows with their headings."""
    yield "Telecommands", [row for row in icd.rows if row.kind == "telecommand"]
    yield "Telemetry", [row for row in icd.rows if row.kind == "telemetry"]


def _position(field: Field) -> str:
    if not field.width:
        last = field.offset + field.size - 1
        return str(field.offset) if field.size == 1 else f"{field.offset}–{last}"
    places = (field.place(bit) for bit in sorted({0, field.width - 1}))
    return "–".join(f"{byte}.{bit}" for byte, bit in places)


def _type(field: Field) -> str:
    if field.width:
        return "bit" if field.width == 1 else f"{field.width} bits"
    if field.slot.type == "bytes":
        return f"{'text' if field.kind == 'text' else 'bytes'}[{field.size}]"
    return field.slot.type


def _value(field: Field) -> str:
    if field.enum is not None:
        return enum_text(field.enum)
    if not field.scaled:
        return ""
    text = f"raw × {number(field.scale)}"
    if field.bias:
        text += f" {'+' if field.bias > 0 else '−'} {number(abs(field.bias))}"
    return text


def _range(row: Row, field: Field) -> str:
    behaviour = beyond(row, field)
    if behaviour:
        low, high = field.physical_limits
        return f"{number(low)} to {number(high)}, {behaviour}"
    if field.kind not in ("integer", "float", "bits") or (field.minimum is None and field.maximum is None):
        return ""
    if field.minimum == field.maximum:
        return number(field.minimum or 0.0)
    low, high = field.physical_limits
    if field.maximum is None and field.kind == "float":
        return f"≥ {number(low)}"
    return f"{number(low)} to {number(high)}"
