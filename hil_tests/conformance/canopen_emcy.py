"""CANopen conformance: EMCY, error register and error history (CiA 301 7.2.7)."""

from __future__ import annotations

from typing import Final

from starhil.hil_tests.conformance.canopen_dialogue import Dialogue, add_dialogues
from starhil.hil_tests.conformance.canopen_probe import (
    PDO_OFF,
    PRE_OPERATIONAL,
    STOP,
    VALUE_ABORTS,
    WATCHED_NODE,
    Abort,
    CanopenProbe,
)
from starhil.hil_tests.conformance.case import CaseArea, CaseSkipped, check, check_equal
from starhil.hil_tests.judge.canopen import SYNC, multiplexer

EMCY: Final = CaseArea[CanopenProbe]("canopen.emcy", "CiA 301 7.5.2.3", intrusive=True)


add_dialogues(
    EMCY,
    [Dialogue("history-write", "the error history accepts only 0", "need 1003; set 1003:0 1 u8 > VALUES")],
)


class ProvokedError:
    """An error caused by the tester: a SYNC of wrong length or a missing heartbeat."""

    def __init__(self, probe: CanopenProbe) -> None:
        self.emergency = probe.emergency_id()
        probe.quiet()
        probe.drain()
        self._probe = probe
        self._by_sync = True
        self.cause()
        if probe.wait_for(self.emergency, 0.2) is None:
            if 0x1016 not in probe.od:
                raise CaseSkipped("no error of this device can be provoked over the bus")
            self._by_sync = False
            probe.set(0x1016, 1, WATCHED_NODE << 16 | 50)
            self.cause()
            probe.expect(self.emergency, "EMCY 8130h of a watched node", 0.5)
        self.code = 0x8240 if self._by_sync else 0x8130
        self.clear()
        probe.wait_for(self.emergency, 0.2)
        probe.drain()

    def cause(self) -> None:
        """Cause the error; with a watched node it occurs 50 ms later."""
        if self._by_sync:
            self._probe.send(SYNC, b"\x01")
        else:
            self._probe.send_watched_heartbeat()

    def occur(self) -> bytes:
        """Cause the error and return its EMCY."""
        self.cause()
        return self._probe.expect(self.emergency, "EMCY")

    def clear(self) -> None:
        """Clear the error."""
        if self._by_sync:
            self._probe.send(SYNC)
        else:
            self._probe.send_watched_heartbeat()

    def end(self) -> bytes:
        """Clear the error and return its EMCY 0000h."""
        self.clear()
        return self._probe.expect(self.emergency, "EMCY 0000h")


@EMCY.case("format", "EMCY has 8 bytes: code, error register, 5 bytes", "CiA 301 7.2.7.3")
def emcy_format(probe: CanopenProbe) -> None:
    error = ProvokedError(probe)
    data = error.occur()
    check_equal(len(data), 8, "bytes")
    check(data[2] & 0x01, "generic bit of the error register", data[2])
    check_equal(probe.number(0x1001), data[2], "1001h")


@EMCY.case("once", "one EMCY per error", "CiA 301 7.2.7.1")
def emcy_once(probe: CanopenProbe) -> None:
    error = ProvokedError(probe)
    error.occur()
    error.cause()
    probe.expect_silence(error.emergency, "second EMCY")


@EMCY.case("gone", "EMCY 0000h when the error is cleared", "CiA 301 7.2.7.1")
def emcy_gone(probe: CanopenProbe) -> None:
    error = ProvokedError(probe)
    error.occur()
    count = probe.number(0x1003, 0) if 0x1003 in probe.od else 0
    data = error.end()
    check_equal(data[:3], bytes(3), "error code and register")
    check_equal(probe.number(0x1001), 0, "1001h")
    if 0x1003 in probe.od:
        check_equal(probe.number(0x1003, 0), count, "errors in the history")


@EMCY.case("history", "the error history begins with the newest error")
def emcy_history(probe: CanopenProbe) -> None:
    probe.require(0x1003)
    error = ProvokedError(probe)
    probe.set(0x1003, 0, 0, 1)
    check_equal(probe.number(0x1003, 0), 0, "errors after the clear")
    probe.expect_abort(b"\x40" + multiplexer(0x1003, 1), Abort.NO_DATA, Abort.GENERAL, Abort.NO_SUBINDEX)
    length = max(probe.od.indices[0x1003].subindices)
    for number in range(1, length + 3):
        error.occur()
        check_equal(probe.number(0x1003, 0), min(number, length), "errors")
        check_equal(probe.number(0x1003, 1) & 0xFFFF, error.code, "newest error")
        error.end()


@EMCY.case("history-order", "older errors move up")
def emcy_history_order(probe: CanopenProbe) -> None:
    """The second error is a different one: the heartbeat of a watched node stops."""
    probe.require(0x1003, 0x1016)
    error = ProvokedError(probe)
    probe.set(0x1003, 0, 0, 1)
    error.occur()
    probe.set(0x1016, 1, WATCHED_NODE << 16 | 50)
    probe.send_watched_heartbeat()
    register = probe.expect(error.emergency, "EMCY 8130h", 0.5)[2]
    codes = [probe.number(0x1003, subindex) & 0xFFFF for subindex in (1, 2)]
    check_equal(codes, [0x8130, error.code], "errors")
    data = error.end()
    check_equal(data[2], register, "error register with the error that remains")


@EMCY.case("switch", "bit 31 switches EMCY off, and its CAN ID changes only then", "CiA 301 7.5.2.15")
def emcy_switch(probe: CanopenProbe) -> None:
    error = ProvokedError(probe)
    probe.expect_refusal(0x1014, 0, 0x91, 4, *VALUE_ABORTS)
    probe.set(0x1014, 0, PDO_OFF | error.emergency)
    for can_id in (0x2000_0091, 0x701, 0x000):
        probe.expect_refusal(0x1014, 0, can_id, 4, *VALUE_ABORTS)
    error.cause()
    probe.expect_silence(error.emergency, "EMCY while it is off")
    error.clear()
    probe.set(0x1014, 0, 0x91)
    probe.drain()
    error.cause()
    probe.expect(0x91, "EMCY with its new CAN ID")


@EMCY.case("inhibit", "inhibit time between two EMCY", "CiA 301 7.5.2.16")
def emcy_inhibit(probe: CanopenProbe) -> None:
    probe.require(0x1015)
    error = ProvokedError(probe)
    probe.set(0x1015, 0, 1000, 2)
    error.occur()
    start = probe.port.now()
    error.end()
    seconds = probe.port.now() - start
    check(0.08 <= seconds <= 0.15, "0.1 s between two EMCY", f"{seconds:.3f} s")


@EMCY.case("stopped", "no EMCY in STOPPED", "CiA 301 7.3.2.2.5")
def emcy_stopped(probe: CanopenProbe) -> None:
    probe.require(0x1016)
    error = ProvokedError(probe)
    probe.set(0x1016, 1, WATCHED_NODE << 16 | 50)
    probe.command(STOP)
    probe.send_watched_heartbeat()
    probe.expect_silence(error.emergency, "EMCY in STOPPED", 0.3)
    probe.command(PRE_OPERATIONAL)
    check(probe.number(0x1001) & 0x10, "communication error in 1001h", probe.number(0x1001))
