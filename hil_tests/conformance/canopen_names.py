"""Names in braces of a dialogue: suitable objects of the node, their values, and CAN IDs.

Related names are found together, before the first request of the dialogue; if the EDS has no object for one of them, the
case is skipped. Multiplexers, data and CAN IDs are in hexadecimal, mapping entries with `0x`.
"""

from __future__ import annotations

from binascii import crc_hqx
from collections.abc import Callable, Iterator
from functools import partial
from typing import Final

from canopen.objectdictionary import ODVariable, datatypes

from starhil.hil_tests.conformance.canopen_probe import (
    FIRST_OWN_OBJECT,
    WATCHED_NODE,
    CanopenProbe,
    encoded,
    is_integer,
    size_of,
)
from starhil.hil_tests.conformance.case import CaseSkipped
from starhil.hil_tests.judge.canopen import (
    HEARTBEAT,
    SDO_REQUEST,
    SDO_RESPONSE,
    SEGMENT,
    SYNC,
    multiplexer,
    upload_request,
)

RPDO: Final = 0x1400
TPDO: Final = 0x1800
"""Indices of the first communication records."""
RESTRICTED_IDS: Final = (0x000, 0x07F, 0x101, 0x180, 0x581, 0x5FF, 0x601, 0x67F, 0x6E0, 0x6FF, 0x701, 0x7FF)
"""CAN IDs at both ends of the restricted ranges (CiA 301 7.3.5)."""
BIT_RATES: Final = {
    0: 1_000_000,
    1: 800_000,
    2: 500_000,
    3: 250_000,
    4: 125_000,
    6: 50_000,
    7: 20_000,
    8: 10_000,
}
"""Bit rates of the standard table, bit/s (CiA 305)."""
PARTS: Final = ("vendor", "product", "revision", "serial")
"""Parts of the identity, from 1018h:01h on."""
TEXTS: Final = (datatypes.VISIBLE_STRING, datatypes.OCTET_STRING)
LARGEST_BYTES: Final = 200_000
"""Size above which an upload takes too long."""

Finder = Callable[[CanopenProbe], dict[str, str]]

FINDERS: Final[dict[str, Finder]] = {}
"""Finds each name, and those that belong to it."""


class Names(dict[str, str]):
    """Names with what stands for them, each found when it is first used."""

    def __init__(self, probe: CanopenProbe) -> None:
        self._probe = probe

    def __missing__(self, name: str) -> str:
        self.update(FINDERS[name](self._probe))
        return self[name]


def _mux(item: ODVariable) -> str:
    return multiplexer(item.index, item.subindex).hex()


def _entry(item: ODVariable) -> str:
    return f"{item.index:04x}:{item.subindex:x}"


def _mapping(item: ODVariable) -> str:
    return f"0x{item.index:04x}{item.subindex:02x}{8 * (size_of(item) or 0):02x}"


def _settable(probe: CanopenProbe, first: int = 0) -> Iterator[ODVariable]:
    """Yield the writable objects that a PDO can carry, from an index on."""
    for item in probe.variables():
        if item.pdo_mappable and item.access_type == "rw" and item.index >= first:
            yield item


def provoke(probe: CanopenProbe, code: int, sync: bytes = b"\x01") -> None:
    """Cause the error with a code that `error` stands for, or clear it with an empty SYNC."""
    if code == 0x8240:
        probe.send(SYNC, sync)
    else:
        probe.send_watched_heartbeat()


def _finds(*names: str) -> Callable[[Finder], Finder]:
    """Register a function that finds names."""

    def register(finder: Finder) -> Finder:
        FINDERS.update(dict.fromkeys(names, finder))
        return finder

    return register


def default_id(index: int, node: int) -> int:
    """Return the default CAN ID of a PDO, given the index of its communication record."""
    return (0x180 if index >= TPDO else 0x200) + 0x100 * (index & 0x1FF) + node


@_finds("node", "next_node", "heartbeat", "request", "response", "next_request")
def _can_ids(probe: CanopenProbe) -> dict[str, str]:
    """Return node ID and CAN IDs of the node, and those of the next node."""
    following = probe.node % 127 + 1
    return {
        "node": f"{probe.node:02x}", "next_node": f"{following:02x}", "heartbeat": f"{HEARTBEAT + probe.node:03x}",
        "request": f"{SDO_REQUEST + probe.node:03x}", "response": f"{SDO_RESPONSE + probe.node:03x}",
        "next_request": f"{SDO_REQUEST + following:03x}",
    }  # fmt: skip


@_finds("restricted", "restricted_tpdo")
def _restricted(_probe: CanopenProbe) -> dict[str, str]:
    """Return CAN IDs that no object may have, as values of a CAN ID and as those of a TPDO without remote frames."""
    return {
        "restricted": "|".join(f"0x{can_id:03x}" for can_id in RESTRICTED_IDS),
        "restricted_tpdo": "|".join(f"0x40000{can_id:03x}" for can_id in RESTRICTED_IDS),
    }


