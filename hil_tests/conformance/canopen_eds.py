"""CANopen conformance: completeness and consistency of the EDS (CiA 306)."""

from __future__ import annotations

import configparser
import re
from typing import Final

from canopen.objectdictionary import ODArray, ODRecord, ODVariable, datatypes

from starhil.hil_tests.conformance.canopen_probe import CanopenProbe, is_integer, size_of
from starhil.hil_tests.conformance.case import CaseArea, CaseFailed, CaseSkipped, check, check_equal
from starhil.hil_tests.judge.canopen import multiplexer

EDS: Final = CaseArea[CanopenProbe]("eds", "CiA 306 4.5")
MANDATORY: Final = (0x1000, 0x1001, 0x1018)
ACCESS: Final = {"ro", "rw", "wo", "const", "rwr", "rww"}
LISTS: Final = ("MandatoryObjects", "OptionalObjects", "ManufacturerObjects")
RESTRICTED_IDS: Final = (
    (0, 0x7F),
    (0x101, 0x180),
    (0x581, 0x5FF),
    (0x601, 0x67F),
    (0x6E0, 0x6FF),
    (0x701, 0x7FF),
)


def _file(probe: CanopenProbe) -> configparser.RawConfigParser:
    if not probe.eds:
        raise CaseSkipped("no EDS file")
    parser = configparser.RawConfigParser(inline_comment_prefixes=(";",), strict=True)
    try:
        parser.read_string(probe.eds)
    except configparser.Error as error:
        check(condition=False, expected="a file of sections with unique keys", seen=error)
    return parser


@EDS.case("mandatory", "mandatory objects are described", "CiA 301 7.5.1")
def mandatory(probe: CanopenProbe) -> None:
    missing = [f"{index:04X}h" for index in MANDATORY if index not in probe.od]
    check(not missing, "1000h, 1001h and 1018h", f"missing {', '.join(missing)}")


@EDS.case("lists", "object lists and sections agree", "CiA 306 4.6.2")
def lists(probe: CanopenProbe) -> None:
    parser = _file(probe)
    listed: list[int] = []
    for name in LISTS:
        if not parser.has_section(name):
            continue
        members = [
            int(parser.get(name, str(number)), 0)
            for number in range(1, parser.getint(name, "SupportedObjects") + 1)
        ]
        manufacturer = [index for index in members if 0x2000 <= index < 0x6000]
        check(
            (name == "ManufacturerObjects") == bool(manufacturer) or not members, f"ranges of {name}", members
        )
        listed += members
    sections = {int(name, 16) for name in parser.sections() if re.fullmatch("[0-9A-Fa-f]{4}", name)}
    check_equal(sorted(listed), sorted(sections), "listed objects")


@EDS.case("types", "every variable has a type, a name and an access", "CiA 306 4.6.3")
def types(probe: CanopenProbe) -> None:
    known = set(ODVariable.STRUCT_TYPES) | set(datatypes.DATA_TYPES)
    known |= {datatypes.TIME_OF_DAY, datatypes.TIME_DIFFERENCE}
    for item in probe.variables():
        check(item.data_type in known, f"known data type of {item.qualname}", item.data_type)
        check(item.access_type in ACCESS, f"known access type of {item.qualname}", item.access_type)
        check(item.name, f"name of {item.index:04X}h:{item.subindex:02X}h", "none")


@EDS.case("limits", "limits and defaults are consistent and fit the type", "CiA 306 4.6.3")
def limits(probe: CanopenProbe) -> None:
    for item in probe.variables():
        if not is_integer(item):
            continue
        bits = 8 * (size_of(item) or 1)
        signed = item.data_type in datatypes.SIGNED_TYPES
        lowest, highest = (-(1 << bits - 1), (1 << bits - 1) - 1) if signed else (0, (1 << bits) - 1)
        low = lowest if item.min is None else item.min
        high = highest if item.max is None else item.max
        check(lowest <= low <= high <= highest, f"limits of {item.qualname} in order", f"{low} to {high}")
        if item.default is not None:
            check(low <= item.default <= high, f"default of {item.qualname} in {low} to {high}", item.default)


@EDS.case("sub-index-0", "sub-index 0 holds the highest sub-index", "CiA 301 7.4.3")
def sub_index_0(probe: CanopenProbe) -> None:
    """Sub-index 0 of records and arrays is an UNSIGNED8; if constant, it is the highest sub-index."""
    for index in sorted(probe.od.indices):
        item = probe.od.indices[index]
        if not isinstance(item, ODRecord | ODArray):
            continue
        check(0 in item.subindices, f"sub-index 0 of {index:04X}h", "none")
        first = item.subindices[0]
        check_equal(first.data_type, datatypes.UNSIGNED8, f"data type of {index:04X}h:00h")
        if first.access_type == "const" or (first.access_type == "ro" and index != 0x1003):
            check_equal(first.default, max(item.subindices), f"highest sub-index of {index:04X}h")


