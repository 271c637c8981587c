"""Objects of the communication profile (1000h to 1FFFh), built with `canopen`."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, Final

from canopen.objectdictionary import ObjectDictionary, ODArray, ODRecord, ODVariable, datatypes

from starhil.protocol.canopen.cob import BIT_30, INVALID
from starhil.protocol.canopen.pdo_mapping import LARGEST_MAPPING, Direction
from starhil.protocol.icd.canopen_schema import CanopenModel, PdoModel

U8: Final = datatypes.UNSIGNED8
U16: Final = datatypes.UNSIGNED16
U32: Final = datatypes.UNSIGNED32
DATA_TYPES: Final[dict[str, int]] = {
    "u8": datatypes.UNSIGNED8,
    "i8": datatypes.INTEGER8,
    "u16": datatypes.UNSIGNED16,
    "i16": datatypes.INTEGER16,
    "u24": datatypes.UNSIGNED24,
    "i24": datatypes.INTEGER24,
    "u32": datatypes.UNSIGNED32,
    "i32": datatypes.INTEGER32,
    "u48": datatypes.UNSIGNED48,
    "u64": datatypes.UNSIGNED64,
    "i64": datatypes.INTEGER64,
    "f32": datatypes.REAL32,
    "f64": datatypes.REAL64,
    "bool": datatypes.UNSIGNED8,
    "enum8": datatypes.UNSIGNED8,
    "bytes": datatypes.OCTET_STRING,
    "text": datatypes.VISIBLE_STRING,
    "domain": datatypes.DOMAIN,
}
"""Type in the interface definition → CANopen data type; bool is a byte, as BOOLEAN takes one bit in PDOs."""
RPDO_CAN_IDS: Final = (0x200, 0x300, 0x400, 0x500)
TPDO_CAN_IDS: Final = (0x180, 0x280, 0x380, 0x480)

MappedPdo = tuple[PdoModel, Sequence[int]]
"""Default configuration of a PDO, and its mapping entries: index, sub-index, bits."""


def variable(
    name: str,
    index: int,
    subindex: int,
    data_type: int,
    access: str,
    default: float | str | None = None,
    *,
    relative: bool = False,
    mappable: bool = False,
    limits: tuple[float, float] | None = None,
) -> ODVariable:
    """Return a variable of the object dictionary; `limits` are raw values."""
    item = ODVariable(name, index, subindex)
    item.data_type = data_type
    item.access_type = access
    item.default = default  # type: ignore[assignment]
    item.relative = relative
    item.pdo_mappable = mappable
    if limits is not None:
        set_limits(item, *limits)
    return item


def set_limits(item: ODVariable, low: float, high: float) -> None:
    """Set the lowest and highest raw value (the library's annotation covers integers only)."""
    item.min, item.max = low, high  # type: ignore[assignment]


def add_record(
    od: ObjectDictionary,
    name: str,
    members: Sequence[ODVariable],
    *,
    array: bool = False,
    count: tuple[str, int] | None = None,
) -> None:
    """Add a record or array.

    Sub-index 0 is the highest sub-index, or a writable `count` (name, default).
    """
    index = members[0].index
    group = ODArray(name, index) if array else ODRecord(name, index)
    if count is None:
        highest = max(member.subindex for member in members)
        group.add_member(variable("Highest sub-index supported", index, 0, U8, "const", highest))
    else:
        group.add_member(variable(count[0], index, 0, U8, "rw", count[1]))
    for member in members:
        group.add_member(member)
    od.add_object(group)


def add_communication(
    od: ObjectDictionary, layout: CanopenModel, rpdos: Sequence[MappedPdo], tpdos: Sequence[MappedPdo]
) -> None:
    """Add the whole communication profile to an object dictionary. PDOs are numbered from 1 in order."""
    information = od.device_information
    information.vendor_name = layout.vendor_name
    information.vendor_number = layout.vendor_id
    information.product_name = layout.device_name
    information.product_number = layout.product_code
    information.revision_number = layout.revision
    information.nr_of_RXPDO = len(rpdos)  # type: ignore[assignment]
    information.nr_of_TXPDO = len(tpdos)  # type: ignore[assignment]
    information.allowed_baudrates = set(layout.bit_rates)
    for item in _profile()["variables"]:
        od.add_object(next(_members(layout, item)))
    for item in _profile()["records"]:
        count = (item["count"], 0) if "count" in item else None
        add_record(
            od, item["name"], list(_members(layout, item)), array=item.get("array", False), count=count
        )
    for direction, pdos in ((Direction.RECEIVE, rpdos), (Direction.TRANSMIT, tpdos)):
        for number, (model, mapping) in enumerate(pdos):
            _add_pdo(od, direction, number, model, mapping)


@cache
def _profile() -> dict[str, Any]:
    return tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))


def _members(layout: CanopenModel, record: Mapping[str, Any]) -> Iterator[ODVariable]:
    """Yield the variables of a record of the profile, or the variable that stands alone."""
    first = 1 if "members" in record else 0
    for item in record.get("members", [record]):
        if item.get("optional", False) and getattr(layout, item["from"]) is None:
            continue
        for subindex in range(first, first + item.get("repeat", 1)):
            yield variable(
                item["name"].format(subindex),
                record["index"],
                subindex,
                DATA_TYPES[item["type"]],
                item["access"],
                getattr(layout, item["from"]) if "from" in item else item.get("default"),
                relative=item.get("relative", False),
                mappable=item.get("mappable", False),
                limits=item.get("limits"),
            )
        first = subindex + 1


def _add_pdo(
    od: ObjectDictionary, direction: Direction, number: int, model: PdoModel, mapping: Sequence[int]
) -> None:
    """Add the communication and the mapping parameter of an RPDO or a TPDO."""
    transmits = direction is Direction.TRANSMIT
    kind, predefined = ("TPDO", TPDO_CAN_IDS) if transmits else ("RPDO", RPDO_CAN_IDS)
    index, name = direction + number, f"{kind} {number + 1}"
    can_id = model.can_id or (predefined[number] if number < len(predefined) else 0)
    cob_id = can_id | (BIT_30 if transmits else 0) | (0 if model.enabled else INVALID)
    relative = model.relative and bool(can_id)
    settings = [
        variable(f"COB-ID used by {kind}", index, 1, U32, "rw", cob_id, relative=relative),
        variable("Transmission type", index, 2, U8, "rw", model.transmission_type),
        variable("Event timer", index, 5, U16, "rw", model.event_ms),
    ]
    if transmits:
        settings.insert(2, variable("Inhibit time", index, 3, U16, "rw", round(model.inhibit_ms * 10)))
        settings.append(variable("SYNC start value", index, 6, U8, "rw", 0))
    add_record(od, f"{name} communication parameter: {model.name}", settings)
    index = direction.mapping(number)
    members = [
        variable(f"Mapped object {subindex}", index, subindex, U32, "rw", value)
        for subindex, value in enumerate((*mapping, *[0] * (LARGEST_MAPPING - len(mapping))), 1)
    ]
    count = ("Number of mapped objects", len(mapping))
    add_record(od, f"{name} mapping parameter: {model.name}", members, count=count)
