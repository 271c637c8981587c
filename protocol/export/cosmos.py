"""The interface definition as command and telemetry text of OpenC3 COSMOS.

A packet is the ID of a row followed by its data; in a unit with classes, the code of the class is the upper
byte of the ID. COSMOS truncates computed raw values, so a scaled parameter may be sent one step too small.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Final

from starhil.protocol.codec import Field, Row
from starhil.protocol.export.describe import meaning, number
from starhil.protocol.export.row_key import key_bits, key_of
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.values import IcdError

TARGET: Final = "STARHIL"
IDENTIFIER: Final = "PACKET_ID"


def render(icd: InterfaceDefinition) -> str:
    """Return commands and telemetry as one text."""
    head = (
        f"# {icd.name} {icd.version}: {icd.doc}",
        "# Generated from the interface definition; do not edit.",
    )
    return "\n".join((*head, *commands(icd, TARGET), *telemetry(icd, TARGET))) + "\n"


def commands(icd: InterfaceDefinition, target: str) -> Iterator[str]:
    """Yield the telecommands, and a command that requests each telemetry row."""
    bits = key_bits(icd)
    for row in icd.rows:
        name = row.name if row.kind == "telecommand" else f"request_{row.name}"
        doc = row.doc if row.kind == "telecommand" else f"Request {row.name}."
        key = key_of(icd, row)
        yield from ("", f"COMMAND {target} {name.upper()} BIG_ENDIAN {_quoted(doc)}")
        yield f'  APPEND_ID_PARAMETER {IDENTIFIER} {bits} UINT {key} {key} {key} "Row ID"'
        if row.kind == "telecommand":
            yield from _fields(row, bits)


def telemetry(icd: InterfaceDefinition, target: str) -> Iterator[str]:
    """Yield the telemetry rows."""
    bits = key_bits(icd)
    for row in icd.rows:
        if row.kind == "telecommand":
            continue
        yield from ("", f"TELEMETRY {target} {row.name.upper()} BIG_ENDIAN {_quoted(row.doc)}")
        yield f'  APPEND_ID_ITEM {IDENTIFIER} {bits} UINT {key_of(icd, row)} "Row ID"'
        yield from _fields(row, bits)


def _fields(row: Row, start: int) -> Iterator[str]:
    for index, field in enumerate(row.fields):
        yield from _field(row, field, index, start)


def _field(row: Row, field: Field, index: int, start: int) -> Iterator[str]:
    keyword = "PARAMETER" if row.kind == "telecommand" else "ITEM"
    name = (field.name or f"unused_{index}").upper()
    bits = field.width or 8 * field.size
    limits = _limits(field) if row.kind == "telecommand" else ""
    endian = f" {'LITTLE' if field.slot.order == 'little' and not field.width else 'BIG'}_ENDIAN"
    if field.width:
        # COSMOS counts bits from the most significant one, and takes a bit field's order from its bytes
        byte = field.shift // 8 if field.slot.order == "little" else field.size - 1 - field.shift // 8
        if field.shift % 8 + field.width > 8 and field.slot.order == "little":
            raise IcdError(
                f"{row.name}.{field.name}: bits across little-endian bytes cannot be exported to COSMOS"
            )
        offset = start + 8 * (field.offset + byte) + 8 - field.shift % 8 - field.width
    else:
        offset = start + 8 * field.offset
    yield f"  {keyword} {name} {offset} {bits} {_type(field)}{limits} {_quoted(meaning(row, field) or 'Unused')}{endian}"
    if field.enum is not None:
        yield from (f"    STATE {_state(label)} {value}" for label, value in field.enum.values.items())
    elif field.kind == "flag":
        yield from ("    STATE FALSE 0", "    STATE TRUE 1")
    if field.scaled:
        if row.kind == "telecommand":
            yield f"    POLY_WRITE_CONVERSION {number(-field.bias / field.scale)} {number(1.0 / field.scale)}"
        else:
            yield f"    POLY_READ_CONVERSION {number(field.bias)} {number(field.scale)}"
    if field.unit:
        yield f"    UNITS {_quoted(field.unit)} {_quoted(field.unit)}"


def _state(label: str) -> str:
    """Return the name of a state in capitals, without characters that end a word in COSMOS."""
    return re.sub(r"[^\w.-]", "_", label).upper()


def _type(field: Field) -> str:
    match field.kind:
        case "float":
            return "FLOAT"
        case "bytes":
            return "BLOCK"
        case "text":
            return "STRING"
        case _:
            return "INT" if not field.width and field.type.startswith("i") else "UINT"


def _limits(field: Field) -> str:
    """Return the lowest, highest and default value of a command parameter."""
    if field.slot.type == "bytes":
        return f" 0x{bytes(field.size).hex()}" if field.kind == "bytes" else ' ""'
    if field.enum is not None:
        low, high = min(field.enum.values.values()), max(field.enum.values.values())
        default = field.enum.values[field.default] if isinstance(field.default, str) else low
        return f" {low} {high} {default}"
    if field.kind in ("flag", "unused"):
        return f" 0 {2**field.width - 1 if field.width else 0} {int(bool(field.default))}"
    if field.kind == "float" and (field.minimum is None or field.maximum is None):
        return " MIN MAX 0"
    if field.kind in ("integer", "bits") and not field.scaled:
        low, high = field.raw_limits  # whole numbers of any size, which a float could not hold
        default = int(field.default) if isinstance(field.default, (int, float)) else min(max(0, low), high)
        return f" {low} {high} {default}"
    low_limit, high_limit = field.physical_limits
    default_value = (
        field.default if isinstance(field.default, (int, float)) else min(max(0.0, low_limit), high_limit)
    )
    return f" {number(low_limit)} {number(high_limit)} {number(default_value)}"


def _quoted(text: str) -> str:
    return '"' + text.replace('"', "'") + '"'
