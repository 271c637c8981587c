"""CANopen conformance: NMT slave and error control (CiA 301 7.2.8, 7.3.2)."""

from __future__ import annotations

from typing import Final

from starhil.hil_tests.conformance.canopen_probe import (
    NOBODY,
    PRE_OPERATIONAL,
    RESET_COMMUNICATION,
    RESET_NODE,
    SETTLING_S,
    START,
    STOP,
    WATCHED_NODE,
    Abort,
    CanopenProbe,
)
from starhil.hil_tests.conformance.case import CaseArea, CaseSkipped, check, check_equal

NMT: Final = CaseArea[CanopenProbe]("canopen.nmt", "CiA 301 7.3.2.2", intrusive=True)
ERROR_CONTROL: Final = CaseArea[CanopenProbe]("canopen.error-control", "CiA 301 7.2.8.3.2", intrusive=True)
STATE_OF: Final = {START: 0x05, STOP: 0x04, PRE_OPERATIONAL: 0x7F}


def _prepare(probe: CanopenProbe, heartbeat_ms: int = 20) -> None:
    probe.set(0x1017, 0, heartbeat_ms, 2)


def _state(probe: CanopenProbe) -> int:
    """Return the state in the next heartbeat, after frames in transit have arrived."""
    probe.wait_for(NOBODY, SETTLING_S)
    probe.drain()
    return probe.expect(0x700 + probe.node, "heartbeat", 1.0)[0]


@NMT.case("boot-up", "boot-up message, then PRE-OPERATIONAL without a command", "CiA 301 7.3.2.2.1")
def boot_up(probe: CanopenProbe) -> None:
    for command in (RESET_COMMUNICATION, RESET_NODE):
        probe.drain()
        probe.command(command)
        probe.expect_boot_up()
        _prepare(probe)
        check_equal(_state(probe), 0x7F, "state")


@NMT.case("boot-up-once", "one boot-up message per reset", "CiA 301 7.2.8.3.3")
def boot_up_once(probe: CanopenProbe) -> None:
    probe.reset_communication()
    data = probe.wait_for(0x700 + probe.node, 0.2, lambda data: data == b"\0")
    check(data is None, "one boot-up message", "two")


@NMT.case("commands", "start, stop and enter PRE-OPERATIONAL from every state")
def commands(probe: CanopenProbe) -> None:
    _prepare(probe)
    for before in STATE_OF:
        for command, state in STATE_OF.items():
            probe.command(before)
            probe.command(command)
            check_equal(_state(probe), state, f"state after commands {before} and {command}:")


@NMT.case("broadcast", "commands to all nodes", "CiA 301 7.2.8.3")
def broadcast(probe: CanopenProbe) -> None:
    """Node ID 0 addresses every node, so this is only for a bus without other nodes in operation."""
    _prepare(probe)
    for command, state in STATE_OF.items():
        probe.command(command, 0)
        check_equal(_state(probe), state, f"state after command {command} to all:")


@NMT.case("other-node", "commands to another node are ignored")
def other_node(probe: CanopenProbe) -> None:
    _prepare(probe)
    probe.command(START, probe.node % 127 + 1)
    check_equal(_state(probe), 0x7F, "state")


@NMT.case("malformed", "frames that are not NMT commands are ignored")
def malformed(probe: CanopenProbe) -> None:
    _prepare(probe)
    node = bytes([probe.node])
    for data in (b"\x03" + node, b"\x01", b"\x01" + node + b"\0"):
        probe.send(0x000, data)
        check_equal(_state(probe), 0x7F, f"state after {data.hex()}:")
    probe.send(0x000, b"\x01" + node, extended=True)
    check_equal(_state(probe), 0x7F, "state after an extended frame:")


@NMT.case("reset-states", "resets work from every state")
def reset_states(probe: CanopenProbe) -> None:
    for before in (START, STOP):
        for command in (RESET_COMMUNICATION, RESET_NODE):
            probe.command(before)
            probe.drain()
            probe.command(command)
            probe.expect_boot_up()


@NMT.case("reset-communication", "reset communication restores the communication profile")
def reset_communication(probe: CanopenProbe) -> None:
    before = probe.number(0x1017)
    probe.set(0x1017, 0, before ^ 0x55, 2)
    probe.reset_communication()
    check_equal(probe.number(0x1017), before, "1017h")


@NMT.case("sdo-states", "SDO in PRE-OPERATIONAL and OPERATIONAL, not in STOPPED", "CiA 301 7.3.2.2.5")
def sdo_states(probe: CanopenProbe) -> None:
    for command, answered in ((PRE_OPERATIONAL, True), (START, True), (STOP, False)):
        probe.command(command)
        answer = probe.ask("40 00 10 00", 0.2)
        check_equal(answer is not None, answered, f"SDO answered after command {command}:")


# Heartbeat


@ERROR_CONTROL.case("heartbeat", "heartbeat with the state at its period")
def heartbeat(probe: CanopenProbe) -> None:
    _prepare(probe, 100)
    probe.drain()
    found = probe.count(0x700 + probe.node, 0.75)
    check(len(found) >= 6, "six heartbeats in 0.75 s", len(found))
    check(all(data == b"\x7f" for _, data in found), "heartbeats 7f", [data.hex() for _, data in found])
    mean = (found[5][0] - found[0][0]) / 5
    check(0.08 <= mean <= 0.12, "period 0.1 s", f"{mean:.4f} s")


@ERROR_CONTROL.case("heartbeat-off", "no heartbeat if the time is 0")
def heartbeat_off(probe: CanopenProbe) -> None:
    _prepare(probe, 50)
    _prepare(probe, 0)
    probe.drain()
    probe.expect_silence(0x700 + probe.node, "heartbeat", 0.3)


