"""CANopen conformance: the object dictionary of the node compared with its EDS."""

from __future__ import annotations

from functools import partial
from typing import Final

from canopen.objectdictionary import ODVariable, datatypes

from starhil.hil_tests.conformance.canopen_probe import Abort, CanopenProbe, is_integer, size_of
from starhil.hil_tests.conformance.case import CaseArea, CaseSkipped, check, check_equal
from starhil.hil_tests.judge.canopen import multiplexer

OD: Final = CaseArea[CanopenProbe]("canopen.od", "CiA 301 7.2.4.3.17", intrusive=True)
NOT_NOW = {Abort.NO_DATA, Abort.GENERAL, Abort.DEVICE_STATE, Abort.NOT_STORED}
"""Aborts which show that an object exists but has no value at present."""


def _readable(indices: range, probe: CanopenProbe) -> None:
    """Read every object in a range and check the length for its type."""
    for item in probe.variables():
        if item.index not in indices or not item.readable or item.data_type == datatypes.DOMAIN:
            continue
        seen = probe.try_read(item.index, item.subindex)
        where = f"{item.index:04X}h:{item.subindex:02X}h"
        if isinstance(seen, int):
            check(seen in NOT_NOW, f"{where} ({item.qualname}) read", f"abort 0x{seen:08X}")
        elif size_of(item) is not None:
            check_equal(len(seen), size_of(item), f"bytes of {where} ({item.qualname})")


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
    probe.reset_communication()
    for item in probe.variables():
        wanted = is_integer(item) and item.default is not None and item.readable
        if not wanted or item.index >= 0x2000 or item.index in {0x1001, 0x1003, 0x1013}:
            continue
        seen = probe.try_read(item.index, item.subindex)
        if isinstance(seen, bytes):
            check_equal(
                item.decode_raw(seen),
                item.default,
                f"{item.index:04X}h:{item.subindex:02X}h ({item.qualname})",
            )


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
            probe.expect_abort(b"\x40" + multiplexer(item.index, item.subindex), Abort.WRITE_ONLY)


@OD.case("read-only", "read-only and constant objects cannot be written")
def read_only(probe: CanopenProbe) -> None:
    for item in probe.variables():
        if item.access_type in {"ro", "const"}:
            size = min(size_of(item) or 1, 4)
            command = bytes([0x23 | (4 - size) << 2])
            if size_of(item) in {1, 2, 4}:
                probe.expect_abort(command + multiplexer(item.index, item.subindex), Abort.READ_ONLY)


@OD.case("no-object", "objects that are not in the EDS do not exist")
def no_object(probe: CanopenProbe) -> None:
    present = {index for index in probe.od.indices if index >= 0x1000}
    gaps = sorted({near for index in present for near in (index - 1, index + 1) if near >= 0x1000} - present)
    for index in [0x0000, 0x0005, *gaps, 0xFFFF]:
        if index not in present:
            probe.expect_abort(b"\x40" + multiplexer(index, 0), Abort.NO_OBJECT)
            probe.expect_abort(b"\x2f" + multiplexer(index, 0), Abort.NO_OBJECT)


@OD.case("no-sub-index", "sub-indices that are not in the EDS do not exist")
def no_sub_index(probe: CanopenProbe) -> None:
    for index in sorted(probe.od.indices):
        if index < 0x1000:
            continue
        item = probe.od.indices[index]
        beyond = 1 if isinstance(item, ODVariable) else max(item.subindices) + 1
        if beyond < 0xFF:
            probe.expect_abort(b"\x40" + multiplexer(index, beyond), Abort.NO_SUBINDEX)
            probe.expect_abort(b"\x2f" + multiplexer(index, beyond), Abort.NO_SUBINDEX)


@OD.case("length-high", "a value that is too long is refused")
def length_high(probe: CanopenProbe) -> None:
    for item in probe.variables():
        size = size_of(item)
        if item.writable and size is not None and size < 4 and item.index not in {0x1010, 0x1011}:
            command = bytes([0x23 | (3 - size) << 2])
            probe.expect_abort(
                command + multiplexer(item.index, item.subindex), Abort.LENGTH, Abort.LENGTH_HIGH
            )


@OD.case("length-low", "a value that is too short is refused")
def length_low(probe: CanopenProbe) -> None:
    for item in probe.variables():
        size = size_of(item)
        if item.writable and size is not None and 1 < size <= 5:
            command = bytes([0x23 | (5 - size) << 2])
            probe.expect_abort(
                command + multiplexer(item.index, item.subindex), Abort.LENGTH, Abort.LENGTH_LOW
            )


def _bounded(probe: CanopenProbe) -> list[ODVariable]:
    probe.find(
        "object with limits", lambda item: item.writable and (item.min is not None or item.max is not None)
    )
    return [
        item for item in probe.variables() if item.writable and is_integer(item) and (size_of(item) or 9) <= 4
    ]


def _expect_refusal_beyond(probe: CanopenProbe, step: int, code: Abort) -> None:
    """Write the value above (1) or below (-1) the limit of each object, if its type can hold it."""
    for item in _bounded(probe):
        size = size_of(item) or 4
        signed = item.data_type in datatypes.SIGNED_TYPES
        limit = item.max if step > 0 else item.min
        lowest, highest = (-(1 << 8 * size - 1) if signed else 0), (1 << 8 * size - signed) - 1
        if limit is not None and lowest <= int(limit) + step <= highest:
            data = (int(limit) + step).to_bytes(size, "little", signed=signed)
            probe.expect_refusal(item.index, item.subindex, data, size, code, Abort.VALUE)


@OD.case("value-high", "values above the limit are refused")
def value_high(probe: CanopenProbe) -> None:
    _expect_refusal_beyond(probe, 1, Abort.VALUE_HIGH)


@OD.case("value-low", "values below the limit are refused")
def value_low(probe: CanopenProbe) -> None:
    _expect_refusal_beyond(probe, -1, Abort.VALUE_LOW)


@OD.case("write-back", "a written value is read back", "CiA 301 7.2.4.3")
def write_back(probe: CanopenProbe) -> None:
    found = 0
    for item in probe.variables():
        size = size_of(item)
        bounded = item.min is not None and item.max is not None
        if (
            item.index < 0x2000
            or item.access_type != "rw"
            or not is_integer(item)
            or not bounded
            or size not in {1, 2, 4}
        ):
            continue
        before = probe.read(item.index, item.subindex)
        for value in (item.min, item.max):
            data = int(value or 0).to_bytes(
                size or 4, "little", signed=item.data_type in datatypes.SIGNED_TYPES
            )
            if probe.write(item.index, item.subindex, data) == 0:
                found += 1
                check_equal(probe.read(item.index, item.subindex), data, f"{item.qualname}")
        probe.set(item.index, item.subindex, before)
    if not found:
        raise CaseSkipped("the EDS has no object that accepts its limits")
