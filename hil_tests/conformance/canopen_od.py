"""CANopen conformance: the object dictionary of the node compared with its EDS."""

from __future__ import annotations

from functools import partial
from typing import Final

from canopen.objectdictionary import ODVariable, datatypes

from starhil.hil_tests.conformance.canopen_probe import Abort, CanopenProbe, encoded, is_integer, size_of
from starhil.hil_tests.conformance.case import CaseArea, CaseSkipped, check, check_equal

OD: Final = CaseArea[CanopenProbe]("od", "CiA 301 7.2.4.3.17", intrusive=True)
NO_VALUE_ABORTS = {Abort.NO_DATA, Abort.GENERAL, Abort.DEVICE_STATE, Abort.NOT_STORED}
"""Aborts which show that an object exists but has no value at present."""


def _readable(indices: range, probe: CanopenProbe) -> None:
    """Read every object in a range and check the length for its type."""
    for item in probe.variables():
        if item.index not in indices or not item.readable or item.data_type == datatypes.DOMAIN:
            continue
        result = probe.try_read(item.index, item.subindex)
        where = f"{item.index:04X}h:{item.subindex:02X}h"
        if isinstance(result, int):
            check(result in NO_VALUE_ABORTS, f"{where} ({item.qualname}) read", f"abort 0x{result:08X}")
        elif size_of(item) is not None:
            check_equal(len(result), size_of(item), f"bytes of {where} ({item.qualname})")


for _name, _what, _clause, _indices in (
    ("communication", "communication profile", "CiA 301 7.5.2", range(0x1000, 0x2000)),
    ("manufacturer", "manufacturer", "CiA 301 7.4.1", range(0x2000, 0x6000)),
    ("profile", "device profile area", "CiA 301 7.4.1", range(0x6000, 0xA000)),
):
    OD.case(_name, f"every object of the {_what} can be read", _clause, intrusive=False)(
        partial(_readable, _indices)
    )


@OD.case("defaults", "after a reset the values are the defaults in the EDS", "CiA 301 7.5.2")
def defaults(probe: CanopenProbe) -> None:
    """Checks integers of the communication profile, after `load` has cleared stored parameters."""
    if 0x1011 in probe.od:
        probe.set(0x1011, 1, b"load")
    probe.reset_to_stored_values()
    for item in probe.variables():
        wanted = is_integer(item) and item.default is not None and item.readable
        if not wanted or item.index >= 0x2000 or item.index in {0x1001, 0x1003, 0x1013}:
            continue
        seen = probe.try_read(item.index, item.subindex)
        if isinstance(seen, bytes):
            number = int.from_bytes(seen, "little", signed=item.data_type in datatypes.SIGNED_TYPES)
            check_equal(number, item.default, f"{item.index:04X}h:{item.subindex:02X}h ({item.qualname})")


@OD.case("texts", "names and versions agree with the EDS", "CiA 301 7.5.2.7", intrusive=False)
def texts(probe: CanopenProbe) -> None:
    """1008h to 100Ah, if the EDS has them."""
    for index in (0x1008, 0x1009, 0x100A):
        item = probe.od.get_variable(index)
        if item is not None and item.default is not None:
            check_equal(
                probe.read(index).decode("ascii", errors="replace"), str(item.default), f"{index:04X}h"
            )


@OD.case("identity", "the identity agrees with the EDS", "CiA 301 7.5.2.19", intrusive=False)
def identity(probe: CanopenProbe) -> None:
    """1000h and 1018h."""
    for index, subindex in ((0x1000, 0), (0x1018, 1), (0x1018, 2), (0x1018, 3)):
        item = probe.od.get_variable(index, subindex)
        if item is not None and item.default is not None:
            check_equal(probe.number(index, subindex), item.default, f"{index:04X}h:{subindex:02X}h")


@OD.case("sub-index-0", "sub-index 0 of a record is the highest sub-index", "CiA 301 7.4.3", intrusive=False)
def sub_index_0(probe: CanopenProbe) -> None:
    """Every record and array whose sub-index 0 is constant."""
    for item in probe.variables():
        group = probe.od.indices[item.index]
        if item.subindex == 0 and item.access_type == "const" and not isinstance(group, ODVariable):
            check_equal(probe.number(item.index, 0), max(group.subindices), f"{item.index:04X}h:00h")


