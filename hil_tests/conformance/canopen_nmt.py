"""CANopen conformance: NMT slave, error control, SYNC and TIME (CiA 301 7.2.5, 7.2.6, 7.2.8, 7.3.2)."""

from __future__ import annotations

from typing import Final

from starhil.hil_tests.conformance.canopen_dialogue import Dialogue, add_dialogues
from starhil.hil_tests.conformance.canopen_probe import (
    NO_RTR,
    PRE_OPERATIONAL,
    RESTRICTED_IDS,
    START,
    STOP,
    WATCHED_NODE,
    Abort,
    CanopenProbe,
)
from starhil.hil_tests.conformance.case import CaseArea, check, check_equal
from starhil.hil_tests.judge import canopen

NMT: Final = CaseArea[CanopenProbe]("canopen.nmt", "CiA 301 7.3.2.2", intrusive=True)
ERROR_CONTROL: Final = CaseArea[CanopenProbe]("canopen.error-control", "CiA 301 7.2.8.3.2", intrusive=True)
STATE_OF: Final = {START: "05", STOP: "04", PRE_OPERATIONAL: "7f"}
BEATS: Final = "set 1017:0 20 u16; "
NO_BEATS: Final = "set 1017:0 0 u16; "
WATCHES: Final = f"need 1014 1016; {NO_BEATS}set 1016:1 {WATCHED_NODE << 16 | 100} u32; "
"""The node watches the heartbeat of another one, which may stay away for 0.1 s."""
GUARDED: Final = f"{NO_BEATS}drain; "

NMT_DIALOGUES: Final = (
    Dialogue(
        "boot-up", "boot-up message, then PRE-OPERATIONAL without a command",
        "; ".join(f"drain; nmt {command}; boot-up; {BEATS}state 7f" for command in (130, 129)),
        "CiA 301 7.3.2.2.1",
    ),
    Dialogue(
        "commands", "start, stop and enter PRE-OPERATIONAL from every state",
        BEATS + "; ".join(f"nmt {before}; nmt {after}; state {STATE_OF[after]}" for before in STATE_OF for after in STATE_OF),
    ),
    Dialogue(
        "broadcast", "commands to all nodes",  # for a bus without other nodes in operation
        BEATS + "; ".join(f"nmt {command} all; state {state}" for command, state in STATE_OF.items()),
        "CiA 301 7.2.8.3",
    ),
    Dialogue("other-node", "commands to another node are ignored", BEATS + "nmt 1 other; state 7f"),
    Dialogue(
        "malformed", "frames that are not NMT commands are ignored",
        BEATS + "send 000 03{node}; state 7f; send 000 01; state 7f; send 000 01{node}00; state 7f; "
        "send 000 01{node} extended; state 7f",
    ),
    Dialogue(
        "reset-states", "resets work from every state",
        "; ".join(f"nmt {before}; drain; nmt {reset}; boot-up" for before in (START, STOP) for reset in (130, 129)),
    ),
    Dialogue(
        "sdo-states", "SDO in PRE-OPERATIONAL and OPERATIONAL, not in STOPPED",
        "nmt 128; 40 00 10 00 > 43 00 10 00 *; nmt 1; 40 00 10 00 > 43 00 10 00 *; nmt 2; 40 00 10 00 > silence",
        "CiA 301 7.3.2.2.5",
    ),
    Dialogue(
        "reset-communication", "reset communication restores the communication profile",
        "set 1017:0 777 u16; reset; kept",
    ),
)  # fmt: skip
ERROR_CONTROL_DIALOGUES: Final = (
    Dialogue(
        "heartbeat-stopped", "the heartbeat continues in STOPPED", BEATS + "nmt 2; state 04", "CiA 301 7.3.2.2.5"
    ),
    Dialogue(
        "guarding", "node guarding with toggle bit",
        f"need 100C; {GUARDED}guard 7f; guard ff; guard 7f; nmt 1; guard 85; nmt 2; guard 04; "
        f"nmt 128; guard ff; guard 7f; reset; {GUARDED}guard 7f",
        "CiA 301 7.2.8.3.1",
    ),
    Dialogue(
        "guarding-or-heartbeat", "no node guarding while the heartbeat is enabled",
        "need 100C; set 1017:0 5000 u16; drain; guard",
        "CiA 301 7.2.8.3.1",
    ),
    Dialogue(
        "life-guarding", "life guarding",
        f"need 100C 100D 1014; {GUARDED}set 100C:0 50 u16; set 100D:0 4 u8; nmt 1; calm 0.4; guard 05|85; calm 0.15; guard 05|85; "
        "calm 0.15; guard 05|85; calm 0.15; emcy 8130 0.3; guard 7f|ff",
        "CiA 301 7.2.8.3.1",
    ),
    Dialogue("consumer-start", "supervision begins with the first heartbeat", WATCHES + "calm 0.4"),
    Dialogue(
        "heartbeat-off", "no heartbeat if the time is 0", f"set 1017:0 50 u16; {NO_BEATS}drain; none {{heartbeat}} 0.3"
    ),
    Dialogue(
        "consumer-twice", "a node can be watched by only one entry",
        f"need 1016:2; {WATCHES}set 1016:2 {WATCHED_NODE << 16 | 200} u32 > INCOMPATIBLE; set 1016:2 {WATCHED_NODE + 1 << 16 | 200} u32",
        "CiA 301 7.5.2.18",
    ),
    Dialogue(
        "behaviour", "error behaviour if the heartbeat of a watched node stops",
        "need 1029; " + "; ".join(
            f"nmt 128; {WATCHES}set 1029:1 {value} u8; {BEATS}nmt 1; watched; sleep 0.2; state {state}"
            for value, state in ((0, "7f"), (1, "05"), (2, "04"))
        ),
        "CiA 301 7.5.2.32",
    ),
    Dialogue(
        "consumer-off", "supervision with time 0 is off", WATCHES + "watched; set 1016:1 0 u32; calm 0.4", "CiA 301 7.5.2.18"
    ),
)  # fmt: skip