@_finds(*PARTS, *(f"wrong_{part}" for part in PARTS), "above_revision", "below_serial")
def _identity(probe: CanopenProbe) -> dict[str, str]:
    """Return the parts of the identity, others, and numbers just above the revision and below the serial number."""
    numbers = {part: probe.number(0x1018, subindex) for subindex, part in enumerate(PARTS, 1)}
    numbers |= {f"wrong_{part}": numbers[part] ^ 1 << 20 for part in PARTS}
    numbers["above_revision"] = numbers["revision"] + 1
    numbers["below_serial"] = max(0, numbers["serial"] - 1)
    return {name: number.to_bytes(4, "little").hex() for name, number in numbers.items()}


@_finds(*(f"rate_{number}" for number in BIT_RATES))
def _rates(probe: CanopenProbe) -> dict[str, str]:
    """Return for each bit rate the status with which LSS must answer: 00 if the EDS has it, else 01."""
    allowed = probe.od.device_information.allowed_baudrates
    return {f"rate_{number}": f"{rate not in allowed:02x}" for number, rate in BIT_RATES.items()}


@_finds("text", "text_value", "text_size", "text_second", "text_threshold")
def _text(probe: CanopenProbe) -> dict[str, str]:
    """Return a readable text that takes three segments, or two full ones if there is no longer one.

    With its second segment, and the largest threshold at which its block upload may become a segmented one.
    """
    text: tuple[ODVariable, bytes] | None = None
    for item in probe.variables():
        value = (
            probe.try_read(item.index, item.subindex) if item.data_type in TEXTS and item.readable else b""
        )
        if isinstance(value, bytes) and len(value) >= (14 if text is None else 15):
            text = item, value
            if len(value) > 14:
                break
    if text is None:
        raise CaseSkipped("no readable text of 14 bytes or more")
    item, value = text
    return {
        "text": _mux(item), "text_value": value.hex(), "text_size": len(value).to_bytes(4, "little").hex(),
        "text_second": value[7:14].hex(), "text_threshold": f"{min(255, len(value)):02x}",
    }  # fmt: skip