@OD.case("write-only", "write-only objects cannot be read", intrusive=False)
def write_only(probe: CanopenProbe) -> None:
    probe.find("write-only object", lambda item: item.access_type == "wo")
    for item in probe.variables():
        if item.access_type == "wo":
            probe.expect_unreadable(item.index, item.subindex, Abort.WRITE_ONLY)


@OD.case("read-only", "read-only and constant objects cannot be written")
def read_only(probe: CanopenProbe) -> None:
    for item in probe.variables():
        size = size_of(item) or 0
        if item.access_type in {"ro", "const"} and size in {1, 2, 4}:
            probe.expect_refusal(item.index, item.subindex, bytes(size), Abort.READ_ONLY)


def _check_missing(probe: CanopenProbe, index: int, subindex: int, code: Abort) -> None:
    probe.expect_unreadable(index, subindex, code)
    probe.expect_refusal(index, subindex, b"\0", code)


@OD.case("no-object", "objects that are not in the EDS do not exist")
def no_object(probe: CanopenProbe) -> None:
    present = {index for index in probe.od.indices if index >= 0x1000}
    gaps = {near for index in present for near in (index - 1, index + 1) if near >= 0x1000} - present
    for index in (0x0000, 0x0005, *sorted(gaps), *({0xFFFF} - present)):
        _check_missing(probe, index, 0, Abort.NO_OBJECT)


@OD.case("no-sub-index", "sub-indices that are not in the EDS do not exist")
def no_sub_index(probe: CanopenProbe) -> None:
    for index in sorted(index for index in probe.od.indices if index >= 0x1000):
        item = probe.od.indices[index]
        beyond = 1 if isinstance(item, ODVariable) else max(item.subindices) + 1
        if beyond < 0xFF:
            _check_missing(probe, index, beyond, Abort.NO_SUBINDEX)


def _wrong_length(longer: int, code: Abort, probe: CanopenProbe) -> None:
    """Write each object of 1 to 4 bytes with a byte more or less, announced by the command of the transfer."""
    for item in probe.variables():
        size = (size_of(item) or 0) + longer
        signature = longer > 0 and item.index in {0x1010, 0x1011}
        if item.writable and 1 + (longer > 0) <= size <= 4 and not signature:
            probe.expect_refusal(item.index, item.subindex, bytes(size), Abort.LENGTH, code)


for _name, _word, _longer, _code in (
    ("length-high", "long", 1, Abort.LENGTH_HIGH),
    ("length-low", "short", -1, Abort.LENGTH_LOW),
):
    OD.case(_name, f"a value that is too {_word} is refused")(partial(_wrong_length, _longer, _code))


def _bounded(probe: CanopenProbe) -> list[ODVariable]:
    probe.find(
        "object with limits", lambda item: item.writable and (item.min is not None or item.max is not None)
    )
    return [
        item for item in probe.variables() if item.writable and is_integer(item) and (size_of(item) or 9) <= 4
    ]


def _beyond_limits(step: int, code: Abort, probe: CanopenProbe) -> None:
    """Write the value above (1) or below (-1) the limit of each object, if its type can hold it."""
    for item in _bounded(probe):
        size = size_of(item) or 4
        signed = item.data_type in datatypes.SIGNED_TYPES
        limit = item.max if step > 0 else item.min
        lowest, highest = (-(1 << 8 * size - 1) if signed else 0), (1 << 8 * size - signed) - 1
        if limit is not None and lowest <= int(limit) + step <= highest:
            data = encoded(item, int(limit) + step)
            probe.expect_refusal(item.index, item.subindex, data, code, Abort.VALUE)


for _name, _word, _step, _code in (
    ("value-high", "above", 1, Abort.VALUE_HIGH),
    ("value-low", "below", -1, Abort.VALUE_LOW),
):
    OD.case(_name, f"values {_word} the limit are refused")(partial(_beyond_limits, _step, _code))


@OD.case("write-back", "a written value is read back", "CiA 301 7.2.4.3")
def write_back(probe: CanopenProbe) -> None:
    written = 0
    for item in probe.variables():
        bounded = is_integer(item) and item.min is not None and item.max is not None
        if item.index < 0x2000 or item.access_type != "rw" or not bounded or size_of(item) not in {1, 2, 4}:
            continue
        before = probe.value(item)
        for limit in (item.min, item.max):
            data = encoded(item, int(limit or 0))
            if probe.write(item.index, item.subindex, data) == 0:
                written += 1
                check_equal(probe.value(item), data, f"{item.qualname}")
        probe.put(item, before)
    if not written:
        raise CaseSkipped("the EDS has no object that accepts its limits")
