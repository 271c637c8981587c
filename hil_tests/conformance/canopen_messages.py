"""CANopen conformance: SYNC, TIME and EMCY (CiA 301 7.2.5 to 7.2.7)."""

from __future__ import annotations

from typing import Final

from hil_tests.conformance.canopen_probe import (
    ABORT_DEVICE_STATE,
    ABORT_GENERAL,
    ABORT_NO_DATA,
    ABORT_NO_SUBINDEX,
    ABORT_VALUE,
    ABORT_VALUE_HIGH,
    ABORT_VALUE_LOW,
    NO_RTR,
    PDO_OFF,
    PRE_OPERATIONAL,
    STOP,
    CanopenProbe,
    multiplexer,
)
from hil_tests.conformance.case import Case, case, check, check_equal

_CASES: list[Case[CanopenProbe]] = []
REFUSED: Final = (ABORT_VALUE, ABORT_VALUE_HIGH, ABORT_VALUE_LOW)
FORBIDDEN: Final = (0x000, 0x07F, 0x101, 0x180, 0x581, 0x5FF, 0x601, 0x67F, 0x6E0, 0x6FF, 0x701, 0x7FF)


def _quiet(probe: CanopenProbe) -> None:
    probe.quiet()
    probe.drain()


# SYNC


@case(
    _CASES, "canopen.sync.identifier", "identifiers that SYNC may not have", "CiA 301 7.5.2.5", intrusive=True
)
def sync_identifier(probe: CanopenProbe) -> None:
    """Restricted ones and the extended format are refused by 0609 0030h."""
    probe.require(0x1005)
    for identifier in (*FORBIDDEN, 0x2000_0080):
        probe.expect_refusal(0x1005, 0, identifier, 4, *REFUSED)
    check_equal(probe.number(0x1005) & 0x7FF, 0x80, "1005h as before")


@case(
    _CASES, "canopen.sync.counter-range", "values of the counter overflow", "CiA 301 7.5.2.22", intrusive=True
)
def sync_counter_range(probe: CanopenProbe) -> None:
    """1 and 241 to 255 are refused by 0609 0030h, 2 to 240 taken."""
    probe.require(0x1019)
    for value in (1, 241, 255):
        probe.expect_refusal(0x1019, 0, value, 1, *REFUSED)
    for value in (2, 240, 0):
        probe.set(0x1019, 0, value, 1)


@case(
    _CASES,
    "canopen.sync.counter-fixed",
    "counter overflow is fixed while a period is set",
    "CiA 301 7.5.2.22",
    intrusive=True,
)
def sync_counter_fixed(probe: CanopenProbe) -> None:
    """Abort 0800 0022h with 1006h set."""
    probe.require(0x1019)
    probe.require(0x1006)
    probe.set(0x1006, 0, 100_000)
    probe.expect_refusal(0x1019, 0, 10, 1, ABORT_DEVICE_STATE)
    probe.set(0x1006, 0, 0)
    probe.set(0x1019, 0, 10, 1)


@case(
    _CASES, "canopen.sync.length", "SYNC of unexpected length is reported", "CiA 301 7.2.5.3", intrusive=True
)
def sync_length(probe: CanopenProbe) -> None:
    """EMCY 8240h for a counter that is not configured, and for one that is missing."""
    probe.require(0x1014)
    _quiet(probe)
    emergency = probe.number(0x1014) & 0x7FF
    probe.send(0x080, b"\x01")
    check_equal(probe.expect(emergency, "EMCY 8240h")[:2], b"\x40\x82", "error code")
    probe.send(0x080)
    check_equal(probe.expect(emergency, "EMCY 0000h")[:2], b"\0\0", "error code")
    if 0x1019 in probe.od:
        probe.set(0x1019, 0, 10, 1)
        probe.send(0x080)
        check_equal(probe.expect(emergency, "EMCY 8240h")[:2], b"\x40\x82", "error code")


@case(_CASES, "canopen.sync.producer", "SYNC producer", "CiA 301 7.5.2.5", intrusive=True)
def sync_producer(probe: CanopenProbe) -> None:
    """Bit 30 of 1005h and 1006h make SYNCs at their period with the counter from 1, or are refused by 0609 0030h."""
    probe.require(0x1006)
    _quiet(probe)
    if 0x1019 in probe.od:
        probe.set(0x1019, 0, 3, 1)
    probe.set(0x1006, 0, 20_000)
    code = probe.write(0x1005, 0, NO_RTR | 0x80)
    if code:
        check_equal(code, ABORT_VALUE, "abort")
        return
    found = probe.count(0x080, 0.15)
    check(5 <= len(found) <= 8, "SYNC every 20 ms", f"{len(found)} in 150 ms")
    if 0x1019 in probe.od:
        check_equal([data[0] for _, data in found[:5]], [1, 2, 3, 1, 2], "counters")
    probe.expect_refusal(0x1005, 0, NO_RTR | 0x81, 4, ABORT_VALUE)
    probe.command(STOP)
    probe.drain()
    probe.expect_silence(0x080, "SYNC in STOPPED")


