"""CANopen conformance: transmit PDOs (CiA 301 7.2.2, 7.5.2.37, 7.5.2.38)."""

from __future__ import annotations

from typing import Final

from canopen.objectdictionary import ODVariable

from starhil.hil_tests.conformance.canopen_pdo import (
    EVENT,
    FIXED,
    SYNCHRONOUS,
    after_event,
    constant,
    entry,
    first,
    limits,
    send_sync,
    set_up,
    writable,
)
from starhil.hil_tests.conformance.canopen_probe import (
    NO_RTR,
    NOBODY,
    PDO_OFF,
    PRE_OPERATIONAL,
    RESTRICTED_IDS,
    START,
    STOP,
    VALUE_ABORTS,
    Abort,
    CanopenProbe,
    is_integer,
    size_of,
)
from starhil.hil_tests.conformance.case import CaseArea, CaseSkipped, check, check_equal

TPDO: Final = CaseArea[CanopenProbe]("canopen.tpdo", "CiA 301 7.5.2.37", intrusive=True)


@TPDO.case("cyclic", "a synchronous TPDO is sent at every nth SYNC", "CiA 301 7.2.2.2")
def cyclic(probe: CanopenProbe) -> None:
    index, item = first(probe, 0x1800), constant(probe)
    value = probe.read(item.index, item.subindex)
    for kind in (1, 3):
        can_id = set_up(probe, index, [entry(item)], kind)
        probe.command(START)
        probe.drain()
        for number in range(1, 2 * kind + 1):
            send_sync(probe)
            if number % kind == 0:
                check_equal(probe.expect(can_id, f"TPDO of type {kind}"), value, "data")
            else:
                probe.expect_silence(can_id, f"TPDO of type {kind} at SYNC {number}", 0.05)
        probe.command(PRE_OPERATIONAL)


@TPDO.case("not-without-sync", "a synchronous TPDO waits for SYNC", "CiA 301 7.2.2.2")
def not_without_sync(probe: CanopenProbe) -> None:
    can_id = set_up(probe, first(probe, 0x1800), [entry(constant(probe))], SYNCHRONOUS)
    probe.command(START)
    probe.expect_silence(can_id, "TPDO without SYNC", 0.5)


@TPDO.case("acyclic", "an acyclic TPDO is sent only at the SYNC after an event")
def acyclic(probe: CanopenProbe) -> None:
    item = writable(probe)
    can_id = set_up(probe, first(probe, 0x1800), [entry(item)], 0)
    probe.command(START)
    send_sync(probe)
    probe.wait_for(can_id, 0.1)
    probe.drain()
    send_sync(probe)
    probe.expect_silence(can_id, "TPDO without an event")
    before = probe.read(item.index, item.subindex)
    _, changed = limits(item, before)
    probe.set(item.index, item.subindex, changed)
    probe.expect_silence(can_id, "TPDO before the SYNC", 0.05)
    send_sync(probe)
    check_equal(after_event(probe, can_id), changed, "data")
    send_sync(probe)
    probe.expect_silence(can_id, "TPDO without a second event")
    probe.set(item.index, item.subindex, before)


@TPDO.case("sync-start", "SYNC start value")
def sync_start(probe: CanopenProbe) -> None:
    probe.require(0x1019)
    probe.set(0x1019, 0, 8, 1)
    can_id = set_up(probe, first(probe, 0x1800), [entry(constant(probe))], 2, start=3)
    probe.command(START)
    probe.drain()
    sent = []
    for counter in range(1, 9):
        send_sync(probe, counter)
        if probe.wait_for(can_id, 0.05) is not None:
            sent.append(counter)
    check_equal(sent, [3, 5, 7], "counters")


@TPDO.case("event", "an event-driven TPDO is sent after a change", "CiA 301 7.2.2.2")
def event(probe: CanopenProbe) -> None:
    item = writable(probe)
    can_id = set_up(probe, first(probe, 0x1800), [entry(item)], EVENT)
    before = probe.read(item.index, item.subindex)
    probe.command(START)
    probe.wait_for(can_id, 0.1)
    send_sync(probe)
    probe.expect_silence(can_id, "event-driven TPDO at SYNC")
    _, changed = limits(item, before)
    probe.set(item.index, item.subindex, changed)
    check_equal(after_event(probe, can_id), changed, "data")
    probe.set(item.index, item.subindex, before)


