"""Objects of the communication profile (1000h to 1FFFh), built with `canopen`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from canopen.objectdictionary import ObjectDictionary, ODArray, ODRecord, ODVariable, datatypes

from starhil.protocol.canopen.cob import BIT_30, EMERGENCY, INVALID, SDO_RECEIVE, SDO_TRANSMIT, SYNC, TIME
from starhil.protocol.canopen.pdo_mapping import LARGEST_MAPPING
from starhil.protocol.canopen_schema import CanopenModel, PdoModel

U8: Final = datatypes.UNSIGNED8
U16: Final = datatypes.UNSIGNED16
U32: Final = datatypes.UNSIGNED32
TEXT: Final = datatypes.VISIBLE_STRING
DOMAIN: Final = datatypes.DOMAIN

VERSION: Final = "1"
"""Hardware and software version of the node."""
SERIAL_NUMBER: Final = 1
HISTORY_LENGTH: Final = 8
CONSUMERS: Final = 4
HEARTBEAT_MS: Final = 1000
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
    """Add the whole communication profile.

    Parameters
    ----------
    od
        Object dictionary to which the objects are added.
    layout
        Identity of the node, and its bit rates.
    rpdos, tpdos
        The PDOs, numbered from 1.
    """
    information = od.device_information
    information.vendor_name = layout.vendor_name
    information.vendor_number = layout.vendor_id
    information.product_name = layout.device_name
    information.product_number = layout.product_code
    information.revision_number = layout.revision
    information.order_code = ""
    information.simple_boot_up_master = False
    information.simple_boot_up_slave = True
    information.granularity = 8
    information.dynamic_channels_supported = False
    information.group_messaging = False
    information.nr_of_RXPDO = len(rpdos)  # type: ignore[assignment]
    information.nr_of_TXPDO = len(tpdos)  # type: ignore[assignment]
    information.LSS_supported = True
    information.allowed_baudrates = set(layout.bit_rates)
    _add_general(od, layout)
    _add_messages(od)
    _add_services(od, layout)
    for kind, pdos in (("RPDO", rpdos), ("TPDO", tpdos)):
        for number, (model, mapping) in enumerate(pdos):
            _add_pdo(od, kind, number, model, mapping)


def _add_general(od: ObjectDictionary, layout: CanopenModel) -> None:
    for item in (
        variable("Device type", 0x1000, 0, U32, "ro", layout.device_type),
        variable("Error register", 0x1001, 0, U8, "ro", 0, mappable=True),
        variable("Manufacturer device name", 0x1008, 0, TEXT, "const", layout.device_name),
        variable("Manufacturer hardware version", 0x1009, 0, TEXT, "const", VERSION),
        variable("Manufacturer software version", 0x100A, 0, TEXT, "const", VERSION),
    ):
        od.add_object(item)
    errors = [
        variable(f"Standard error field {number}", 0x1003, number, U32, "ro", 0)
        for number in range(1, HISTORY_LENGTH + 1)
    ]
    add_record(od, "Pre-defined error field", errors, array=True, count=("Number of errors", 0))
    for index, name, verb in (
        (0x1010, "Store parameters", "Store"),
        (0x1011, "Restore default parameters", "Restore"),
    ):
        groups = [
            variable(f"{verb} {group} parameters", index, subindex, U32, "rw", 1)
            for subindex, group in enumerate(("all", "communication", "application"), 1)
        ]
        add_record(od, name, groups, array=True)


def _add_messages(od: ObjectDictionary) -> None:
    for item in (
        variable("COB-ID SYNC message", 0x1005, 0, U32, "rw", SYNC),
        variable("Communication cycle period", 0x1006, 0, U32, "rw", 0),
        variable("Guard time", 0x100C, 0, U16, "rw", 0),
        variable("Life time factor", 0x100D, 0, U8, "rw", 0),
        variable("COB-ID time stamp message", 0x1012, 0, U32, "rw", INVALID | TIME),
        variable("High resolution time stamp", 0x1013, 0, U32, "rw", mappable=True),
        variable("COB-ID emergency message", 0x1014, 0, U32, "rw", EMERGENCY, relative=True),
        variable("Inhibit time emergency", 0x1015, 0, U16, "rw", 0),
        variable("Producer heartbeat time", 0x1017, 0, U16, "rw", HEARTBEAT_MS),
        variable("Synchronous counter overflow value", 0x1019, 0, U8, "rw", 0),
    ):
        od.add_object(item)
    consumers = [
        variable(f"Consumer heartbeat time {number}", 0x1016, number, U32, "rw", 0)
        for number in range(1, CONSUMERS + 1)
    ]
    add_record(od, "Consumer heartbeat time", consumers, array=True)
    behaviour = variable("Communication error", 0x1029, 1, U8, "rw", 0, limits=(0, 2))
    add_record(od, "Error behaviour", [behaviour], array=True)


def _add_services(od: ObjectDictionary, layout: CanopenModel) -> None:
    numbers = (layout.vendor_id, layout.product_code, layout.revision, SERIAL_NUMBER)
    names = ("Vendor-ID", "Product code", "Revision number", "Serial number")
    members = [
        variable(name, 0x1018, subindex, U32, "ro", number)
        for subindex, (name, number) in enumerate(zip(names, numbers, strict=True), 1)
    ]
    add_record(od, "Identity object", members)
    od.add_object(variable("Store EDS", 0x1021, 0, DOMAIN, "ro"))
    od.add_object(variable("Store format", 0x1022, 0, U8, "ro", 0))
    add_record(
        od,
        "SDO server parameter",
        [
            variable("COB-ID client to server (receive)", 0x1200, 1, U32, "ro", SDO_RECEIVE, relative=True),
            variable("COB-ID server to client (transmit)", 0x1200, 2, U32, "ro", SDO_TRANSMIT, relative=True),
        ],
    )


def _add_pdo(od: ObjectDictionary, kind: str, number: int, model: PdoModel, mapping: Sequence[int]) -> None:
    """Add the communication and the mapping parameter of an RPDO or a TPDO."""
    transmits = kind == "TPDO"
    first, predefined = (0x1800, TPDO_CAN_IDS) if transmits else (0x1400, RPDO_CAN_IDS)
    index, name = first + number, f"{kind} {number + 1}"
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
    index += 0x200
    members = [
        variable(f"Mapped object {subindex}", index, subindex, U32, "rw", value)
        for subindex, value in enumerate((*mapping, *[0] * (LARGEST_MAPPING - len(mapping))), 1)
    ]
    count = ("Number of mapped objects", len(mapping))
    add_record(od, f"{name} mapping parameter: {model.name}", members, count=count)
