"""CANopen conformance: configuration of PDOs, shared by their cases (CiA 301 7.5.2.34 to 7.5.2.38)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from canopen.objectdictionary import ODVariable

from starhil.hil_tests.conformance.canopen_probe import (
    FIRST_OWN_OBJECT,
    NO_RTR,
    PDO_OFF,
    Abort,
    CanopenProbe,
    is_integer,
    size_of,
)
from starhil.hil_tests.conformance.case import CaseSkipped

FIXED: Final = (Abort.ACCESS, Abort.DEVICE_STATE, Abort.VALUE)
"""Aborts with which stacks refuse to change the mapping of an enabled PDO; CiA 301 specifies none."""
SYNCHRONOUS: Final = 1
EVENT: Final = 255


def entry(item: ODVariable) -> int:
    """Return the mapping entry of a variable."""
    return item.index << 16 | item.subindex << 8 | 8 * (size_of(item) or 0)


def constant(probe: CanopenProbe) -> ODVariable:
    """Return an object to transmit whose value is constant, if possible one that is mapped by default."""
    for item in probe.variables():
        if (
            item.pdo_mappable
            and item.access_type == "rw"
            and item.index >= 0x2000
            and size_of(item) in {1, 2, 4}
        ):
            return item
    return probe.find(
        "object for a TPDO", lambda item: item.pdo_mappable and item.readable and bool(size_of(item))
    )


def writable(probe: CanopenProbe) -> ODVariable:
    """Return an object for an RPDO that accepts both its limits; skip the case if there is none.

    Another object may limit it further than the EDS does, as the update rate limits the exposure time.
    """
    for item in probe.variables():
        size = size_of(item)
        if (
            item.pdo_mappable
            and item.access_type == "rw"
            and is_integer(item)
            and size in {1, 2}
            and item.index >= FIRST_OWN_OBJECT
            and item.max is not None
        ):
            before = probe.read(item.index, item.subindex)
            both = limits(item, before)
            accepted = [probe.write(item.index, item.subindex, limit) == 0 for limit in both]
            probe.set(item.index, item.subindex, before)
            if all(accepted):
                return item
    raise CaseSkipped("the EDS has no object for an RPDO that accepts its limits")


def limits(item: ODVariable, before: bytes) -> tuple[bytes, bytes]:
    """Return both limits of an object, encoded, with the one that is not its current value last."""
    size = size_of(item) or 1
    low, high = (int(limit or 0).to_bytes(size, "little") for limit in (item.min, item.max))
    return (high, low) if high == before else (low, high)


def set_up(
    probe: CanopenProbe,
    index: int,
    objects: Sequence[int],
    kind: int,
    *,
    can_id: int | None = None,
    inhibit: int = 0,
    event_ms: int = 0,
    start: int | None = None,
) -> int:
    """Configure a PDO by the procedure of CiA 301 and return its CAN ID.

    Other PDOs and the heartbeat are off.
    """
    probe.quiet()
    transmit = index >= 0x1800
    number = index & 0x1FF
    can_id = (0x180 if transmit else 0x200) + 0x100 * number + probe.node if can_id is None else can_id
    flags = NO_RTR if transmit else 0
    probe.set(index, 1, PDO_OFF | flags | can_id)
    probe.set(index + 0x200, 0, 0, 1)
    for position, value in enumerate(objects, 1):
        probe.set(index + 0x200, position, value)
    probe.set(index + 0x200, 0, len(objects), 1)
    probe.set(index, 2, kind, 1)
    record = probe.od.indices[index]
    settings: tuple[tuple[int, int | None, int], ...] = ((3, inhibit, 2), (5, event_ms, 2), (6, start, 1))
    for subindex, setting, size in settings:
        served = not isinstance(record, ODVariable) and subindex in record.subindices
        if setting and not served:
            raise CaseSkipped(f"{index:04X}h has no sub-index {subindex}")
        if setting is not None and served:
            probe.set(index, subindex, setting, size)
    probe.set(index, 1, flags | can_id)
    probe.drain()
    return can_id


def first(probe: CanopenProbe, kind: int) -> int:
    """Return the index of the first RPDO (1400h) or TPDO (1800h); skip the case if there is none."""
    indices = probe.pdo_indices(kind)
    if not indices:
        raise CaseSkipped(f"no PDO from {kind:04X}h on")
    return indices[0]


def send_sync(probe: CanopenProbe, counter: int | None = None) -> None:
    """Send a SYNC, with a counter if one is given."""
    probe.send(0x080, b"" if counter is None else bytes([counter]))


def after_event(probe: CanopenProbe, can_id: int, timeout_s: float | None = None) -> bytes:
    """Return the TPDO caused by a write to a mapped object; skip the case if the write is not an event."""
    data = probe.wait_for(can_id, timeout_s)
    if data is None:
        raise CaseSkipped("a write to a mapped object is not an event on this device")
    return data
