"""The interface definition as XTCE 1.2 (XML Telemetric and Command Exchange).

A packet is the ID of a row followed by its data; in a unit with classes, the code of the class is the upper
byte of the ID.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Final
from xml.etree import ElementTree as ET

from starhil.protocol.codec import Field, Row
from starhil.protocol.definition import InterfaceDefinition
from starhil.protocol.export.describe import meaning, number
from starhil.protocol.export.packets import key_bits, key_of, wire_order
from starhil.protocol.quoting import Scope, one_line, xtce_name

NAMESPACE: Final = "http://www.omg.org/spec/XTCE/20180204"
PACKET: Final = "Packet"
IDENTIFIER: Final = "identifier"

_ORDERS: Final = {"little": "leastSignificantByteFirst", "big": "mostSignificantByteFirst"}


def render(icd: InterfaceDefinition) -> str:
    """Return the XML text. Raises IcdError for equal names, and for bits that XTCE cannot express."""
    system = ET.Element("SpaceSystem", {"name": xtce_name(icd.name), "xmlns": NAMESPACE} | _short(icd.doc))
    about = {"version": one_line(icd.version), "date": "2026-01-01", "validationStatus": "Working"}
    ET.SubElement(system, "Header", about)
    scope = Scope("XTCE", [IDENTIFIER, PACKET])
    for row in icd.rows:
        scope.claim(row.name, f"{row.kind} {row.name}")
        if row.kind == "telecommand":
            scope.claim(f"{row.name}_packet", f"{row.kind} {row.name}")
    if icd.telemetry:
        _telemetry(ET.SubElement(system, "TelemetryMetaData"), icd, scope)
    if icd.telecommands:
        _commands(ET.SubElement(system, "CommandMetaData"), icd, scope)
    ET.indent(system)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(system, encoding="unicode") + "\n"


def _telemetry(parent: ET.Element, icd: InterfaceDefinition, scope: Scope) -> None:
    types = ET.SubElement(parent, "ParameterTypeSet")
    parameters = ET.SubElement(parent, "ParameterSet")
    containers = ET.SubElement(parent, "ContainerSet")
    _unsigned(
        ET.SubElement(types, "IntegerParameterType", {"name": f"{IDENTIFIER}_type", "signed": "false"}),
        key_bits(icd),
    )
    ET.SubElement(
        parameters,
        "Parameter",
        {
            "name": IDENTIFIER,
            "parameterTypeRef": f"{IDENTIFIER}_type",
            "shortDescription": "Telemetry identifier.",
        },
    )
    root = ET.SubElement(containers, "SequenceContainer", {"name": PACKET, "abstract": "true"})
    _entries(root, "Parameter", [IDENTIFIER])
    for row in (row for row in icd.rows if row.kind == "telemetry"):
        names = []
        for name, field in _fields(row, scope):
            names.append(name)
            _type(types, "Parameter", name, field)
            about = {"name": name, "parameterTypeRef": f"{name}_type"}
            ET.SubElement(parameters, "Parameter", about | _short(meaning(row, field)))
        container = ET.SubElement(containers, "SequenceContainer", {"name": row.name} | _short(row.doc))
        _entries(container, "Parameter", names)
        base = ET.SubElement(container, "BaseContainer", {"containerRef": PACKET})
        criteria = ET.SubElement(base, "RestrictionCriteria")
        ET.SubElement(criteria, "Comparison", {"parameterRef": IDENTIFIER, "value": str(key_of(icd, row))})


def _commands(parent: ET.Element, icd: InterfaceDefinition, scope: Scope) -> None:
    types = ET.SubElement(parent, "ArgumentTypeSet")
    commands = ET.SubElement(parent, "MetaCommandSet")
    if not any(row.named_fields for row in icd.telecommands.values()):
        parent.remove(types)
    for row in (row for row in icd.rows if row.kind == "telecommand"):
        command = ET.SubElement(commands, "MetaCommand", {"name": row.name} | _short(row.doc))
        arguments = list(_fields(row, scope))
        if any(field.name for _, field in arguments):
            listed = ET.SubElement(command, "ArgumentList")
            for name, field in arguments:
                if field.name:
                    _type(types, "Argument", name, field)
                    about = {"name": field.name, "argumentTypeRef": f"{name}_type"}
                    if field.default is not None:
                        about["initialValue"] = _initial(field)
                    ET.SubElement(listed, "Argument", about | _short(meaning(row, field)))
        container = ET.SubElement(command, "CommandContainer", {"name": f"{row.name}_packet"})
        entries = ET.SubElement(container, "EntryList")
        _fixed(entries, "identifier", key_of(icd, row), key_bits(icd))
        for name, field in arguments:
            if field.name:
                ET.SubElement(entries, "ArgumentRefEntry", {"argumentRef": field.name})
            else:
                _fixed(entries, name, 0, field.bit_count)


def _fixed(entries: ET.Element, name: str, value: int, bits: int) -> None:
    size = -(-bits // 8)
    ET.SubElement(
        entries,
        "FixedValueEntry",
        {"name": name, "binaryValue": value.to_bytes(size, "big").hex().upper(), "sizeInBits": str(bits)},
    )


def _entries(container: ET.Element, kind: str, names: Iterable[str]) -> None:
    entries = ET.SubElement(container, "EntryList")
    for name in names:
        ET.SubElement(entries, f"{kind}RefEntry", {f"{kind.lower()}Ref": name})


def _type(types: ET.Element, what: str, name: str, field: Field) -> None:
    """Add the type of a parameter or argument."""
    about = {"name": f"{name}_type"}
    if field.slot.type == "bytes":
        kind = ET.SubElement(types, f"Binary{what}Type", about)
        _unit(kind, field)
        size = ET.SubElement(ET.SubElement(kind, "BinaryDataEncoding"), "SizeInBits")
        ET.SubElement(size, "FixedValue").text = str(8 * field.size)
        return
    if field.kind == "float":
        bits = {"sizeInBits": str(8 * field.size)}
        kind = ET.SubElement(types, f"Float{what}Type", about | bits)
        _unit(kind, field)
        encoding = ET.SubElement(
            kind,
            "FloatDataEncoding",
            bits | {"encoding": "IEEE754_1985", "byteOrder": _ORDERS[field.slot.order]},
        )
        _calibrator(encoding, field)
    elif field.enum is not None:
        kind = ET.SubElement(types, f"Enumerated{what}Type", about)
        _integer(kind, field)
        members = ET.SubElement(kind, "EnumerationList")
        for label, value in field.enum.values.items():
            ET.SubElement(members, "Enumeration", {"value": str(value), "label": one_line(label)})
        return
    elif field.kind == "flag":
        _integer(ET.SubElement(types, f"Boolean{what}Type", about), field)
        return
    elif field.scaled:
        kind = ET.SubElement(types, f"Float{what}Type", about | {"sizeInBits": "64"})
        _integer(kind, field)
    else:
        signed = str(_signed(field)).lower()
        kind = ET.SubElement(types, f"Integer{what}Type", about | {"signed": signed})
        _integer(kind, field)
    if what == "Argument" and (field.minimum is not None or field.maximum is not None):
        _range(kind, field)


def _integer(kind: ET.Element, field: Field) -> None:
    """Add the unit, encoding and scale of an integer."""
    _unit(kind, field)
    encoding = ET.SubElement(
        kind,
        "IntegerDataEncoding",
        {
            "sizeInBits": str(field.bit_count),
            "encoding": "twosComplement" if _signed(field) else "unsigned",
            "byteOrder": _ORDERS[field.slot.order],
        },
    )
    _calibrator(encoding, field)


def _calibrator(encoding: ET.Element, field: Field) -> None:
    """Add the scale of a number."""
    if field.scaled:
        calibrator = ET.SubElement(ET.SubElement(encoding, "DefaultCalibrator"), "PolynomialCalibrator")
        ET.SubElement(calibrator, "Term", {"coefficient": number(field.bias), "exponent": "0"})
        ET.SubElement(calibrator, "Term", {"coefficient": number(field.scale), "exponent": "1"})


def _unsigned(kind: ET.Element, bits: int) -> None:
    ET.SubElement(kind, "UnitSet")
    ET.SubElement(kind, "IntegerDataEncoding", {"sizeInBits": str(bits), "encoding": "unsigned"})


def _range(kind: ET.Element, field: Field) -> None:
    low, high = field.physical_limits
    ranges = ET.SubElement(kind, "ValidRangeSet")
    ET.SubElement(ranges, "ValidRange", {"minInclusive": number(low), "maxInclusive": number(high)})


def _unit(kind: ET.Element, field: Field) -> None:
    units = ET.SubElement(kind, "UnitSet")
    if field.unit:
        ET.SubElement(units, "Unit").text = one_line(field.unit)


def _signed(field: Field) -> bool:
    return not field.width and field.type.startswith("i")


def _short(doc: str) -> dict[str, str]:
    return {"shortDescription": one_line(doc)} if doc else {}


def _initial(field: Field) -> str:
    """Return the default value; that of a string in hexadecimal."""
    if field.slot.type == "bytes" and isinstance(field.default, str):
        return field.default.encode("ascii").ljust(field.size, b"\0").hex()
    return one_line(str(field.default))


def _fields(row: Row, scope: Scope) -> Iterator[tuple[str, Field]]:
    """Yield the fields of a row in wire order, with names that are unique in the definition."""
    for index, field in enumerate(wire_order(row, "XTCE")):
        name = f"{row.name}_{field.name or f'unused_{index}'}"
        yield scope.claim(name, f"{row.kind} {row.name}: field {field.name or 'unused'}"), field
