"""CANopen conformance: receive PDOs (CiA 301 7.2.2, 7.5.2.35, 7.5.2.36)."""

from __future__ import annotations

from typing import Final

from starhil.hil_tests.conformance.canopen_pdo import (
    FIXED,
    SYNCHRONOUS,
    entry,
    first,
    limits,
    send_sync,
    set_up,
    writable,
)
from starhil.hil_tests.conformance.canopen_probe import (
    PDO_OFF,
    PRE_OPERATIONAL,
    RESTRICTED_IDS,
    START,
    STOP,
    VALUE_ABORTS,
    Abort,
    CanopenProbe,
)
from starhil.hil_tests.conformance.case import CaseArea, CaseSkipped, check, check_equal

RPDO: Final = CaseArea[CanopenProbe]("canopen.rpdo", "CiA 301 7.2.2.2", intrusive=True)


@RPDO.case("event", "an event-driven RPDO takes effect at once")
def rpdo_event(probe: CanopenProbe) -> None:
    item = writable(probe)
    before = probe.read(item.index, item.subindex)
    can_id = set_up(probe, first(probe, 0x1400), [entry(item)], 255)
    probe.command(START)
    for data in limits(item, before):
        probe.send(can_id, data)
        check_equal(probe.read(item.index, item.subindex), data, "value")
    probe.set(item.index, item.subindex, before)


@RPDO.case("gate", "RPDOs take effect only in OPERATIONAL", "CiA 301 7.3.2.2.5")
def rpdo_gate(probe: CanopenProbe) -> None:
    item = writable(probe)
    before = probe.read(item.index, item.subindex)
    _, data = limits(item, before)
    can_id = set_up(probe, first(probe, 0x1400), [entry(item)], 255)
    for command in (PRE_OPERATIONAL, STOP):
        probe.command(command)
        probe.send(can_id, data)
        probe.command(PRE_OPERATIONAL)
        check_equal(probe.read(item.index, item.subindex), before, "value as before")


@RPDO.case("synchronous", "a synchronous RPDO takes effect at the next SYNC")
def rpdo_synchronous(probe: CanopenProbe) -> None:
    item = writable(probe)
    before = probe.read(item.index, item.subindex)
    earlier, last = limits(item, before)
    can_id = set_up(probe, first(probe, 0x1400), [entry(item)], SYNCHRONOUS)
    probe.command(START)
    probe.send(can_id, earlier)
    probe.send(can_id, last)
    check_equal(probe.read(item.index, item.subindex), before, "value before the SYNC")
    send_sync(probe)
    check_equal(probe.read(item.index, item.subindex), last, "value after the SYNC")
    probe.set(item.index, item.subindex, before)


@RPDO.case("short", "an RPDO that is too short is reported and not processed", "CiA 301 7.2.2.3, 7.2.7.1")
def rpdo_short(probe: CanopenProbe) -> None:
    item = writable(probe)
    before = probe.read(item.index, item.subindex)
    can_id = set_up(probe, first(probe, 0x1400), [entry(item), entry(item)], 255)
    emergency = probe.number(0x1014) & 0x7FF
    probe.command(START)
    probe.drain()
    probe.send(can_id, limits(item, before)[1])
    check_equal(probe.expect(emergency, "EMCY 8210h")[:2], b"\x10\x82", "error code")
    check_equal(probe.read(item.index, item.subindex), before, "value as before")


@RPDO.case("long", "an RPDO that is too long is reported", "CiA 301 7.2.2.3, 7.2.7.1")
def rpdo_long(probe: CanopenProbe) -> None:
    item = writable(probe)
    before = probe.read(item.index, item.subindex)
    can_id = set_up(probe, first(probe, 0x1400), [entry(item)], 255)
    emergency = probe.number(0x1014) & 0x7FF
    probe.command(START)
    probe.drain()
    probe.send(can_id, before + b"\0")
    check_equal(probe.expect(emergency, "EMCY 8220h")[:2], b"\x20\x82", "error code")
    probe.send(can_id, before)
    check_equal(probe.expect(emergency, "EMCY 0000h")[:2], b"\0\0", "error code")


@RPDO.case("place-holder", "dummy entries skip bytes of an RPDO", "CiA 301 7.4.7")
def place_holder(probe: CanopenProbe) -> None:
    if 0x0006 not in probe.od:
        raise CaseSkipped("the EDS allows no dummy entry of 16 bits")
    item = writable(probe)
    before = probe.read(item.index, item.subindex)
    can_id = set_up(probe, first(probe, 0x1400), [0x0006_0010, entry(item)], 255)
    probe.command(START)
    _, data = limits(item, before)
    probe.send(can_id, b"\x55\xaa" + data)
    check_equal(probe.read(item.index, item.subindex), data, "value")
    probe.set(item.index, item.subindex, before)


@RPDO.case("deadline", "deadline of an RPDO", "CiA 301 7.5.2.35")
def deadline(probe: CanopenProbe) -> None:
    item = writable(probe)
    before = probe.read(item.index, item.subindex)
    can_id = set_up(probe, first(probe, 0x1400), [entry(item)], 255, event_ms=100)
    emergency = probe.number(0x1014) & 0x7FF
    probe.command(START)
    probe.drain()
    probe.expect_silence(emergency, "EMCY before the first message", 0.3)
    probe.send(can_id, before)
    start = probe.port.now()
    check_equal(probe.expect(emergency, "EMCY 8250h")[:2], b"\x50\x82", "error code")
    check(
        0.08 <= probe.port.now() - start <= 0.16,
        "0.1 s after the message",
        f"{probe.port.now() - start:.3f} s",
    )
    probe.send(can_id, before)
    check_equal(probe.expect(emergency, "EMCY 0000h")[:2], b"\0\0", "error code")


@RPDO.case("refused", "configurations that an RPDO refuses", "CiA 301 7.5.2.35")
def rpdo_refused(probe: CanopenProbe) -> None:
    index, item = first(probe, 0x1400), writable(probe)
    set_up(probe, index, [entry(item)], 255)
    probe.expect_refusal(index, 1, 0x3F3, 4, *FIXED)
    for value in (241, 252, 253):
        probe.expect_refusal(index, 2, value, 1, *VALUE_ABORTS)
    probe.expect_refusal(index + 0x200, 0, 0, 1, *FIXED)
    probe.set(index, 1, probe.number(index, 1) | PDO_OFF)
    for can_id in RESTRICTED_IDS:
        probe.expect_refusal(index, 1, can_id, 4, *VALUE_ABORTS)
    probe.set(index + 0x200, 0, 0, 1)
    constant_ = probe.find(
        "mappable read-only object", lambda item: item.pdo_mappable and item.access_type == "ro"
    )
    probe.expect_refusal(index + 0x200, 1, entry(constant_), 4, Abort.NOT_MAPPABLE)
