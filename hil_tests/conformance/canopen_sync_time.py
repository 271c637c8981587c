"""CANopen conformance: SYNC and TIME (CiA 301 7.2.5, 7.2.6)."""

from __future__ import annotations

from typing import Final

from starhil.hil_tests.conformance.canopen_dialogue import Dialogue, add_dialogues
from starhil.hil_tests.conformance.canopen_probe import (
    NO_RTR,
    RESTRICTED_IDS,
    STOP,
    Abort,
    CanopenProbe,
)
from starhil.hil_tests.conformance.case import CaseArea, check, check_equal

SYNC: Final = CaseArea[CanopenProbe]("canopen.sync", "CiA 301 7.5.2.5", intrusive=True)
TIME: Final = CaseArea[CanopenProbe]("canopen.time", "CiA 301 7.5.2.13", intrusive=True)


def _quiet_and_drain(probe: CanopenProbe) -> None:
    probe.quiet()
    probe.drain()


SYNC_DIALOGUES: Final = (
    Dialogue(
        "identifier", "CAN IDs that SYNC must not have",
        "need 1005; " + "".join(f"set 1005:0 {can_id} u32 > VALUES; " for can_id in (*RESTRICTED_IDS, 0x2000_0080))
        + "holds 1005:0 0x80 0x7ff",
    ),
    Dialogue(
        "counter-range", "invalid values of the counter overflow",
        "need 1019; set 1019:0 1 u8 > VALUES; set 1019:0 241 u8 > VALUES; set 1019:0 255 u8 > VALUES; "
        "set 1019:0 2 u8; set 1019:0 240 u8; set 1019:0 0 u8",
        "CiA 301 7.5.2.22",
    ),
    Dialogue(
        "counter-fixed", "the counter overflow cannot be changed while a period is set",
        "need 1019 1006; set 1006:0 100000 u32; set 1019:0 10 u8 > DEVICE_STATE; set 1006:0 0 u32; set 1019:0 10 u8",
        "CiA 301 7.5.2.22",
    ),
)  # fmt: skip
TIME_DIALOGUES: Final = (
    Dialogue(
        "identifier", "CAN IDs that TIME must not have",
        "need 1012; set 1012:0 0x100 u32; "
        + "".join(f"set 1012:0 {can_id} u32 > VALUES; " for can_id in (*RESTRICTED_IDS, 0x2000_0100))
        + "set 1012:0 0x80000100 u32; set 1012:0 0x80000090 u32 > VALUES",
    ),
    Dialogue(
        "malformed", "TIME of wrong length has no effect",
        "send 100 0011223344; send 100 00112233445566; send 100 ffffff0f0000; 40 00 10 00 > 43 00 10 00 .. .. .. ..",
        "CiA 301 7.2.6.3",
    ),
)  # fmt: skip

add_dialogues(SYNC, SYNC_DIALOGUES)
add_dialogues(TIME, TIME_DIALOGUES)


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