# TIME


@case(
    _CASES,
    "canopen.time.identifier",
    "identifiers that TIME may not have",
    "CiA 301 7.5.2.13",
    intrusive=True,
)
def time_identifier(probe: CanopenProbe) -> None:
    """Restricted ones and the extended format are refused by 0609 0030h, a change while it is consumed too."""
    probe.require(0x1012)
    probe.set(0x1012, 0, 0x100)
    for identifier in (*FORBIDDEN, 0x2000_0100):
        probe.expect_refusal(0x1012, 0, identifier, 4, *REFUSED)
    probe.set(0x1012, 0, 0x8000_0100)
    probe.expect_refusal(0x1012, 0, 0x8000_0090, 4, *REFUSED)


@case(
    _CASES, "canopen.time.malformed", "TIME of another length does no harm", "CiA 301 7.2.6.3", intrusive=True
)
def time_malformed(probe: CanopenProbe) -> None:
    """Five and seven bytes, and more milliseconds than a day has; the node goes on."""
    for data in ("00 11 22 33 44", "00 11 22 33 44 55 66", "ff ff ff 0f 00 00"):
        probe.send(0x100, data)
    probe.expect_answer("40 00 10 00", "43 00 10 00 .. .. .. ..")


# EMCY, provoked by a SYNC of wrong length


def _provoke(probe: CanopenProbe) -> bytes:
    probe.send(0x080, b"\x01")
    return probe.expect(probe.number(0x1014) & 0x7FF, "EMCY")


def _prepare(probe: CanopenProbe) -> int:
    probe.require(0x1014)
    _quiet(probe)
    return probe.number(0x1014) & 0x7FF


@case(
    _CASES,
    "canopen.emcy.format",
    "EMCY has 8 bytes: code, error register, 5 bytes",
    "CiA 301 7.2.7.3",
    intrusive=True,
)
def emcy_format(probe: CanopenProbe) -> None:
    """The register is that of 1001h, with the generic bit."""
    emergency = _prepare(probe)
    probe.send(0x080, b"\x01")
    data = probe.expect(emergency, "EMCY")
    check_equal(len(data), 8, "bytes")
    check(data[2] & 0x01, "generic bit of the error register", data[2])
    check_equal(probe.number(0x1001), data[2], "1001h")


@case(_CASES, "canopen.emcy.once", "one EMCY an error", "CiA 301 7.2.7.1", intrusive=True)
def emcy_once(probe: CanopenProbe) -> None:
    """The same error again while it is there sends nothing."""
    emergency = _prepare(probe)
    probe.send(0x080, b"\x01")
    probe.expect(emergency, "EMCY")
    probe.send(0x080, b"\x01")
    probe.expect_silence(emergency, "second EMCY")


@case(_CASES, "canopen.emcy.gone", "EMCY 0000h when the error is gone", "CiA 301 7.2.7.1", intrusive=True)
def emcy_gone(probe: CanopenProbe) -> None:
    """The error register is clear again, the history keeps the error."""
    emergency = _prepare(probe)
    probe.send(0x080, b"\x01")
    probe.expect(emergency, "EMCY")
    count = probe.number(0x1003, 0) if 0x1003 in probe.od else 0
    probe.send(0x080)
    data = probe.expect(emergency, "EMCY 0000h")
    check_equal(data[:3], bytes(3), "error code and register")
    check_equal(probe.number(0x1001), 0, "1001h")
    if 0x1003 in probe.od:
        check_equal(probe.number(0x1003, 0), count, "errors in the history")