@ERROR_CONTROL.case("heartbeat-stopped", "the heartbeat continues in STOPPED", "CiA 301 7.3.2.2.5")
def heartbeat_stopped(probe: CanopenProbe) -> None:
    _prepare(probe)
    probe.command(STOP)
    check_equal(_state(probe), 0x04, "state")


# Node guarding


def _request_guarding(probe: CanopenProbe) -> int:
    probe.send(0x700 + probe.node, remote=True)
    return probe.expect(0x700 + probe.node, "answer to node guarding")[0]


def _prepare_guarding(probe: CanopenProbe) -> None:
    probe.require(0x100C)
    _prepare(probe, 0)
    probe.drain()


@ERROR_CONTROL.case("guarding", "node guarding with toggle bit", "CiA 301 7.2.8.3.1")
def guarding(probe: CanopenProbe) -> None:
    _prepare_guarding(probe)
    check_equal([_request_guarding(probe) for _ in range(3)], [0x7F, 0xFF, 0x7F], "answers")
    probe.command(START)
    check_equal(_request_guarding(probe), 0x85, "answer in OPERATIONAL")
    probe.command(STOP)
    check_equal(_request_guarding(probe), 0x04, "answer in STOPPED")
    probe.command(PRE_OPERATIONAL)
    check_equal([_request_guarding(probe) for _ in range(2)], [0xFF, 0x7F], "answers in PRE-OPERATIONAL")
    probe.reset_communication()
    _prepare(probe, 0)
    probe.drain()
    check_equal(_request_guarding(probe), 0x7F, "first answer after the reset")


@ERROR_CONTROL.case(
    "guarding-or-heartbeat", "no node guarding while the heartbeat is enabled", "CiA 301 7.2.8.3.1"
)
def guarding_or_heartbeat(probe: CanopenProbe) -> None:
    probe.require(0x100C)
    _prepare(probe, 5000)
    probe.drain()
    probe.send(0x700 + probe.node, remote=True)
    probe.expect_silence(0x700 + probe.node, "answer to node guarding", 0.2)


@ERROR_CONTROL.case("life-guarding", "life guarding", "CiA 301 7.2.8.3.1")
def life_guarding(probe: CanopenProbe) -> None:
    _prepare_guarding(probe)
    probe.require(0x100D)
    probe.set(0x100C, 0, 50, 2)
    probe.set(0x100D, 0, 4, 1)
    probe.command(START)
    emergency = probe.emergency_id()
    probe.expect_silence(emergency, "EMCY before the first request", 0.4)
    for _ in range(3):
        _request_guarding(probe)
        probe.expect_silence(emergency, "EMCY while it is guarded", 0.15)
    probe.expect_emergency(emergency, 0x8130, 0.3)
    check_equal(_request_guarding(probe) & 0x7F, 0x7F, "state")


# Heartbeat consumer


def _watch(probe: CanopenProbe) -> int:
    probe.require(0x1016)
    _prepare(probe, 0)
    probe.set(0x1016, 1, WATCHED_NODE << 16 | 100)
    return probe.emergency_id()


@ERROR_CONTROL.case("consumer-start", "supervision begins with the first heartbeat")
def consumer_start(probe: CanopenProbe) -> None:
    """No EMCY before the watched node has sent its first heartbeat."""
    emergency = _watch(probe)
    probe.expect_silence(emergency, "EMCY", 0.4)


@ERROR_CONTROL.case("consumer", "the heartbeat of a watched node stops and returns")
def consumer(probe: CanopenProbe) -> None:
    emergency = _watch(probe)
    for _ in range(3):
        probe.send_watched_heartbeat()
        probe.expect_silence(emergency, "EMCY while its heartbeat is received", 0.07)
    data = probe.expect_emergency(emergency, 0x8130, 0.3)
    check(data[2] & 0x11 == 0x11, "error register with generic and communication", data[2])
    check_equal(probe.number(0x1001), data[2], "1001h")
    probe.send_watched_heartbeat()
    data = probe.expect(emergency, "EMCY 0000h", 0.3)
    check_equal(data[:3], bytes(3), "error code and register")


@ERROR_CONTROL.case(
    "behaviour", "error behaviour if the heartbeat of a watched node stops", "CiA 301 7.5.2.32"
)
def behaviour(probe: CanopenProbe) -> None:
    probe.require(0x1029)
    for value, state in ((0, 0x7F), (1, 0x05), (2, 0x04)):
        probe.command(PRE_OPERATIONAL)
        _watch(probe)
        probe.set(0x1029, 1, value, 1)
        _prepare(probe)
        probe.command(START)
        probe.send_watched_heartbeat()
        probe.wait_for(NOBODY, 0.2)
        check_equal(_state(probe), state, f"state with 1029h:01h at {value}:")


@ERROR_CONTROL.case("consumer-twice", "a node can be watched by only one entry", "CiA 301 7.5.2.18")
def consumer_twice(probe: CanopenProbe) -> None:
    _watch(probe)
    item = probe.od.get_variable(0x1016, 2)
    if item is None:
        raise CaseSkipped("1016h has one entry")
    probe.expect_refusal(0x1016, 2, WATCHED_NODE << 16 | 200, 4, Abort.INCOMPATIBLE)
    probe.set(0x1016, 2, (WATCHED_NODE + 1) << 16 | 200)


@ERROR_CONTROL.case("consumer-off", "supervision with time 0 is off", "CiA 301 7.5.2.18")
def consumer_off(probe: CanopenProbe) -> None:
    emergency = _watch(probe)
    probe.send_watched_heartbeat()
    probe.set(0x1016, 1, 0)
    probe.expect_silence(emergency, "EMCY", 0.4)
