"""The interface definition as command and telemetry text of OpenC3 COSMOS.

A packet is the ID of a row followed by its data; in a unit with classes, the code of the class is the upper
byte of the ID. COSMOS truncates computed raw values, so a scaled parameter may be sent one step too small.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Final

from starhil.protocol.errors import IcdError
from starhil.protocol.export.describe import meaning, number
from starhil.protocol.export.packets import key_bits, key_of, wire_order
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.icd.codec import Field, Row
from starhil.protocol.icd.quoting import Scope, cosmos_name, cosmos_state, cosmos_string
from starhil.protocol.icd.values import EnumDefinition

TARGET: Final = "STARHIL"
IDENTIFIER: Final = "PACKET_ID"
RESERVED_ITEMS: Final = (
    IDENTIFIER, "PACKET_TIMESECONDS", "PACKET_TIMEFORMATTED", "RECEIVED_TIMESECONDS", "RECEIVED_TIMEFORMATTED",
    "RECEIVED_COUNT", "COSMOS_DATA_TAG", "COSMOS_EXTRA",
)  # fmt: skip
"""Items that every packet has."""


def render(icd: InterfaceDefinition) -> str:
    """Return commands and telemetry as one text."""
    head = (
        f"# {cosmos_string(f'{icd.name} {icd.version}: {icd.doc}')}",
        "# Generated from the interface definition; do not edit.",
    )
    return "\n".join((*head, *commands(icd, TARGET), *telemetry(icd, TARGET))) + "\n"


def commands(icd: InterfaceDefinition, target: str) -> Iterator[str]:
    """Yield the telecommands, and a command that requests each telemetry row."""
    bits = key_bits(icd)
    scope = Scope("COSMOS")
    for row in icd.rows:
        if row.only_sent:
            continue
        name = scope.claim(command_name(row), f"{row.kind} {row.name}")
        doc = row.doc if row.kind == "telecommand" else f"Request {row.name}."
        key = key_of(icd, row)
        yield from ("", f"COMMAND {target} {name} BIG_ENDIAN {cosmos_string(doc)}")
        yield f'  APPEND_ID_PARAMETER {IDENTIFIER} {bits} UINT {key} {key} {key} "Row ID"'
        if row.kind == "telecommand":
            yield from _fields(row, bits)


def command_name(row: Row) -> str:
    """Return the name of the command that sends a row, or requests it."""
    return cosmos_name(row.name if row.kind == "telecommand" else f"request_{row.name}")


def telemetry(icd: InterfaceDefinition, target: str, reserved: Iterable[str] = ()) -> Iterator[str]:
    """Yield the telemetry rows, whose packets cannot have the reserved names."""
    bits = key_bits(icd)
    scope = Scope("COSMOS", reserved)
    for row in icd.rows:
        if row.kind == "telecommand":
            continue
        name = scope.claim(cosmos_name(row.name), f"telemetry {row.name}")
        yield from ("", f"TELEMETRY {target} {name} BIG_ENDIAN {cosmos_string(row.doc)}")
        yield f'  APPEND_ID_ITEM {IDENTIFIER} {bits} UINT {key_of(icd, row)} "Row ID"'
        yield from _fields(row, bits)


def _fields(row: Row, start: int) -> Iterator[str]:
    scope = Scope("COSMOS", RESERVED_ITEMS)
    for index, field in enumerate(wire_order(row, "COSMOS")):
        name = cosmos_name(field.name or f"unused_{index}")
        where = f"{row.kind} {row.name}: field {field.name or 'unused'}"
        yield from _field(row, field, scope.claim(name, where), start)


def _field(row: Row, field: Field, name: str, start: int) -> Iterator[str]:
    keyword = "PARAMETER" if row.kind == "telecommand" else "ITEM"
    limits = _limits(field) if row.kind == "telecommand" else ""
    endian = f" {'LITTLE' if field.slot.order == 'little' and not field.width else 'BIG'}_ENDIAN"
    offset = start + 8 * field.offset
    if field.slot.bytewise and field.slot.order == "little":
        raise IcdError(
            f"{row.kind} {row.name}: field {field.name}: COSMOS has no little-endian numbers of {field.size} bytes"
        )
    if (
        field.width
    ):  # COSMOS counts bits from the most significant one, and takes a bit field's order from its bytes
        byte, bit = field.place(field.width - 1)
        offset = start + 8 * byte + 7 - bit
    said = field.changed(doc=field.doc or (f"{field.name}." if field.name else "Unused."))
    yield f"  {keyword} {name} {offset} {field.bit_count} {_type(field)}{limits} {cosmos_string(meaning(row, said))}{endian}"
    if field.enum is not None:
        yield from states(field.enum, f"{row.kind} {row.name}: field {field.name}")
    elif field.kind == "flag":
        yield from ("    STATE FALSE 0", "    STATE TRUE 1")
    if field.scaled:
        if row.kind == "telecommand":
            yield f"    POLY_WRITE_CONVERSION {number(-field.bias / field.scale)} {number(1.0 / field.scale)}"
        else:
            yield f"    POLY_READ_CONVERSION {number(field.bias)} {number(field.scale)}"
    if field.unit:
        yield f"    UNITS {cosmos_string(field.unit)} {cosmos_string(field.unit)}"


def states(enum: EnumDefinition, where: str) -> Iterator[str]:
    """Yield the members of an enumeration as states of an item."""
    scope = Scope("COSMOS")
    for label, value in enum.values.items():
        yield f"    STATE {scope.claim(cosmos_state(label), f'{where}: {label!r}')} {value}"


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