@case(
    _CASES,
    "canopen.emcy.history",
    "the error history has the newest first",
    "CiA 301 7.5.2.3",
    intrusive=True,
)
def emcy_history(probe: CanopenProbe) -> None:
    """Its count grows by one an error up to its length; sub-index 1 has the newest code; writing 0 clears it."""
    probe.require(0x1003)
    emergency = _prepare(probe)
    probe.set(0x1003, 0, 0, 1)
    check_equal(probe.number(0x1003, 0), 0, "errors after the clear")
    probe.expect_abort(b"\x40" + multiplexer(0x1003, 1), ABORT_NO_DATA, ABORT_GENERAL, ABORT_NO_SUBINDEX)
    length = max(probe.od.indices[0x1003].subindices)
    for number in range(1, length + 3):
        probe.send(0x080, b"\x01")
        probe.expect(emergency, "EMCY")
        check_equal(probe.number(0x1003, 0), min(number, length), "errors")
        check_equal(probe.number(0x1003, 1) & 0xFFFF, 0x8240, "newest error")
        probe.send(0x080)
        probe.expect(emergency, "EMCY 0000h")


@case(_CASES, "canopen.emcy.history-order", "older errors move up", "CiA 301 7.5.2.3", intrusive=True)
def emcy_history_order(probe: CanopenProbe) -> None:
    """A second, other error: a watched node that falls silent."""
    probe.require(0x1003)
    probe.require(0x1016)
    emergency = _prepare(probe)
    probe.set(0x1003, 0, 0, 1)
    probe.send(0x080, b"\x01")
    probe.expect(emergency, "EMCY")
    probe.set(0x1016, 1, 0x0005_0032)
    probe.send(0x705, b"\x05")
    register = probe.expect(emergency, "EMCY 8130h", 0.5)[2]
    codes = [probe.number(0x1003, subindex) & 0xFFFF for subindex in (1, 2)]
    check_equal(codes, [0x8130, 0x8240], "errors")
    probe.send(0x080)
    data = probe.expect(emergency, "EMCY 0000h")
    check_equal(data[2], register, "error register with the error that remains")


@case(
    _CASES, "canopen.emcy.history-write", "the error history takes 0 only", "CiA 301 7.5.2.3", intrusive=True
)
def emcy_history_write(probe: CanopenProbe) -> None:
    """Any other number is refused by 0609 0030h."""
    probe.require(0x1003)
    probe.expect_refusal(0x1003, 0, 1, 1, *REFUSED)


@case(
    _CASES,
    "canopen.emcy.switch",
    "EMCY is switched off by bit 31 and moved only then",
    "CiA 301 7.5.2.15",
    intrusive=True,
)
def emcy_switch(probe: CanopenProbe) -> None:
    """Another identifier while it is on is refused, as are restricted ones."""
    emergency = _prepare(probe)
    probe.expect_refusal(0x1014, 0, 0x91, 4, *REFUSED)
    probe.set(0x1014, 0, PDO_OFF | emergency)
    for identifier in (0x2000_0091, 0x701, 0x000):
        probe.expect_refusal(0x1014, 0, identifier, 4, *REFUSED)
    probe.send(0x080, b"\x01")
    probe.expect_silence(emergency, "EMCY while it is off")
    probe.send(0x080)
    probe.set(0x1014, 0, 0x91)
    probe.drain()
    probe.send(0x080, b"\x01")
    probe.expect(0x91, "EMCY under its new identifier")


@case(_CASES, "canopen.emcy.inhibit", "inhibit time between two EMCY", "CiA 301 7.5.2.16", intrusive=True)
def emcy_inhibit(probe: CanopenProbe) -> None:
    """With 100 ms the second comes 100 ms after the first."""
    probe.require(0x1015)
    emergency = _prepare(probe)
    probe.set(0x1015, 0, 1000, 2)
    probe.send(0x080, b"\x01")
    probe.expect(emergency, "EMCY")
    start = probe.bus.now()
    probe.send(0x080)
    probe.expect(emergency, "EMCY 0000h")
    check(
        0.08 <= probe.bus.now() - start <= 0.15, "0.1 s between two EMCY", f"{probe.bus.now() - start:.3f} s"
    )


@case(_CASES, "canopen.emcy.stopped", "no EMCY in STOPPED", "CiA 301 7.3.2.2.5", intrusive=True)
def emcy_stopped(probe: CanopenProbe) -> None:
    """A watched node falls silent in STOPPED: nothing until the node leaves it."""
    probe.require(0x1016)
    emergency = _prepare(probe)
    probe.set(0x1016, 1, 0x0005_0032)
    probe.command(STOP)
    probe.send(0x705, b"\x05")
    probe.expect_silence(emergency, "EMCY in STOPPED", 0.3)
    probe.command(PRE_OPERATIONAL)
    check(probe.number(0x1001) & 0x10, "communication error in 1001h", probe.number(0x1001))


CASES = tuple(_CASES)
