"""CANopen conformance: store and restore (CiA 301 7.5.2.11, 7.5.2.12) and LSS (CiA 305)."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from typing import Final

from starhil.hil_tests.conformance.canopen_dialogue import Dialogue, add_dialogues
from starhil.hil_tests.conformance.canopen_probe import (
    LSS_FROM_SLAVE,
    LSS_TO_SLAVE,
    RESET_COMMUNICATION,
    RESET_NODE,
    Abort,
    CanopenProbe,
)
from starhil.hil_tests.conformance.case import CaseArea, CaseFailed, CaseSkipped, check, check_equal
from starhil.hil_tests.judge.canopen import HEARTBEAT, SDO_REQUEST

STORE: Final = CaseArea[CanopenProbe]("canopen.store", "CiA 301 7.5.2.11", intrusive=True)
LSS: Final = CaseArea[CanopenProbe]("canopen.lss", "CiA 305 states", intrusive=True)
SIGNATURE_REFUSED: Final = (Abort.NOT_STORED, 0x08000021, 0x08000022)


RESET: Final = "drain; nmt 129; boot-up; "
STORE_DIALOGUES: Final = (
    Dialogue(
        "save", "stored parameters are restored by a reset",
        f"need 1010; set 1017:0 777 u16; set 1010:1 save; set 1017:0 555 u16; {RESET}holds 1017:0 777; "
        f"set 1017:0 555 u16; drain; nmt 130; boot-up; holds 1017:0 777; set 1011:1 load; {RESET}drain",
    ),
    Dialogue(
        "pdo", "a stored PDO configuration is restored by a reset",
        f"need 1010 1800; set 1800:2 17 u8; set 1010:2 save; {RESET}holds 1800:2 17; set 1011:1 load; {RESET}drain",
    ),
    Dialogue(
        "groups", "communication and application parameters are stored separately",
        f"need 1010 1010:3; set 1017:0 777 u16; set 1010:3 save; {RESET}kept; set 1011:1 load; {RESET}drain",
    ),
)  # fmt: skip

add_dialogues(STORE, STORE_DIALOGUES)


@STORE.case("ability", "1010h and 1011h report their capabilities", intrusive=False)
def ability(probe: CanopenProbe) -> None:
    for index in (0x1010, 0x1011):
        if index in probe.od:
            check(probe.number(index, 1) & ~0x03 == 0, f"{index:04X}h:01h 0 to 3", probe.number(index, 1))


@STORE.case("signature", "wrong signatures are refused")
def signature(probe: CanopenProbe) -> None:
    """Abort 0800 002xh for anything but `save` and `load`, and if the two are exchanged."""
    probe.require(0x1010)
    for index, other in ((0x1010, b"load"), (0x1011, b"save")):
        if index in probe.od:
            for value in (other, other.upper(), b"evas", bytes(4), b"\x01\0\0\0"):
                probe.expect_refusal(index, 1, value, 4, *SIGNATURE_REFUSED)


@STORE.case("restore", "defaults take effect at the next reset", "CiA 301 7.5.2.12")
def restore(probe: CanopenProbe) -> None:
    probe.require(0x1010, 0x1011)
    default = probe.od.get_variable(0x1017)
    probe.set(0x1017, 0, 777, 2)
    probe.set(0x1010, 1, b"save")
    probe.set(0x1011, 1, b"load")
    check_equal(probe.number(0x1017), 777, "1017h before the reset")
    probe.drain()
    probe.command(RESET_NODE)
    probe.expect_boot_up()
    check_equal(probe.number(0x1017), 0 if default is None else default.default, "1017h after the reset")


# LSS


DIALOGUES: Final = (
    Dialogue("global", "switch state global", "04 > silence; 5e > silence; 04 01 > silence; 5e > 5e *; 04 > -", "CiA 305 switch state global"),
    Dialogue(
        "inquire", "inquire identity and node ID",
        "5a > 5a {vendor} 000000; 5b > 5b {product} 000000; 5c > 5c {revision} 000000; 5d > 5d {serial} 000000; 5e > 5e {node} 000000000000; 04 > -",
        "CiA 305 inquire",
    ),
    Dialogue("waiting", "a waiting node ignores configuration commands", "04 > -; 11 05 > silence; 13 00 02 > silence; 17 > silence; 5a > silence; 5e > silence"),
    Dialogue("configured", "a configured node does not take part in Fastscan", "04 > -; 51 00 00 00 00 80 > silence; 4c > silence", "CiA 305 fastscan"),
    Dialogue("states", "LSS works in every NMT state", "04 > -; nmt 1; 04 01 > -; 5e > 5e {node} 000000000000; 04 > -; nmt 2; 04 01 > -; 5e > 5e {node} 000000000000; 04 > -"),
)  # fmt: skip


def _lss(probe: CanopenProbe, data: bytes | str, timeout_s: float = 0.2) -> bytes | None:
    """Send a request, padded to 8 bytes; return the answer, or None."""
    payload = bytes.fromhex(data) if isinstance(data, str) else data
    probe.send(LSS_TO_SLAVE, payload.ljust(8, b"\0"))
    return probe.wait_for(LSS_FROM_SLAVE, timeout_s) if timeout_s else None


def _numbers(
    probe: CanopenProbe, command: int, numbers: Iterable[int], timeout_s: float
) -> list[bytes | None]:
    """Send numbers with consecutive commands; return the answers."""
    requests = [bytes([step]) + number.to_bytes(4, "little") for step, number in enumerate(numbers, command)]
    return [_lss(probe, request, timeout_s) for request in requests]


def _identity(probe: CanopenProbe) -> list[int]:
    return [probe.number(0x1018, subindex) for subindex in range(1, 5)]


def _select(probe: CanopenProbe) -> list[int]:
    """Select the node by its identity; skip the case if it has no LSS."""
    if not probe.od.device_information.LSS_supported:
        raise CaseSkipped("the EDS has no LSS")
    identity = _identity(probe)
    answer = _numbers(probe, 0x40, identity, 0.1)[-1]
    check_equal(answer, b"\x44" + bytes(7), "answer to switch state selective")
    return identity


def _wait(probe: CanopenProbe) -> None:
    _lss(probe, "04", 0.0)


add_dialogues(LSS, DIALOGUES, lambda probe: partial(_lss, probe), _select)


@LSS.case("selective", "switch state selective", "CiA 305 switch state selective")
def selective(probe: CanopenProbe) -> None:
    identity = _select(probe)
    check(_lss(probe, "5e") is not None, "configuration state", "waiting")
    _wait(probe)
    for wrong in range(4):
        parts = [number ^ (1 << 20 if part == wrong else 0) for part, number in enumerate(identity)]
        for answer in _numbers(probe, 0x40, parts, 0.05):
            check(answer is None, "no answer to another identity", answer)
    check(_lss(probe, "5e", 0.1) is None, "waiting state", "configuration")


@LSS.case("node-id", "configure node ID", "CiA 305 configure node-ID")
def node_id(probe: CanopenProbe) -> None:
    """Invalid node IDs are refused; a new one takes effect with a communication reset; restored afterwards."""
    _select(probe)
    for value in (0, 128, 254):
        check_equal(_lss(probe, bytes([0x11, value])), b"\x11\x01" + bytes(6), f"answer to node ID {value}")
    old = probe.node
    new = old % 127 + 1
    check_equal(_lss(probe, bytes([0x11, new])), b"\x11\0" + bytes(6), f"answer to node ID {new}")
    _wait(probe)
    check_equal(probe.number(0x1000) >= 0, 1, "SDO under the old node ID before the reset")
    probe.command(RESET_COMMUNICATION)
    try:
        probe.node = new
        probe.expect_boot_up()
        check_equal(
            probe.number(0x1200, 1) if 0x1200 in probe.od else SDO_REQUEST + new,
            SDO_REQUEST + new,
            "1200h:01h",
        )
    finally:
        _select(probe)
        _lss(probe, bytes([0x11, old]))
        _wait(probe)
        probe.command(RESET_COMMUNICATION)
        probe.node = old
    probe.expect_boot_up()


@LSS.case("bit-timing", "configure bit timing", "CiA 305 configure bit timing")
def bit_timing(probe: CanopenProbe) -> None:
    """Afterwards the node is reset, which discards the bit rate; some nodes take it at a reset of communication."""
    _select(probe)
    table = {0: 1_000_000, 1: 800_000, 2: 500_000, 3: 250_000, 4: 125_000, 6: 50_000, 7: 20_000, 8: 10_000}
    rates = probe.od.device_information.allowed_baudrates
    for index, rate in table.items():
        status = 0 if rate in rates else 1
        check_equal(
            _lss(probe, bytes([0x13, 0, index])), bytes([0x13, status]) + bytes(6), f"answer to {rate} bit/s"
        )
    for data in ("13 00 05", "13 00 ff", "13 01 00"):
        answer = _lss(probe, data)
        check(answer is not None and answer[:1] == b"\x13" and answer[1], f"refusal of {data}", answer)
    _wait(probe)
    probe.command(RESET_NODE)
    probe.expect_boot_up()


@LSS.case("identify", "identify remote slave", "CiA 305 identify remote slave")
def identify(probe: CanopenProbe) -> None:
    _select(probe)
    _wait(probe)
    vendor, product, revision, serial = _identity(probe)
    everything = (vendor, product, 0, 0xFFFFFFFF, 0, 0xFFFFFFFF)
    exact = (vendor, product, revision, revision, serial, serial)
    for ranges in (everything, exact):
        check_equal(_numbers(probe, 0x46, ranges, 0.1)[-1], b"\x4f" + bytes(7), "answer")
    others = [
        (vendor, product ^ 1, *everything[2:]),
        (vendor, product, revision + 1, 0xFFFFFFFF, 0, 0xFFFFFFFF),
    ]
    if serial:
        others.append((vendor, product, 0, 0xFFFFFFFF, 0, serial - 1))
    for ranges in others:
        for answer in _numbers(probe, 0x46, ranges, 0.05):
            check(answer is None, "no answer", answer)


@LSS.case("fastscan", "Fastscan finds a node without a node ID", "CiA 305 fastscan")
def fastscan(probe: CanopenProbe) -> None:
    """The node ID is removed, the identity found bit by bit, and the node ID restored.

    This requires that no other node is unconfigured.
    """
    identity = _select(probe)
    old = probe.node
    check_equal(_lss(probe, "11 ff"), b"\x11\0" + bytes(6), "answer to node ID 255")
    _wait(probe)
    probe.command(RESET_COMMUNICATION)
    try:
        probe.drain()
        check(probe.wait_for(HEARTBEAT + old, 0.2) is None, "no boot-up message without a node ID", "one")
        check_equal(_lss(probe, "4c"), b"\x50" + bytes(7), "answer to identify non-configured")
        found = _scan(probe)
        check_equal(found, identity, "identity")
        check_equal(_lss(probe, "5e"), b"\x5e\xff" + bytes(6), "answer to inquire node ID")
    finally:
        _lss(probe, "04 01", 0.0)
        _lss(probe, bytes([0x11, old]))
        _wait(probe)
    probe.expect_boot_up()


def _scan(probe: CanopenProbe) -> list[int]:
    def ask(number: int, bit: int, part: int, following: int) -> bool:
        data = b"\x51" + number.to_bytes(4, "little") + bytes([bit, part, following])
        return _lss(probe, data, 0.03) is not None

    if not ask(0, 0x80, 0, 0):
        raise CaseFailed("an answer to the start of Fastscan", "nothing")
    identity = []
    for part in range(4):
        number = 0
        for bit in reversed(range(32)):
            if not ask(number, bit, part, part):
                number |= 1 << bit
        if not ask(number, 0, part, (part + 1) % 4):
            raise CaseFailed(f"part {part + 1} of the identity confirmed", f"nothing for 0x{number:08X}")
        identity.append(number)
    return identity