@_finds("big", "big_block")
def _big(probe: CanopenProbe) -> dict[str, str]:
    """Return the longest readable text or domain of at most 200 kB, and a number of segments of which it takes several blocks."""
    size, longest = SEGMENT, None
    for item in probe.variables():
        if item.readable and item.data_type in (datatypes.DOMAIN, *TEXTS):
            begun = probe.ask(upload_request(item.index, item.subindex))
            probe.abandon_transfer()
            announced = int.from_bytes(begun[4:], "little") if begun is not None and begun[0] == 0x41 else 0
            if size < announced <= LARGEST_BYTES:
                size, longest = announced, item
    if longest is None:
        raise CaseSkipped("no readable object of more than 7 bytes")
    return {"big": _mux(longest), "big_block": str(min(100, (size - 1) // (2 * SEGMENT) or 1))}


@_finds("number", "entry", "new", "low", "high", "crc", "bad_crc")
def _number(probe: CanopenProbe) -> dict[str, str]:
    """Return a writable 16-bit number without side effects, preferably the heartbeat time.

    With another value, its bytes and its CRC, and another CRC.
    """
    item = probe.od.get_variable(0x1017) or probe.find(
        "writable 16-bit number",
        lambda item: item.access_type == "rw" and is_integer(item) and size_of(item) == 2,
    )
    before = probe.value(item)
    new = bytes((before[0] ^ 0x55, before[1] ^ 0x01))
    crc = crc_hqx(new, 0)
    return {
        "number": _mux(item), "entry": _entry(item), "new": new.hex(), "low": new[:1].hex(), "high": new[1:].hex(),
        "crc": crc.to_bytes(2, "little").hex(), "bad_crc": (crc ^ 0x100).to_bytes(2, "little").hex(),
    }  # fmt: skip


def _pdo(kind: str, start: int, probe: CanopenProbe) -> dict[str, str]:
    """Return index, index of the mapping, and default CAN ID of the first PDO; skip the case if there is none."""
    indices = probe.pdo_indices(start)
    if not indices:
        raise CaseSkipped(f"no PDO from {start:04X}h on")
    index = indices[0]
    can_id = default_id(index, probe.node)
    return {kind: f"{index:04x}", f"{kind}_map": f"{index + 0x200:04x}", f"{kind}_id": f"{can_id:03x}"}


for _kind, _start in (("tpdo", TPDO), ("rpdo", RPDO)):
    _finds(_kind, f"{_kind}_map", f"{_kind}_id")(partial(_pdo, _kind, _start))


@_finds("constant", "value", "no_subindex", "too_long")
def _constant(probe: CanopenProbe) -> dict[str, str]:
    """Return an object to transmit whose value is constant, if possible one that accepts the value that it has.

    A state in which the node happens to be, such as that of booting, cannot be set. As mapping entry; others have a sub-index
    that does not exist, and a byte too much.
    """
    fitting = (
        item
        for item in _settable(probe, FIRST_OWN_OBJECT)
        if size_of(item) in {1, 2, 4} and probe.write(item.index, item.subindex, probe.value(item)) == 0
    )
    item = next(fitting, None) or probe.find(
        "object for a TPDO", lambda item: item.pdo_mappable and item.readable and bool(size_of(item))
    )
    return {
        "constant": _mapping(item), "value": probe.value(item).hex(),
        "no_subindex": f"0x{item.index:04x}fe08", "too_long": f"0x{int(_mapping(item), 0) + 8:08x}",
    }  # fmt: skip


@_finds("carried", "item", "before", "other", "changed")
def _carried(probe: CanopenProbe) -> dict[str, str]:
    """Return an object for an RPDO that accepts both its limits, as mapping entry and as entry; skip the case if there is none.

    With its value, and its limits, of which `changed` is another value. Another object may limit it further than
    the EDS does, as the update rate limits the exposure time.
    """
    for item in _settable(probe, FIRST_OWN_OBJECT):
        if size_of(item) in {1, 2} and is_integer(item) and item.max is not None:
            before = probe.value(item)
            low, high = (encoded(item, int(limit or 0)) for limit in (item.min, item.max))
            other, changed = (high, low) if high == before else (low, high)
            accepted = [probe.write(item.index, item.subindex, limit) == 0 for limit in (other, changed)]
            probe.put(item, before)
            if all(accepted):
                values = {"before": before.hex(), "other": other.hex(), "changed": changed.hex()}
                return {"carried": _mapping(item), "item": _entry(item), **values}
    raise CaseSkipped("the EDS has no object for an RPDO that accepts its limits")


@_finds("one", "one_value", "two", "two_value")
def _pair(probe: CanopenProbe) -> dict[str, str]:
    """Return the mapping entries of two writable objects, and their values."""
    fitting = [item for item in _settable(probe) if is_integer(item) and size_of(item) in {1, 2}]
    if len(fitting) < 2:
        raise CaseSkipped("fewer than two objects to map")
    one, two = fitting[:2]
    return {
        "one": _mapping(one), "one_value": probe.value(one).hex(),
        "two": _mapping(two), "two_value": probe.value(two).hex(),
    }  # fmt: skip


@_finds("write_only")
def _write_only(probe: CanopenProbe) -> dict[str, str]:
    return {"write_only": _mux(probe.find("write-only object", lambda item: item.access_type == "wo"))}


@_finds("wide")
def _wide(probe: CanopenProbe) -> dict[str, str]:
    """Return the mapping entry of an object of which a PDO carries two and not three."""
    item = probe.find(
        "mappable object of 4 bytes", lambda item: item.pdo_mappable and item.readable and size_of(item) == 4
    )
    return {"wide": _mapping(item)}


@_finds("unreadable", "unwritable")
def _one_way(probe: CanopenProbe) -> dict[str, str]:
    """Return mapping entries that TPDOs and RPDOs must refuse: of the device type, if the EDS has no better one."""
    of = {item.access_type: _mapping(item) for item in probe.variables() if item.pdo_mappable}
    return {"unreadable": of.get("wo", "0x10000020"), "unwritable": of.get("ro", "0x10000020")}


@_finds("emcy_id")
def _emergency(probe: CanopenProbe) -> dict[str, str]:
    return {"emcy_id": f"{probe.emergency_id():03x}"}


@_finds("error")
def _error(probe: CanopenProbe) -> dict[str, str]:
    """Return the code of an error that the tester can cause, and cause and clear it once.

    8240h: SYNC of wrong length; 8130h: a watched node without a heartbeat for 50 ms. Other PDOs and the heartbeat are off.
    """
    can_id, code = probe.emergency_id(), 0x8240
    probe.quiet()
    probe.drain()
    provoke(probe, code)
    if probe.wait_for(can_id, 0.2) is None:
        if 0x1016 not in probe.od:
            raise CaseSkipped("no error of this device can be provoked over the bus")
        code = 0x8130
        probe.set(0x1016, 1, WATCHED_NODE << 16 | 50)
        provoke(probe, code)
        probe.expect(can_id, "EMCY 8130h of a watched node", 0.5)
    provoke(probe, code, b"")
    probe.wait_for(can_id, 0.2)
    probe.drain()
    return {"error": f"{code:04x}", "emcy_id": f"{can_id:03x}"}