@TPDO.case("event-timer", "event timer")
def event_timer(probe: CanopenProbe) -> None:
    can_id = set_up(probe, first(probe, 0x1800), [entry(constant(probe))], EVENT, event_ms=50)
    probe.command(START)
    probe.wait_for(can_id, 0.1)
    found = probe.count(can_id, 0.33)
    check(5 <= len(found) <= 8, "a TPDO every 50 ms", f"{len(found)} in 0.33 s")
    mean = (found[-1][0] - found[0][0]) / (len(found) - 1)
    check(0.04 <= mean <= 0.06, "period 0.05 s", f"{mean:.4f} s")


@TPDO.case("inhibit", "inhibit time")
def inhibit(probe: CanopenProbe) -> None:
    item = writable(probe)
    can_id = set_up(probe, first(probe, 0x1800), [entry(item)], EVENT, inhibit=1000)
    before = probe.read(item.index, item.subindex)
    last, changed = limits(item, before)
    probe.command(START)
    probe.wait_for(can_id, 0.3)
    probe.wait_for(NOBODY, 0.15)
    probe.set(item.index, item.subindex, changed)
    check_equal(after_event(probe, can_id, 3.0), changed, "data")
    start = probe.port.now()
    probe.set(item.index, item.subindex, changed)
    probe.set(item.index, item.subindex, last)
    check_equal(probe.expect(can_id, "second TPDO"), last, "data")
    check(0.08 <= probe.port.now() - start <= 0.16, "0.1 s between them", f"{probe.port.now() - start:.3f} s")
    probe.set(item.index, item.subindex, before)


@TPDO.case("gate", "TPDOs are sent only in OPERATIONAL", "CiA 301 7.3.2.2.5")
def gate(probe: CanopenProbe) -> None:
    index, item = first(probe, 0x1800), constant(probe)
    for kind, event_ms in ((SYNCHRONOUS, 0), (EVENT, 20)):
        can_id = set_up(probe, index, [entry(item)], kind, event_ms=event_ms)
        for command in (PRE_OPERATIONAL, STOP):
            probe.command(START)
            send_sync(probe)
            probe.expect(can_id, "TPDO in OPERATIONAL")
            probe.command_and_settle(command)
            send_sync(probe)
            probe.expect_silence(can_id, f"TPDO after command {command}")
        probe.command(PRE_OPERATIONAL)


@TPDO.case("mapping", "remapping at run time", "CiA 301 7.5.2.38")
def mapping(probe: CanopenProbe) -> None:
    index = first(probe, 0x1800)
    fitting = [
        item
        for item in probe.variables()
        if item.pdo_mappable and item.access_type == "rw" and is_integer(item) and size_of(item) in {1, 2}
    ]
    if len(fitting) < 2:
        raise CaseSkipped("fewer than two objects to map")
    one, two = fitting[:2]
    values = {item.qualname: probe.read(item.index, item.subindex) for item in (one, two)}
    for pair in ((one, two), (two, one)):
        can_id = set_up(probe, index, [entry(item) for item in pair], SYNCHRONOUS)
        probe.command(START)
        send_sync(probe)
        data = b"".join(values[item.qualname] for item in pair)
        check_equal(probe.expect(can_id, "TPDO"), data, "data")
        probe.command(PRE_OPERATIONAL)


@TPDO.case("identifier", "a TPDO with another CAN ID")
def can_id_changes(probe: CanopenProbe) -> None:
    index, item = first(probe, 0x1800), constant(probe)
    old = set_up(probe, index, [entry(item)], SYNCHRONOUS)
    new = set_up(probe, index, [entry(item)], SYNCHRONOUS, can_id=0x3F1)
    probe.command(START)
    send_sync(probe)
    probe.expect(new, "TPDO")
    send_sync(probe)
    probe.expect_silence(old, "TPDO with its old CAN ID")


@TPDO.case("forbidden", "CAN IDs that a TPDO must not have", "CiA 301 7.3.5")
def forbidden(probe: CanopenProbe) -> None:
    index = first(probe, 0x1800)
    set_up(probe, index, [entry(constant(probe))], SYNCHRONOUS)
    probe.set(index, 1, probe.number(index, 1) | PDO_OFF)
    for can_id in (*RESTRICTED_IDS, 0x2000_0181):
        probe.expect_refusal(index, 1, NO_RTR | can_id, 4, *VALUE_ABORTS)


