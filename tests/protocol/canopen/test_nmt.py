"""NMT states and error control: boot-up, heartbeat, guarding, what works in which state."""

from __future__ import annotations

import pytest

from starhil.protocol.canopen.context import NmtState
from starhil.protocol.canopen.device_dictionary import DeviceDictionary
from starhil.protocol.canopen.slave import CanopenSlave
from starhil.protocol.errors import ProtocolError
from starhil.protocol.unit import load_unit

HEARTBEAT_LOST = bytes.fromhex("3081 11")


def heartbeats(sent):
    return [(time, data) for time, identifier, data in sent if identifier == 0x72C]


def test_boot_up_then_pre_operational(new_bench):
    bench = new_bench()
    frames = bench.slave.start(bench.now)
    assert [(frame.id, frame.data, frame.extended) for frame in frames] == [(0x72C, b"\0", False)]
    assert bench.slave.state is NmtState.PRE_OPERATIONAL
    assert bench.events() == [("state", 0x7F)]


@pytest.mark.parametrize(
    ("command", "state"),
    [(1, NmtState.OPERATIONAL), (2, NmtState.STOPPED), (128, NmtState.PRE_OPERATIONAL)],
)
@pytest.mark.parametrize("before", [1, 2, 128])
@pytest.mark.parametrize("node", [0, 0x2C])
def test_commands_switch_between_all_states(bench, before, command, node, state):
    bench.nmt(before)
    bench.nmt(command, node)
    assert bench.slave.state is state


@pytest.mark.parametrize("before", [1, 2, 128])
@pytest.mark.parametrize("node", [0, 0x2C])
@pytest.mark.parametrize(("command", "event"), [(129, "reset_node"), (130, "reset_communication")])
def test_resets_boot_up_again(bench, before, node, command, event):
    bench.nmt(before)
    bench.events()
    assert bench.nmt(command, node) == [(0x72C, b"\0")]
    assert bench.slave.state is NmtState.PRE_OPERATIONAL
    assert bench.events() == [(event, 0), ("state", 0x7F)]


@pytest.mark.parametrize("data", ["01", "012c00", "", "012d", "032c", "002c", "ff2c", "0180"])
def test_an_invalid_or_foreign_nmt_command_is_ignored(bench, data):
    bench.frame(0, data)
    assert bench.slave.state is NmtState.PRE_OPERATIONAL
    assert bench.sent == bench.sent[:1]


def test_extended_or_remote_frame_is_not_a_command(bench):
    bench.frame(0, "012c", extended=True)
    bench.frame(0, remote=True)
    assert bench.slave.state is NmtState.PRE_OPERATIONAL


def test_reset_communication_restores_communication_only(bench):
    bench.write(0x1017, 0, 250, 2)
    bench.write(0x1016, 1, 0x0005_0064)
    bench.write(0x6020, 1, 321, 2)
    bench.nmt(130)
    assert bench.number(0x1017) == 1000
    assert bench.number(0x1016, 1) == 0
    assert bench.number(0x6020, 1) == 321


@pytest.mark.parametrize("node_id", [0, 128, 254, -1, 300])
def test_invalid_node_id_is_rejected(node_id):
    with pytest.raises(ProtocolError, match="node ID"):
        CanopenSlave(DeviceDictionary(load_unit()), node_id)


# Heartbeat producer


def test_the_heartbeat_reports_the_state(bench):
    bench.write(0x1017, 0, 100, 2)
    start = bench.now
    assert heartbeats(bench.advance(0.25)) == [
        (pytest.approx(start + 0.1), b"\x7f"),
        (pytest.approx(start + 0.2), b"\x7f"),
    ]
    bench.operational()
    assert heartbeats(bench.advance(0.1))[0][1] == b"\x05"
    bench.nmt(2)
    assert heartbeats(bench.advance(0.1))[0][1] == b"\x04"


def test_heartbeat_does_not_drift_when_ticks_are_late(bench):
    bench.write(0x1017, 0, 100, 2)
    start = bench.now
    frames = bench.slave.tick(start + 0.13)
    assert [frame.id for frame in frames] == [0x72C]
    assert bench.slave.next_deadline() == pytest.approx(start + 0.2)


def test_default_heartbeat_and_switching_off(bench):
    assert len(heartbeats(bench.advance(3.0))) == 3
    bench.write(0x1017, 0, 0, 2)
    assert heartbeats(bench.advance(5.0)) == []


# Node guarding


def guard(bench):
    return bench.frame(0x72C, remote=True)


