"""The interface definition as XTCE 1.2 (XML Telemetric and Command Exchange).

A packet is the ID of a row followed by its data; in a unit with classes, the code of the class is the upper
byte of the ID.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from starhil.protocol.export.describe import meaning, number
from starhil.protocol.export.packets import key_bits, key_of, wire_order
from starhil.protocol.export.templates import fill
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.icd.codec import Field, Row
from starhil.protocol.icd.quoting import Scope, xtce_name, xtce_text

NAMESPACE: Final = "http://www.omg.org/spec/XTCE/20180204"
PACKET: Final = "Packet"
IDENTIFIER: Final = "identifier"


def render(icd: InterfaceDefinition) -> str:
    """Return the XML text. Raises IcdError for equal names, and for bits that XTCE cannot express."""
    scope = Scope("XTCE", [IDENTIFIER, PACKET])
    for row in icd.rows:
        scope.claim(row.name, f"{row.kind} {row.name}")
        if row.kind == "telecommand":
            scope.claim(f"{row.name}_packet", f"{row.kind} {row.name}")
    rows = {
        kind: [(row, list(_fields(row, scope))) for row in icd.rows if row.kind == kind]
        for kind in ("telemetry", "telecommand")
    }
    return fill(
        "xtce.xml.j2",
        icd=icd,
        name=xtce_name(icd.name),
        namespace_uri=NAMESPACE,
        identifier=IDENTIFIER,
        packet=PACKET,
        bits=key_bits(icd),
        telemetry=rows["telemetry"],
        telecommands=rows["telecommand"],
        kind_of=_kind,
        key_of=key_of,
        signed=_signed,
        initial=_initial,
        meaning=meaning,
        number=number,
        hexadecimal=lambda value, bits: value.to_bytes(-(-bits // 8), "big").hex().upper(),
        quoted=xtce_text,
    )


def _kind(field: Field) -> str:
    """Return the kind of the type of a parameter or argument."""
    if field.slot.type == "bytes":
        return "Binary"
    if field.kind == "float" or (field.scaled and field.enum is None and field.kind != "flag"):
        return "Float"
    if field.enum is not None:
        return "Enumerated"
    return "Boolean" if field.kind == "flag" else "Integer"


def _signed(field: Field) -> bool:
    return not field.width and field.type.startswith("i")


def _initial(field: Field) -> str:
    """Return the default value; that of a string in hexadecimal."""
    if field.slot.type == "bytes" and isinstance(field.default, str):
        return field.default.encode("ascii").ljust(field.size, b"\0").hex()
    return str(field.default)


def _fields(row: Row, scope: Scope) -> Iterator[tuple[str, Field]]:
    """Yield the fields of a row in wire order, with names that are unique in the definition."""
    for index, field in enumerate(wire_order(row, "XTCE")):
        name = f"{row.name}_{field.name or f'unused_{index}'}"
        yield scope.claim(name, f"{row.kind} {row.name}: field {field.name or 'unused'}"), field
