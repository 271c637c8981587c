"""CANopen conformance: behaviour of this product beyond CiA 301."""

from __future__ import annotations

from typing import Final

from starhil.hil_tests.conformance.canopen_pdo import (
    EVENT,
    SYNCHRONOUS,
    entry,
    first,
    limits,
    send_sync,
    set_up,
    writable,
)
from starhil.hil_tests.conformance.canopen_probe import NO_RTR, PDO_OFF, START, CanopenProbe
from starhil.hil_tests.conformance.case import CaseArea, check, check_equal

DESIGN: Final = CaseArea[CanopenProbe]("canopen.design", "interface definition: canopen.toml", intrusive=True)


@DESIGN.case("write-event", "a write to a mapped object is an event")
def write_event(probe: CanopenProbe) -> None:
    item = writable(probe)
    can_id = set_up(probe, first(probe, 0x1800), [entry(item)], EVENT)
    before = probe.read(item.index, item.subindex)
    probe.command(START)
    probe.wait_for(can_id, 0.1)
    _, changed = limits(item, before)
    probe.set(item.index, item.subindex, changed)
    check_equal(probe.expect(can_id, "TPDO after the write"), changed, "data")
    probe.set(item.index, item.subindex, before)


@DESIGN.case("attitude", "TPDOs with the same sequence number are of one sample")
def attitude(probe: CanopenProbe) -> None:
    marker = probe.find("object named sequence", lambda item: item.name == "sequence" and item.pdo_mappable)
    chosen: list[int] = []
    probe.quiet()
    for index in probe.pdo_indices(0x1800):
        if probe.number(index + 0x200, 0) and probe.number(index + 0x200, 1) == entry(marker):
            probe.set(index, 2, SYNCHRONOUS, 1)
            can_id = 0x3E0 + len(chosen)
            probe.set(index, 1, PDO_OFF | NO_RTR | can_id)
            probe.set(index, 1, NO_RTR | can_id)
            chosen.append(can_id)
    check(len(chosen) >= 2, "two TPDOs that begin with the sequence number", len(chosen))
    probe.command(START)
    for _ in range(5):
        probe.drain()
        send_sync(probe)
        heads = {probe.expect(can_id, "TPDO")[:2] for can_id in chosen}
        check_equal(len(heads), 1, "sequence numbers and flags after one SYNC:")
