"""The interface definition as XTCE 1.2 (XML Telemetric and Command Exchange).

A packet is the ID of a row followed by its data; in a unit with classes, the code of the class is the upper
byte of the ID.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from typing import Final
from xml.etree import ElementTree as ET

from starhil.protocol.codec import Field, Row
from starhil.protocol.export.describe import meaning, number
from starhil.protocol.export.row_key import key_bits, key_of
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.values import IcdError

NAMESPACE: Final = "http://www.omg.org/spec/XTCE/20180204"
PACKET: Final = "Packet"
IDENTIFIER: Final = "identifier"

_ORDERS: Final = {"little": "leastSignificantByteFirst", "big": "mostSignificantByteFirst"}


def render(icd: InterfaceDefinition) -> str:
    """Return the XML text. Raises IcdError for bits across bytes, which XTCE cannot express."""
    name = re.sub("[.:/ ]", "_", icd.name)  # as XTCE has names
    system = ET.Element("SpaceSystem", {"name": name, "xmlns": NAMESPACE, "shortDescription": icd.doc})
    ET.SubElement(
        system, "Header", {"version": icd.version, "date": "2026-01-01", "validationStatus": "Working"}
    )
    if icd.telemetry:
        _telemetry(ET.SubElement(system, "TelemetryMetaData"), icd)
    if icd.telecommands:
        _commands(ET.SubElement(system, "CommandMetaData"), icd)
    ET.indent(system)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(system, encoding="unicode") + "\n"


def wire_order(row: Row) -> Iterator[Field]:
    """Yield the fields of a row in wire order, most significant bit of each byte first."""
    for slot in row.slots:
        fields = [field for field in row.fields if field.slot is slot]
        bytes_in_order = range(slot.size) if slot.order == "little" else reversed(range(slot.size))
        for byte in bytes_in_order if fields[0].width else (0,):
            within = [field for field in fields if not field.width or field.shift // 8 == byte]
            for field in within:
                if field.width and (field.shift % 8) + field.width > 8:
                    raise IcdError(f"{row.name}.{field.name}: bits across bytes cannot be exported")
            yield from sorted(within, key=lambda field: -field.shift)


def _telemetry(parent: ET.Element, icd: InterfaceDefinition) -> None:
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
        for index, field in enumerate(wire_order(row)):
            name = _name(row, field, index)
            names.append(name)
            _type(types, "Parameter", name, field)
            about = {"name": name, "parameterTypeRef": f"{name}_type"}
            ET.SubElement(parameters, "Parameter", about | _short(meaning(row, field)))
        container = ET.SubElement(containers, "SequenceContainer", {"name": row.name} | _short(row.doc))
        _entries(container, "Parameter", names)
        base = ET.SubElement(container, "BaseContainer", {"containerRef": PACKET})
        criteria = ET.SubElement(base, "RestrictionCriteria")
        ET.SubElement(criteria, "Comparison", {"parameterRef": IDENTIFIER, "value": str(key_of(icd, row))})


def _commands(parent: ET.Element, icd: InterfaceDefinition) -> None:
    types = ET.SubElement(parent, "ArgumentTypeSet")
    commands = ET.SubElement(parent, "MetaCommandSet")
    if not any(row.named_fields for row in icd.telecommands.values()):
        parent.remove(types)
    for row in (row for row in icd.rows if row.kind == "telecommand"):
        command = ET.SubElement(commands, "MetaCommand", {"name": row.name} | _short(row.doc))
        arguments = [(_name(row, field, index), field) for index, field in enumerate(wire_order(row))]
        if any(field.name for _, field in arguments):
            listed = ET.SubElement(command, "ArgumentList")
            for name, field in arguments:
                if field.name:
                    _type(types, "Argument", name, field)
                    about = {"name": field.name, "argumentTypeRef": f"{name}_type"}
                    if field.default is not None:
                        about["initialValue"] = str(field.default)
                    ET.SubElement(listed, "Argument", about | _short(meaning(row, field)))
        container = ET.SubElement(command, "CommandContainer", {"name": f"{row.name}_packet"})
        entries = ET.SubElement(container, "EntryList")
        _fixed(entries, "identifier", key_of(icd, row), key_bits(icd))
        for name, field in arguments:
            if field.name:
                ET.SubElement(entries, "ArgumentRefEntry", {"argumentRef": field.name})
            else:
                _fixed(entries, name, 0, _bits(field))


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
            ET.SubElement(members, "Enumeration", {"value": str(value), "label": label})
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
            "sizeInBits": str(_bits(field)),
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
        ET.SubElement(units, "Unit").text = field.unit


def _bits(field: Field) -> int:
    return field.width or 8 * field.size


def _signed(field: Field) -> bool:
    return not field.width and field.type.startswith("i")


def _short(doc: str) -> dict[str, str]:
    return {"shortDescription": doc} if doc else {}


def _name(row: Row, field: Field, index: int) -> str:
    """Return a name for a field that is unique in the definition."""
    return f"{row.name}_{field.name or f'unused_{index}'}"
