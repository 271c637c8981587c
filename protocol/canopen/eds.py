"""The electronic data sheet (EDS, CiA 306) of a node, generated from its object dictionary.

`canopen.export_od` is not used because it writes the current time, and entries that EDS checkers reject.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final

from canopen.objectdictionary import ODArray, ODRecord, ODVariable, datatypes

from starhil.protocol.canopen.dictionary import Dictionary, encode
from starhil.protocol.icd.quoting import Scope, eds_text

MANDATORY: Final = (0x1000, 0x1001, 0x1018)
MANUFACTURER: Final = range(0x2000, 0x6000)
BIT_RATES_KBIT: Final = (10, 20, 50, 125, 250, 500, 800, 1000)
VARIABLE: Final = 0x7
DOMAIN: Final = 0x2
ARRAY: Final = 0x8
RECORD: Final = 0x9
HEAD: Final = Path(__file__).with_name("head.eds")


def build_eds(dictionary: Dictionary) -> str:
    """Return the EDS of an object dictionary.

    Raises IcdError for two objects, or two entries of an object, with the same name.
    """
    scope = Scope("EDS")
    lists: dict[str, list[int]] = {"MandatoryObjects": [], "OptionalObjects": [], "ManufacturerObjects": []}
    for index in sorted(dictionary.od.indices):
        kind = "Mandatory" if index in MANDATORY else "Manufacturer" if index in MANUFACTURER else "Optional"
        lists[f"{kind}Objects"].append(index)
    text = _head(dictionary)
    for name, members in lists.items():
        numbered = {str(number): f"0x{index:04X}" for number, index in enumerate(members, 1)}
        text += _section(name, {"SupportedObjects": str(len(members))} | numbered)
        for index in members:
            item = dictionary.od.indices[index]
            scope.claim(eds_text(item.name), f"object {index:04X}h")
            text += "".join(_object(item))
    return text


def _head(dictionary: Dictionary) -> str:
    """Return the sections about file and device, whose date is constant: a dictionary always yields the same text."""
    information = dictionary.od.device_information
    rates = {rate // 1000 for rate in information.allowed_baudrates}
    return HEAD.read_text(encoding="ascii").format(
        vendor=eds_text(information.vendor_name or ""),
        vendor_number=information.vendor_number,
        product=eds_text(information.product_name or ""),
        product_number=information.product_number,
        revision=information.revision_number,
        rpdos=information.nr_of_RXPDO,
        tpdos=information.nr_of_TXPDO,
        **{f"baud_{rate}": int(rate in rates) for rate in BIT_RATES_KBIT},
    )


def _section(name: str, entries: Mapping[str, str], remark: str = "") -> str:
    comment = f"; {eds_text(remark)}\n" if remark else ""
    return (
        f"{comment}[{name}]\n"
        + "".join(f"{key}={eds_text(value)}\n" for key, value in entries.items())
        + "\n"
    )


def _object(item: ODVariable | ODRecord | ODArray) -> Iterator[str]:
    """Yield the section of an object, and those of its members."""
    if isinstance(item, ODVariable):
        yield _section(f"{item.index:04X}", _variable(item), _remark(item))
        return
    kind = ARRAY if isinstance(item, ODArray) else RECORD
    count = f"0x{len(item.subindices):X}"
    entries = {"ParameterName": item.name, "ObjectType": f"0x{kind:X}", "SubNumber": count}
    yield _section(f"{item.index:04X}", entries)
    scope = Scope("EDS")
    for subindex, member in sorted(item.subindices.items()):
        scope.claim(eds_text(member.name), f"object {item.index:04X}h, sub-index {subindex}")
        yield _section(f"{item.index:04X}sub{subindex:X}", _variable(member), _remark(member))


def _remark(item: ODVariable) -> str:
    names = ", ".join(f"{number} {name}" for number, name in item.value_descriptions.items())
    scale = f"raw * {item.factor:.10g} " if item.factor != 1 else ""
    unit = f"[{scale}{item.unit}]" if scale or item.unit else ""
    return " ".join(part for part in (item.description, unit, f"({names})" if names else "") if part)


def _variable(item: ODVariable) -> dict[str, str]:
    data_type = item.data_type or 0
    entries = {
        "ParameterName": item.name,
        "ObjectType": f"0x{DOMAIN if data_type == datatypes.DOMAIN else VARIABLE:X}",
        "DataType": f"0x{data_type:04X}",
        "AccessType": item.access_type,
    }
    if item.default is not None:
        entries["DefaultValue"] = _default(item, data_type)
    limits = {"LowLimit": item.min, "HighLimit": item.max} if data_type in datatypes.INTEGER_TYPES else {}
    entries |= {key: str(int(limit)) for key, limit in limits.items() if limit is not None}
    return entries | {"PDOMapping": str(int(item.pdo_mappable))}


def _default(item: ODVariable, data_type: int) -> str:
    if data_type in datatypes.FLOAT_TYPES:
        return "0x" + encode(item, item.default or 0)[::-1].hex().upper()
    if not isinstance(item.default, int):
        return str(item.default)
    number = f"0x{item.default:X}" if item.default >= 0 else str(item.default)
    return f"$NODEID+{number}" if item.relative else number