@EDS.case("pdo-count", "the numbers of PDOs agree with the records")
def pdo_count(probe: CanopenProbe) -> None:
    information = probe.od.device_information
    for first, stated in ((0x1400, information.nr_of_RXPDO), (0x1800, information.nr_of_TXPDO)):
        indices = probe.pdo_indices(first)
        check_equal(int(stated or 0), len(indices), f"number of PDOs from {first:04X}h on")
        missing = [f"{index + 0x200:04X}h" for index in indices if index + 0x200 not in probe.od]
        check(not missing, "a mapping record for each PDO", f"missing {missing}")


@EDS.case("mapping", "default mappings name objects that can be mapped", "CiA 301 7.5.2.36")
def mapping(probe: CanopenProbe) -> None:
    for first in (0x1600, 0x1A00):
        for index in probe.pdo_indices(first):
            record = probe.od.indices[index]
            if isinstance(record, ODVariable):
                continue
            total = 0
            for number in range(1, (record.subindices[0].default or 0) + 1):
                value = record.subindices[number].default or 0
                total += value & 0xFF
                if value >> 16 < 0x20:
                    continue
                item = probe.od.get_variable(value >> 16, value >> 8 & 0xFF)
                where = f"{index:04X}h:{number:02X}h"
                check(item is not None, f"{where} names an object of the EDS", f"{value:08X}")
                if item is not None:
                    usable = item.readable if first == 0x1A00 else item.writable
                    check(
                        item.pdo_mappable and usable, f"{item.qualname} can be mapped", f"{where} {value:08X}"
                    )
                    check_equal(value & 0xFF, 8 * (size_of(item) or 0), f"bits of {item.qualname} in {where}")
            check(total <= 64, f"{index:04X}h maps at most 64 bits", total)


@EDS.case("cob-ids", "default CAN IDs are unused, allowed and distinct", "CiA 301 7.3.5")
def cob_ids(probe: CanopenProbe) -> None:
    used: dict[int, str] = {}
    for index in (0x1005, 0x1012, 0x1014, *probe.pdo_indices(0x1400), *probe.pdo_indices(0x1800)):
        item = probe.od.get_variable(index, 0 if index < 0x1400 else 1)
        if item is None or item.default is None or (index >= 0x1014 and item.default >> 31):
            continue
        can_id = item.default & 0x1FFFFFFF
        restricted = any(low <= can_id <= high for low, high in RESTRICTED_IDS)
        check(not restricted, f"CAN ID of {index:04X}h allowed", f"0x{can_id:03X}")
        check(can_id not in used, f"CAN ID of {index:04X}h is unique", used.get(can_id))
        used[can_id] = f"0x{can_id:03X} belongs to {index:04X}h"


@EDS.case("identity", "device information agrees with the identity object")
def identity(probe: CanopenProbe) -> None:
    """Vendor, product and revision number."""
    information = probe.od.device_information
    stated = (information.vendor_number, information.product_number, information.revision_number)
    for subindex, number in enumerate(stated, 1):
        item = probe.od.get_variable(0x1018, subindex)
        if item is not None and item.default is not None and number is not None:
            check_equal(item.default, number, f"1018h:{subindex:02X}h")


@EDS.case("bit-rates", "at least one bit rate is supported")
def bit_rates(probe: CanopenProbe) -> None:
    check(probe.od.device_information.allowed_baudrates, "a supported bit rate", "none")


@EDS.case("stored", "the EDS that the node serves is the one under test", "CiA 301 7.5.2.21")
def stored(probe: CanopenProbe) -> None:
    """1021h, if present, returns the text of the file."""
    item = probe.od.get_variable(0x1021)
    if item is None:
        raise CaseSkipped("the EDS has no object 1021h")
    parser = _file(probe)
    served = configparser.RawConfigParser(inline_comment_prefixes=(";",))
    try:
        data = probe.upload_blocks(multiplexer(item.index, item.subindex), 127)
    except CaseFailed:
        probe.abandon_transfer()
        data = probe.read(0x1021)
    served.read_string(data.decode("ascii", errors="replace"))
    for name in parser.sections():
        if name != "FileInfo":
            check(served.has_section(name), f"section {name} in 1021h", "none")
            check_equal(dict(served.items(name)), dict(parser.items(name)), f"section {name}")
