"""CANopen conformance: SYNC and TIME (CiA 301 7.2.5, 7.2.6)."""

from __future__ import annotations

from typing import Final

from starhil.hil_tests.conformance.canopen_probe import (
    NO_RTR,
    RESTRICTED_IDS,
    STOP,
    VALUE_ABORTS,
    Abort,
    CanopenProbe,
)
from starhil.hil_tests.conformance.case import CaseArea, check, check_equal

SYNC: Final = CaseArea[CanopenProbe]("canopen.sync", "CiA 301 7.5.2.5", intrusive=True)
TIME: Final = CaseArea[CanopenProbe]("canopen.time", "CiA 301 7.5.2.13", intrusive=True)


def _quiet_and_drain(probe: CanopenProbe) -> None:
    probe.quiet()
    probe.drain()


# SYNC


@SYNC.case("identifier", "CAN IDs that SYNC must not have")
def sync_identifier(probe: CanopenProbe) -> None:
    probe.require(0x1005)
    for can_id in (*RESTRICTED_IDS, 0x2000_0080):
        probe.expect_refusal(0x1005, 0, can_id, 4, *VALUE_ABORTS)
    check_equal(probe.number(0x1005) & 0x7FF, 0x80, "1005h as before")


@SYNC.case("counter-range", "invalid values of the counter overflow", "CiA 301 7.5.2.22")
def sync_counter_range(probe: CanopenProbe) -> None:
    probe.require(0x1019)
    for value in (1, 241, 255):
        probe.expect_refusal(0x1019, 0, value, 1, *VALUE_ABORTS)
    for value in (2, 240, 0):
        probe.set(0x1019, 0, value, 1)


@SYNC.case(
    "counter-fixed", "the counter overflow cannot be changed while a period is set", "CiA 301 7.5.2.22"
)
def sync_counter_fixed(probe: CanopenProbe) -> None:
    probe.require(0x1019, 0x1006)
    probe.set(0x1006, 0, 100_000)
    probe.expect_refusal(0x1019, 0, 10, 1, Abort.DEVICE_STATE)
    probe.set(0x1006, 0, 0)
    probe.set(0x1019, 0, 10, 1)


@SYNC.case("length", "SYNC of unexpected length is reported", "CiA 301 7.2.5.3")
def sync_length(probe: CanopenProbe) -> None:
    emergency = probe.emergency_id()
    _quiet_and_drain(probe)
    probe.send(0x080, b"\x01")
    probe.expect_emergency(emergency, 0x8240)
    probe.send(0x080)
    probe.expect_emergency(emergency, 0)
    if 0x1019 in probe.od:
        probe.set(0x1019, 0, 10, 1)
        probe.send(0x080)
        probe.expect_emergency(emergency, 0x8240)


@SYNC.case("producer", "SYNC producer")
def sync_producer(probe: CanopenProbe) -> None:
    probe.require(0x1006)
    _quiet_and_drain(probe)
    if 0x1019 in probe.od:
        probe.set(0x1019, 0, 3, 1)
    probe.set(0x1006, 0, 20_000)
    code = probe.write(0x1005, 0, NO_RTR | 0x80)
    if code:
        check_equal(code, Abort.VALUE, "abort")
        return
    found = probe.count(0x080, 0.15)
    check(5 <= len(found) <= 8, "SYNC every 20 ms", f"{len(found)} in 150 ms")
    if 0x1019 in probe.od:
        check_equal([data[0] for _, data in found[:5]], [1, 2, 3, 1, 2], "counters")
    probe.expect_refusal(0x1005, 0, NO_RTR | 0x81, 4, Abort.VALUE)
    probe.command_and_settle(STOP)
    probe.expect_silence(0x080, "SYNC in STOPPED")


# TIME


@TIME.case("identifier", "CAN IDs that TIME must not have")
def time_identifier(probe: CanopenProbe) -> None:
    probe.require(0x1012)
    probe.set(0x1012, 0, 0x100)
    for can_id in (*RESTRICTED_IDS, 0x2000_0100):
        probe.expect_refusal(0x1012, 0, can_id, 4, *VALUE_ABORTS)
    probe.set(0x1012, 0, 0x8000_0100)
    probe.expect_refusal(0x1012, 0, 0x8000_0090, 4, *VALUE_ABORTS)


@TIME.case("malformed", "TIME of wrong length has no effect", "CiA 301 7.2.6.3")
def time_malformed(probe: CanopenProbe) -> None:
    for data in ("00 11 22 33 44", "00 11 22 33 44 55 66", "ff ff ff 0f 00 00"):
        probe.send(0x100, data)
    probe.expect_answer("40 00 10 00", "43 00 10 00 .. .. .. ..")