add_dialogues(NMT, NMT_DIALOGUES)
add_dialogues(ERROR_CONTROL, ERROR_CONTROL_DIALOGUES)


@NMT.case("boot-up-once", "one boot-up message per reset", "CiA 301 7.2.8.3.3")
def boot_up_once(probe: CanopenProbe) -> None:
    probe.reset_communication()
    data = probe.wait_for(canopen.HEARTBEAT + probe.node, 0.2, lambda data: data == b"\0")
    check(data is None, "one boot-up message", "two")


@ERROR_CONTROL.case("heartbeat", "heartbeat with the state at its period")
def heartbeat(probe: CanopenProbe) -> None:
    probe.set(0x1017, 0, 100, 2)
    probe.drain()
    found = probe.count(canopen.HEARTBEAT + probe.node, 0.75)
    check(len(found) >= 6, "six heartbeats in 0.75 s", len(found))
    check(all(data == b"\x7f" for _, data in found), "heartbeats 7f", [data.hex() for _, data in found])
    mean = (found[5][0] - found[0][0]) / 5
    check(0.08 <= mean <= 0.12, "period 0.1 s", f"{mean:.4f} s")


@ERROR_CONTROL.case("consumer", "the heartbeat of a watched node stops and returns")
def consumer(probe: CanopenProbe) -> None:
    probe.require(0x1016)
    probe.set(0x1017, 0, 0, 2)
    probe.set(0x1016, 1, WATCHED_NODE << 16 | 100)
    emergency = probe.emergency_id()
    for _ in range(3):
        probe.send_watched_heartbeat()
        probe.expect_silence(emergency, "EMCY while its heartbeat is received", 0.07)
    data = probe.expect_emergency(emergency, 0x8130, 0.3)
    check(data[2] & 0x11 == 0x11, "error register with generic and communication", data[2])
    check_equal(probe.number(0x1001), data[2], "1001h")
    probe.send_watched_heartbeat()
    data = probe.expect(emergency, "EMCY 0000h", 0.3)
    check_equal(data[:3], bytes(3), "error code and register")


# --- SYNC and TIME ---

SYNC: Final = CaseArea[CanopenProbe]("canopen.sync", "CiA 301 7.5.2.5", intrusive=True)
TIME: Final = CaseArea[CanopenProbe]("canopen.time", "CiA 301 7.5.2.13", intrusive=True)


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
    probe.quiet()
    probe.drain()
    probe.send(canopen.SYNC, b"\x01")
    probe.expect_emergency(emergency, 0x8240)
    probe.send(canopen.SYNC)
    probe.expect_emergency(emergency, 0)
    if 0x1019 in probe.od:
        probe.set(0x1019, 0, 10, 1)
        probe.send(canopen.SYNC)
        probe.expect_emergency(emergency, 0x8240)


@SYNC.case("producer", "SYNC producer")
def sync_producer(probe: CanopenProbe) -> None:
    probe.require(0x1006)
    probe.quiet()
    probe.drain()
    if 0x1019 in probe.od:
        probe.set(0x1019, 0, 3, 1)
    probe.set(0x1006, 0, 20_000)
    code = probe.write(0x1005, 0, NO_RTR | 0x80)
    if code:
        check_equal(code, Abort.VALUE, "abort")
        return
    found = probe.count(canopen.SYNC, 0.15)
    check(5 <= len(found) <= 8, "SYNC every 20 ms", f"{len(found)} in 150 ms")
    if 0x1019 in probe.od:
        check_equal([data[0] for _, data in found[:5]], [1, 2, 3, 1, 2], "counters")
    probe.expect_refusal(0x1005, 0, NO_RTR | 0x81, 4, Abort.VALUE)
    probe.command_and_settle(STOP)
    probe.expect_silence(canopen.SYNC, "SYNC in STOPPED")