def test_guarding_toggles_and_reports_the_state(bench):
    bench.write(0x1017, 0, 0, 2)
    assert [guard(bench) for _ in range(3)] == [[(0x72C, b"\x7f")], [(0x72C, b"\xff")], [(0x72C, b"\x7f")]]
    bench.operational()
    assert guard(bench) == [(0x72C, b"\x85")]
    bench.nmt(2)
    assert guard(bench) == [(0x72C, b"\x04")]
    bench.nmt(130)
    bench.write(0x1017, 0, 0, 2)
    assert guard(bench) == [(0x72C, b"\x7f")]


def test_no_guarding_while_the_heartbeat_is_on(bench):
    assert guard(bench) == []


def test_life_guarding_starts_with_the_first_request(bench):
    bench.write(0x1017, 0, 0, 2)
    bench.write(0x100C, 0, 100, 2)
    bench.write(0x100D, 0, 3, 1)
    bench.operational()
    assert bench.slave.next_deadline() is None
    guard(bench)
    bench.advance(0.2)
    guard(bench)
    bench.events()
    assert bench.advance(0.29) == []
    ((_, identifier, data),) = bench.advance(0.02)
    assert (identifier, data[:3]) == (0xAC, HEARTBEAT_LOST)
    assert bench.slave.state is NmtState.PRE_OPERATIONAL
    assert ("guarding_lost", 0) in bench.events()
    answers = guard(bench)
    assert answers[0] == (0x72C, b"\x7f")
    assert answers[1][1][:5] == bytes.fromhex("0000 00 3081")
    assert ("guarding_found", 0) in bench.events()


# Heartbeat consumer


def watch(bench, node=5, period_ms=100, entry=1):
    return bench.write(0x1016, entry, node << 16 | period_ms)


def test_the_consumer_starts_with_the_first_heartbeat(bench):
    watch(bench)
    assert [sent for sent in bench.advance(0.5) if sent[1] == 0xAC] == []


@pytest.mark.parametrize(
    ("behaviour", "state"),
    [(0, NmtState.PRE_OPERATIONAL), (1, NmtState.OPERATIONAL), (2, NmtState.STOPPED)],
)
def test_lost_node_and_error_behaviour(bench, behaviour, state):
    watch(bench)
    bench.write(0x1029, 1, behaviour, 1)
    bench.operational()
    bench.frame(0x705, "05")
    bench.advance(0.09)
    bench.frame(0x705, "05")
    assert [sent for sent in bench.advance(0.09) if sent[1] == 0xAC] == []
    ((_, _, data),) = [sent for sent in bench.advance(0.02) if sent[1] == 0xAC]
    assert data == bytes.fromhex("3081 11 0500000000")
    assert bench.slave.state is state
    assert ("node_lost", 5) in bench.events()
    bench.frame(0x705, "05")
    assert ("node_found", 5) in bench.events()


def test_lost_node_does_not_move_a_node_that_is_not_operational(bench):
    watch(bench)
    bench.frame(0x705, "7f")
    bench.advance(0.2)
    assert bench.slave.state is NmtState.PRE_OPERATIONAL


def test_error_is_reset_when_the_node_is_heard_again(bench):
    watch(bench)
    bench.frame(0x705, "05")
    bench.advance(0.2)
    assert bench.number(0x1001) == 0x11
    assert bench.frame(0x705, "05") == [(0xAC, bytes.fromhex("0000 00 3081000000"))]
    assert bench.number(0x1001) == 0


def test_boot_up_of_a_watched_node_is_an_event(bench):
    watch(bench)
    bench.events()
    bench.frame(0x705, "00")
    assert bench.events() == [("node_booted", 5)]


def test_one_node_is_watched_by_one_entry(bench):
    assert watch(bench) == 0
    assert watch(bench, entry=2) == 0x06040043
    assert watch(bench, node=6, entry=2) == 0
    assert watch(bench, period_ms=0, entry=3) == 0
    assert watch(bench, period_ms=50) == 0
    assert watch(bench, node=7) == 0
    assert watch(bench, entry=2) == 0


@pytest.mark.parametrize("node", [0, 128, 255])
def test_consumer_entry_without_a_node_is_not_used(bench, node):
    assert watch(bench, node=node) == 0
    bench.frame(0x700 + (node & 0x7F), "05")
    assert [sent for sent in bench.advance(0.5) if sent[1] == 0xAC] == []


def test_heartbeats_of_wrong_length_do_not_count(bench):
    watch(bench)
    bench.frame(0x705, "05")
    bench.advance(0.06)
    bench.frame(0x705, "0500")
    assert [sent for sent in bench.advance(0.06) if sent[1] == 0xAC]