@TPDO.case("fixed", "settings that cannot be changed while a TPDO is enabled")
def fixed(probe: CanopenProbe) -> None:
    index, item = first(probe, 0x1800), constant(probe)
    set_up(probe, index, [entry(item)], SYNCHRONOUS)
    record = probe.od.indices[index]
    probe.expect_refusal(index, 1, NO_RTR | 0x3F2, 4, *FIXED)
    if not isinstance(record, ODVariable):
        for subindex, size in ((3, 2), (6, 1)):
            if subindex in record.subindices:
                probe.expect_refusal(index, subindex, 5, size, *FIXED)
    probe.expect_refusal(index + 0x200, 0, 0, 1, *FIXED)
    probe.expect_refusal(index + 0x200, 1, entry(item), 4, *FIXED)
    probe.set(index, 1, probe.number(index, 1) | PDO_OFF)
    probe.expect_refusal(index + 0x200, 1, entry(item), 4, *FIXED)
    probe.set(index + 0x200, 0, 0, 1)
    probe.set(index + 0x200, 1, entry(item))


@TPDO.case("types", "reserved transmission types")
def types(probe: CanopenProbe) -> None:
    index = first(probe, 0x1800)
    for value in (241, 251):
        probe.expect_refusal(index, 2, value, 1, *VALUE_ABORTS)
    for value in (0, 1, 240, 254, 255):
        probe.set(index, 2, value, 1)


@TPDO.case("reserved", "sub-index 4 of a TPDO does not exist", intrusive=False)
def reserved(probe: CanopenProbe) -> None:
    index = first(probe, 0x1800)
    if probe.od.get_variable(index, 4) is not None:
        raise CaseSkipped("the EDS has it")
    probe.expect_abort(bytes([0x40, index & 0xFF, index >> 8, 4]), Abort.NO_SUBINDEX)


@TPDO.case("mapping-refused", "mapping of objects that cannot be mapped", "CiA 301 7.5.2.38")
def mapping_refused(probe: CanopenProbe) -> None:
    index, item = first(probe, 0x1800), constant(probe)
    probe.set(index, 1, probe.number(index, 1) | PDO_OFF)
    probe.set(index + 0x200, 0, 0, 1)
    probe.expect_refusal(index + 0x200, 1, 0x1FFF_0008, 4, Abort.NO_OBJECT, Abort.NOT_MAPPABLE)
    probe.expect_refusal(
        index + 0x200, 1, item.index << 16 | 0xFE08, 4, Abort.NO_OBJECT, Abort.NO_SUBINDEX, Abort.NOT_MAPPABLE
    )
    probe.expect_refusal(index + 0x200, 1, 0x1000_0020, 4, Abort.NOT_MAPPABLE)
    probe.expect_refusal(index + 0x200, 1, entry(item) + 8, 4, Abort.NOT_MAPPABLE, Abort.PDO_LENGTH)
    hidden = next(
        (other for other in probe.variables() if other.access_type == "wo" and other.pdo_mappable), None
    )
    if hidden is not None:
        probe.expect_refusal(index + 0x200, 1, entry(hidden), 4, Abort.NOT_MAPPABLE)


@TPDO.case("mapping-length", "mapping of more than 64 bits", "CiA 301 7.5.2.38")
def mapping_length(probe: CanopenProbe) -> None:
    index = first(probe, 0x1800)
    wide = probe.find(
        "mappable object of 4 bytes", lambda item: item.pdo_mappable and item.readable and size_of(item) == 4
    )
    probe.set(index, 1, probe.number(index, 1) | PDO_OFF)
    probe.set(index + 0x200, 0, 0, 1)
    for position in (1, 2, 3):
        probe.set(index + 0x200, position, entry(wide))
    probe.expect_refusal(index + 0x200, 0, 3, 1, Abort.PDO_LENGTH)
    probe.expect_refusal(index + 0x200, 0, 65, 1, Abort.PDO_LENGTH, *VALUE_ABORTS)
    probe.set(index + 0x200, 0, 2, 1)
