"""PDOs under test: the objects that they can carry, and the procedure that configures one (CiA 301 7.5.2.34 to 7.5.2.38)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from canopen.objectdictionary import ODVariable

from starhil.hil_tests.conformance.canopen_probe import (
    FIRST_OWN_OBJECT,
    NO_RTR,
    PDO_OFF,
    CanopenProbe,
    encoded,
    is_integer,
    size_of,
)
from starhil.hil_tests.conformance.case import CaseSkipped
from starhil.hil_tests.judge.canopen import SYNC

RPDO: Final = 0x1400
TPDO: Final = 0x1800
"""Indices of the first communication records."""
SYNCHRONOUS: Final = 1
EVENT: Final = 255


@dataclass(frozen=True)
class Carried:
    """An object that a PDO carries: its value before the case, and its limits, of which `changed` is another value."""

    item: ODVariable
    before: bytes
    other: bytes
    changed: bytes


def entry(item: ODVariable) -> int:
    """Return the mapping entry of a variable."""
    return item.index << 16 | item.subindex << 8 | 8 * (size_of(item) or 0)


def constant(probe: CanopenProbe) -> ODVariable:
    """Return an object to transmit whose value is constant, if possible one that is mapped by default."""
    settable = (
        item
        for item in probe.variables()
        if item.pdo_mappable and item.access_type == "rw" and item.index >= FIRST_OWN_OBJECT
    )
    return next((item for item in settable if size_of(item) in {1, 2, 4}), None) or probe.find(
        "object for a TPDO", lambda item: item.pdo_mappable and item.readable and bool(size_of(item))
    )


def writable(probe: CanopenProbe) -> Carried:
    """Return an object for an RPDO that accepts both its limits; skip the case if there is none.

    Another object may limit it further than the EDS does, as the update rate limits the exposure time.
    """
    for item in probe.variables():
        fits = item.pdo_mappable and item.access_type == "rw" and size_of(item) in {1, 2}
        if fits and is_integer(item) and item.index >= FIRST_OWN_OBJECT and item.max is not None:
            before = probe.value(item)
            low, high = (encoded(item, int(limit or 0)) for limit in (item.min, item.max))
            limits = (high, low) if high == before else (low, high)
            accepted = [probe.write(item.index, item.subindex, limit) == 0 for limit in limits]
            probe.put(item, before)
            if all(accepted):
                return Carried(item, before, *limits)
    raise CaseSkipped("the EDS has no object for an RPDO that accepts its limits")


def first(probe: CanopenProbe, kind: int) -> int:
    """Return the index of the first RPDO or TPDO; skip the case if there is none."""
    indices = probe.pdo_indices(kind)
    if not indices:
        raise CaseSkipped(f"no PDO from {kind:04X}h on")
    return indices[0]


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
    transmit = index >= TPDO
    can_id = pdo_id(index, probe.node) if can_id is None else can_id
    flags = NO_RTR if transmit else 0
    probe.set(index, 1, PDO_OFF | flags | can_id)
    probe.set(index + 0x200, 0, 0, 1)
    for position, value in enumerate(objects, 1):
        probe.set(index + 0x200, position, value)
    probe.set(index + 0x200, 0, len(objects), 1)
    probe.set(index, 2, kind, 1)
    settings: tuple[tuple[int, int | None, int], ...] = ((3, inhibit, 2), (5, event_ms, 2), (6, start, 1))
    for subindex, setting, size in settings:
        served = probe.has(index, subindex)
        if setting and not served:
            raise CaseSkipped(f"{index:04X}h has no sub-index {subindex}")
        if setting is not None and served:
            probe.set(index, subindex, setting, size)
    probe.set(index, 1, flags | can_id)
    probe.drain()
    return can_id


def pdo_id(index: int, node: int) -> int:
    """Return the CAN ID of a PDO under test."""
    return (0x180 if index >= TPDO else 0x200) + 0x100 * (index & 0x1FF) + node


def send_sync(probe: CanopenProbe, counter: int | None = None) -> None:
    """Send a SYNC, with a counter if one is given."""
    probe.send(SYNC, b"" if counter is None else bytes([counter]))
