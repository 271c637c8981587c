"""CANopen conformance: transmit and receive PDOs (CiA 301 7.2.2, 7.5.2.34 to 7.5.2.38).

Most cases configure one PDO to carry one object (`carrying`), change the object or send the PDO, and look at the other.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Final

from canopen.objectdictionary import ODVariable

from starhil.hil_tests.conformance.canopen_dialogue import Dialogue, add_dialogues
from starhil.hil_tests.conformance.canopen_probe import (
    FIRST_OWN_OBJECT,
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
    encoded,
    is_integer,
    size_of,
)
from starhil.hil_tests.conformance.case import CaseArea, CaseSkipped, check, check_equal

TPDO: Final = CaseArea[CanopenProbe]("canopen.tpdo", "CiA 301 7.5.2.37", intrusive=True)
RPDO: Final = CaseArea[CanopenProbe]("canopen.rpdo", "CiA 301 7.2.2.2", intrusive=True)
DESIGN: Final = CaseArea[CanopenProbe]("canopen.design", "interface definition: canopen.toml", intrusive=True)
"""Behaviour of this product beyond CiA 301."""

FIXED: Final = (Abort.ACCESS, Abort.DEVICE_STATE, Abort.VALUE)
"""Aborts with which stacks refuse to change the mapping of an enabled PDO; CiA 301 specifies none."""
SYNCHRONOUS: Final = 1
EVENT: Final = 255


def entry(item: ODVariable) -> int:
    """Return the mapping entry of a variable."""
    return item.index << 16 | item.subindex << 8 | 8 * (size_of(item) or 0)


def constant(probe: CanopenProbe) -> ODVariable:
    """Return an object to transmit whose value is constant, if possible one that is mapped by default."""
    settable = (
        item
        for item in probe.variables()
        if item.pdo_mappable and item.access_type == "rw" and item.index >= FIRST_OWN_OBJECT
    )
    return next((item for item in settable if size_of(item) in {1, 2, 4}), None) or probe.find(
        "object for a TPDO", lambda item: item.pdo_mappable and item.readable and bool(size_of(item))
    )


@dataclass(frozen=True)
class Carried:
    """An object that a PDO carries: its value before the case, and its limits, of which `changed` is another value."""

    probe: CanopenProbe
    item: ODVariable
    before: bytes
    other: bytes
    changed: bytes
    can_id: int = 0

    def value(self) -> bytes:
        """Read the object."""
        return self.probe.value(self.item)

    def put(self, data: bytes) -> None:
        """Write the object."""
        self.probe.put(self.item, data)


def writable(probe: CanopenProbe) -> Carried:
    """Return an object for an RPDO that accepts both its limits; skip the case if there is none.

    Another object may limit it further than the EDS does, as the update rate limits the exposure time.
    """
    for item in probe.variables():
        fits = item.pdo_mappable and item.access_type == "rw" and size_of(item) in {1, 2}
        if fits and is_integer(item) and item.index >= FIRST_OWN_OBJECT and item.max is not None:
            before = probe.value(item)
            low, high = (encoded(item, int(limit or 0)) for limit in (item.min, item.max))
            limits = (high, low) if high == before else (low, high)
            accepted = [probe.write(item.index, item.subindex, limit) == 0 for limit in limits]
            probe.put(item, before)
            if all(accepted):
                return Carried(probe, item, before, *limits)
    raise CaseSkipped("the EDS has no object for an RPDO that accepts its limits")


@contextmanager
def carrying(
    probe: CanopenProbe,
    first_index: int,
    kind: int,
    *,
    behind: Sequence[int] = (),
    times: int = 1,
    **settings: int,
) -> Iterator[Carried]:
    """Have the first PDO carry a writable object, behind other entries, and start the node.

    The object is restored after the case.
    """
    found = writable(probe)
    objects = [*behind, *[entry(found.item)] * times]
    can_id = set_up(probe, first(probe, first_index), objects, kind, **settings)
    probe.command(START)
    probe.drain()
    yield replace(found, can_id=can_id)
    found.put(found.before)


def set_up(
    probe: CanopenProbe,
    index: int,
    objects: Sequence[int],
    kind: int,
    *,
    can_id: int | None = None,
    inhibit: int = 0,
    event_ms: int = 0,
    start: int | None = None,
) -> int:
    """Configure a PDO by the procedure of CiA 301 and return its CAN ID.

    Other PDOs and the heartbeat are off.
    """
    probe.quiet()
    transmit = index >= 0x1800
    number = index & 0x1FF
    can_id = (0x180 if transmit else 0x200) + 0x100 * number + probe.node if can_id is None else can_id
    flags = NO_RTR if transmit else 0
    probe.set(index, 1, PDO_OFF | flags | can_id)
    probe.set(index + 0x200, 0, 0, 1)
    for position, value in enumerate(objects, 1):
        probe.set(index + 0x200, position, value)
    probe.set(index + 0x200, 0, len(objects), 1)
    probe.set(index, 2, kind, 1)
    settings: tuple[tuple[int, int | None, int], ...] = ((3, inhibit, 2), (5, event_ms, 2), (6, start, 1))
    for subindex, setting, size in settings:
        served = probe.has(index, subindex)
        if setting and not served:
            raise CaseSkipped(f"{index:04X}h has no sub-index {subindex}")
        if setting is not None and served:
            probe.set(index, subindex, setting, size)
    probe.set(index, 1, flags | can_id)
    probe.drain()
    return can_id


def _clear_mapping(probe: CanopenProbe, index: int) -> None:
    """Disable a PDO and clear its mapping."""
    probe.disable_pdo(index)
    probe.set(index + 0x200, 0, 0, 1)


def first(probe: CanopenProbe, kind: int) -> int:
    """Return the index of the first RPDO (1400h) or TPDO (1800h); skip the case if there is none."""
    indices = probe.pdo_indices(kind)
    if not indices:
        raise CaseSkipped(f"no PDO from {kind:04X}h on")
    return indices[0]


def send_sync(probe: CanopenProbe, counter: int | None = None) -> None:
    """Send a SYNC, with a counter if one is given."""
    probe.send(0x080, b"" if counter is None else bytes([counter]))


def after_event(probe: CanopenProbe, can_id: int, timeout_s: float | None = None) -> bytes:
    """Return the TPDO caused by a write to a mapped object; skip the case if the write is not an event."""
    data = probe.wait_for(can_id, timeout_s)
    if data is None:
        raise CaseSkipped("a write to a mapped object is not an event on this device")
    return data


# --- transmit PDOs ---


add_dialogues(
    TPDO,
    [
        Dialogue(
            "types",
            "reserved transmission types",
            "need 1800; set {tpdo}:2 241 u8 > VALUES; set {tpdo}:2 251 u8 > VALUES; set {tpdo}:2 0 u8; set {tpdo}:2 1 u8; "
            "set {tpdo}:2 240 u8; set {tpdo}:2 254 u8; set {tpdo}:2 255 u8",
        )
    ],
)


@TPDO.case("cyclic", "a synchronous TPDO is sent at every nth SYNC", "CiA 301 7.2.2.2")
def cyclic(probe: CanopenProbe) -> None:
    index, item = first(probe, 0x1800), constant(probe)
    value = probe.value(item)
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
    with carrying(probe, 0x1800, 0) as pdo:
        send_sync(probe)
        probe.wait_for(pdo.can_id, 0.1)
        probe.drain()
        send_sync(probe)
        probe.expect_silence(pdo.can_id, "TPDO without an event")
        pdo.put(pdo.changed)
        probe.expect_silence(pdo.can_id, "TPDO before the SYNC", 0.05)
        send_sync(probe)
        check_equal(after_event(probe, pdo.can_id), pdo.changed, "data")
        send_sync(probe)
        probe.expect_silence(pdo.can_id, "TPDO without a second event")


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
    with carrying(probe, 0x1800, EVENT) as pdo:
        probe.wait_for(pdo.can_id, 0.1)
        send_sync(probe)
        probe.expect_silence(pdo.can_id, "event-driven TPDO at SYNC")
        pdo.put(pdo.changed)
        check_equal(after_event(probe, pdo.can_id), pdo.changed, "data")


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
    with carrying(probe, 0x1800, EVENT, inhibit=1000) as pdo:
        probe.wait_for(pdo.can_id, 0.3)
        probe.wait_for(NOBODY, 0.15)
        pdo.put(pdo.changed)
        check_equal(after_event(probe, pdo.can_id, 3.0), pdo.changed, "data")
        start = probe.port.now()
        pdo.put(pdo.changed)
        pdo.put(pdo.other)
        check_equal(probe.expect(pdo.can_id, "second TPDO"), pdo.other, "data")
        seconds = probe.port.now() - start
        check(0.08 <= seconds <= 0.16, "0.1 s between them", f"{seconds:.3f} s")


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
    values = {item.qualname: probe.value(item) for item in (one, two)}
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
    probe.disable_pdo(index)
    for can_id in (*RESTRICTED_IDS, 0x2000_0181):
        probe.expect_refusal(index, 1, NO_RTR | can_id, 4, *VALUE_ABORTS)


@TPDO.case("fixed", "settings that cannot be changed while a TPDO is enabled")
def fixed(probe: CanopenProbe) -> None:
    index, item = first(probe, 0x1800), constant(probe)
    set_up(probe, index, [entry(item)], SYNCHRONOUS)
    probe.expect_refusal(index, 1, NO_RTR | 0x3F2, 4, *FIXED)
    for subindex, size in ((3, 2), (6, 1)):
        if probe.has(index, subindex):
            probe.expect_refusal(index, subindex, 5, size, *FIXED)
    probe.expect_refusal(index + 0x200, 0, 0, 1, *FIXED)
    probe.expect_refusal(index + 0x200, 1, entry(item), 4, *FIXED)
    probe.disable_pdo(index)
    probe.expect_refusal(index + 0x200, 1, entry(item), 4, *FIXED)
    probe.set(index + 0x200, 0, 0, 1)
    probe.set(index + 0x200, 1, entry(item))


@TPDO.case("reserved", "sub-index 4 of a TPDO does not exist", intrusive=False)
def reserved(probe: CanopenProbe) -> None:
    index = first(probe, 0x1800)
    if probe.od.get_variable(index, 4) is not None:
        raise CaseSkipped("the EDS has it")
    probe.expect_abort(bytes([0x40, index & 0xFF, index >> 8, 4]), Abort.NO_SUBINDEX)


@TPDO.case("mapping-refused", "mapping of objects that cannot be mapped", "CiA 301 7.5.2.38")
def mapping_refused(probe: CanopenProbe) -> None:
    index, item = first(probe, 0x1800), constant(probe)
    _clear_mapping(probe, index)
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
    _clear_mapping(probe, index)
    for position in (1, 2, 3):
        probe.set(index + 0x200, position, entry(wide))
    probe.expect_refusal(index + 0x200, 0, 3, 1, Abort.PDO_LENGTH)
    probe.expect_refusal(index + 0x200, 0, 65, 1, Abort.PDO_LENGTH, *VALUE_ABORTS)
    probe.set(index + 0x200, 0, 2, 1)


# --- receive PDOs ---


@RPDO.case("event", "an event-driven RPDO takes effect at once")
def rpdo_event(probe: CanopenProbe) -> None:
    with carrying(probe, 0x1400, EVENT) as pdo:
        for data in (pdo.other, pdo.changed):
            probe.send(pdo.can_id, data)
            check_equal(pdo.value(), data, "value")


@RPDO.case("gate", "RPDOs take effect only in OPERATIONAL", "CiA 301 7.3.2.2.5")
def rpdo_gate(probe: CanopenProbe) -> None:
    with carrying(probe, 0x1400, EVENT) as pdo:
        for command in (PRE_OPERATIONAL, STOP):
            probe.command(command)
            probe.send(pdo.can_id, pdo.changed)
            probe.command(PRE_OPERATIONAL)
            check_equal(pdo.value(), pdo.before, "value as before")


@RPDO.case("synchronous", "a synchronous RPDO takes effect at the next SYNC")
def rpdo_synchronous(probe: CanopenProbe) -> None:
    with carrying(probe, 0x1400, SYNCHRONOUS) as pdo:
        probe.send(pdo.can_id, pdo.other)
        probe.send(pdo.can_id, pdo.changed)
        check_equal(pdo.value(), pdo.before, "value before the SYNC")
        send_sync(probe)
        check_equal(pdo.value(), pdo.changed, "value after the SYNC")


@RPDO.case("short", "an RPDO that is too short is reported and not processed", "CiA 301 7.2.2.3, 7.2.7.1")
def rpdo_short(probe: CanopenProbe) -> None:
    with carrying(probe, 0x1400, EVENT, times=2) as pdo:
        emergency = probe.emergency_id()
        probe.send(pdo.can_id, pdo.changed)
        probe.expect_emergency(emergency, 0x8210)
        check_equal(pdo.value(), pdo.before, "value as before")


@RPDO.case("long", "an RPDO that is too long is reported", "CiA 301 7.2.2.3, 7.2.7.1")
def rpdo_long(probe: CanopenProbe) -> None:
    with carrying(probe, 0x1400, EVENT) as pdo:
        emergency = probe.emergency_id()
        probe.send(pdo.can_id, pdo.before + b"\0")
        probe.expect_emergency(emergency, 0x8220)
        probe.send(pdo.can_id, pdo.before)
        probe.expect_emergency(emergency, 0)


@RPDO.case("place-holder", "dummy entries skip bytes of an RPDO", "CiA 301 7.4.7")
def place_holder(probe: CanopenProbe) -> None:
    if 0x0006 not in probe.od:
        raise CaseSkipped("the EDS allows no dummy entry of 16 bits")
    with carrying(probe, 0x1400, EVENT, behind=(0x0006_0010,)) as pdo:
        probe.send(pdo.can_id, b"\x55\xaa" + pdo.changed)
        check_equal(pdo.value(), pdo.changed, "value")


@RPDO.case("deadline", "deadline of an RPDO", "CiA 301 7.5.2.35")
def deadline(probe: CanopenProbe) -> None:
    with carrying(probe, 0x1400, EVENT, event_ms=100) as pdo:
        emergency = probe.emergency_id()
        probe.expect_silence(emergency, "EMCY before the first message", 0.3)
        probe.send(pdo.can_id, pdo.before)
        start = probe.port.now()
        probe.expect_emergency(emergency, 0x8250)
        seconds = probe.port.now() - start
        check(0.08 <= seconds <= 0.16, "0.1 s after the message", f"{seconds:.3f} s")
        probe.send(pdo.can_id, pdo.before)
        probe.expect_emergency(emergency, 0)


@RPDO.case("refused", "configurations that an RPDO refuses", "CiA 301 7.5.2.35")
def rpdo_refused(probe: CanopenProbe) -> None:
    index = first(probe, 0x1400)
    set_up(probe, index, [entry(writable(probe).item)], EVENT)
    probe.expect_refusal(index, 1, 0x3F3, 4, *FIXED)
    for value in (241, 252, 253):
        probe.expect_refusal(index, 2, value, 1, *VALUE_ABORTS)
    probe.expect_refusal(index + 0x200, 0, 0, 1, *FIXED)
    probe.disable_pdo(index)
    for can_id in RESTRICTED_IDS:
        probe.expect_refusal(index, 1, can_id, 4, *VALUE_ABORTS)
    probe.set(index + 0x200, 0, 0, 1)
    constant_ = probe.find(
        "mappable read-only object", lambda item: item.pdo_mappable and item.access_type == "ro"
    )
    probe.expect_refusal(index + 0x200, 1, entry(constant_), 4, Abort.NOT_MAPPABLE)


# --- beyond CiA 301 ---


@DESIGN.case("write-event", "a write to a mapped object is an event")
def write_event(probe: CanopenProbe) -> None:
    with carrying(probe, 0x1800, EVENT) as pdo:
        probe.wait_for(pdo.can_id, 0.1)
        pdo.put(pdo.changed)
        check_equal(probe.expect(pdo.can_id, "TPDO after the write"), pdo.changed, "data")


@DESIGN.case("attitude", "TPDOs with the same sequence number are of one sample")
def attitude(probe: CanopenProbe) -> None:
    marker = probe.find("object named sequence", lambda item: item.name == "sequence" and item.pdo_mappable)
    chosen: list[int] = []
    probe.quiet()
    for index in probe.pdo_indices(0x1800):
        if probe.number(index + 0x200, 0) and probe.number(index + 0x200, 1) == entry(marker):
            probe.set(index, 2, SYNCHRONOUS, 1)
            can_id = 0x3E0 + len(chosen)
            probe.set(index, 1, PDO_OFF | NO_RTR | can_id)
            probe.set(index, 1, NO_RTR | can_id)
            chosen.append(can_id)
    check(len(chosen) >= 2, "two TPDOs that begin with the sequence number", len(chosen))
    probe.command(START)
    for _ in range(5):
        probe.drain()
        send_sync(probe)
        heads = {probe.expect(can_id, "TPDO")[:2] for can_id in chosen}
        check_equal(len(heads), 1, "sequence numbers and flags after one SYNC:")
