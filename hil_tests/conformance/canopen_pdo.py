"""CANopen conformance: transmit and receive PDOs (CiA 301 7.2.2, 7.5.2.34 to 7.5.2.38).

Most cases configure one PDO to carry one object, change the object or send the PDO, and look at the other.
"""

from __future__ import annotations

from typing import Final

from starhil.hil_tests.conformance.canopen_dialogue import Dialogue, add_dialogues
from starhil.hil_tests.conformance.canopen_probe import (
    NO_RTR,
    PDO_OFF,
    PRE_OPERATIONAL,
    RESTRICTED_IDS,
    START,
    VALUE_ABORTS,
    Abort,
    CanopenProbe,
    is_integer,
    size_of,
)
from starhil.hil_tests.conformance.case import CaseArea, CaseSkipped, check, check_equal
from starhil.hil_tests.conformance.pdo_setup import (
    EVENT,
    SYNCHRONOUS,
    constant,
    entry,
    first,
    send_sync,
    set_up,
    writable,
)

TPDO: Final = CaseArea[CanopenProbe]("canopen.tpdo", "CiA 301 7.5.2.37", intrusive=True)
RPDO: Final = CaseArea[CanopenProbe]("canopen.rpdo", "CiA 301 7.2.2.2", intrusive=True)
DESIGN: Final = CaseArea[CanopenProbe]("canopen.design", "interface definition: canopen.toml", intrusive=True)
"""Behaviour of this product beyond CiA 301."""

FIXED: Final = (Abort.ACCESS, Abort.DEVICE_STATE, Abort.VALUE)
"""Aborts with which stacks refuse to change the mapping of an enabled PDO; CiA 301 specifies none."""
RUNNING: Final = "nmt 1; drain; "
SILENT_SYNC: Final = "sync; no-tpdo 0.05; "

TPDO_DIALOGUES: Final = (
    Dialogue(
        "types", "reserved transmission types",
        "need 1800; set {tpdo}:2 241 u8 > VALUES; set {tpdo}:2 251 u8 > VALUES; set {tpdo}:2 0 u8; set {tpdo}:2 1 u8; "
        "set {tpdo}:2 240 u8; set {tpdo}:2 254 u8; set {tpdo}:2 255 u8",
    ),
    Dialogue(
        "cyclic", "a synchronous TPDO is sent at every nth SYNC",
        "; ".join(
            f"transmit {kind}; {RUNNING}" + (SILENT_SYNC * (kind - 1) + "sync; tpdo {value}; ") * 2 + "nmt 128" for kind in (1, 3)
        ),
        "CiA 301 7.2.2.2",
    ),
    Dialogue("not-without-sync", "a synchronous TPDO waits for SYNC", "transmit 1; nmt 1; no-tpdo 0.5", "CiA 301 7.2.2.2"),
    Dialogue(
        "acyclic", "an acyclic TPDO is sent only at the SYNC after an event",
        f"carry 1800 0; {RUNNING}sync; rest 0.1; drain; sync; no-tpdo; put {{changed}}; no-tpdo 0.05; "
        "sync; event-tpdo {changed}; sync; no-tpdo",
    ),
    Dialogue(
        "sync-start", "SYNC start value",
        f"need 1019; set 1019:0 8 u8; transmit 2 start=3; {RUNNING}"
        + "; ".join(f"sync {number}; {'tpdo' if number in (3, 5, 7) else 'no-tpdo 0.05'}" for number in range(1, 9)),
    ),
    Dialogue(
        "event", "an event-driven TPDO is sent after a change",
        f"carry 1800 255; {RUNNING}rest 0.1; sync; no-tpdo; put {{changed}}; event-tpdo {{changed}}",
        "CiA 301 7.2.2.2",
    ),
    Dialogue(
        "gate", "TPDOs are sent only in OPERATIONAL",
        "; ".join(
            f"transmit {kind}; " + "".join(f"nmt 1; sync; tpdo; nmt {command}; sleep 0.05; drain; sync; no-tpdo; " for command in (128, 2)) + "nmt 128"
            for kind in ("1", "255 event_ms=20")
        ),
        "CiA 301 7.3.2.2.5",
    ),
    Dialogue(
        "inhibit", "inhibit time",
        f"carry 1800 255 inhibit=1000; {RUNNING}rest 0.3; sleep 0.15; put {{changed}}; event-tpdo {{changed}} 3.0; "
        "clock; put {changed}; put {other}; tpdo {other}; took 0.08 0.16",
    ),
    Dialogue("identifier", "a TPDO with another CAN ID", "transmit 1; transmit 1 can_id=0x3f1; nmt 1; sync; tpdo; sync; none {tpdo_id}"),
    Dialogue(
        "forbidden", "CAN IDs that a TPDO must not have",
        "transmit 1; off {tpdo}"
        + "".join(f"; set {{tpdo}}:1 {NO_RTR | can_id} u32 > VALUES" for can_id in (*RESTRICTED_IDS, 0x2000_0181)),
        "CiA 301 7.3.5",
    ),
)  # fmt: skip
RPDO_DIALOGUES: Final = (
    Dialogue(
        "event", "an event-driven RPDO takes effect at once",
        f"carry 1400 255; {RUNNING}rpdo {{other}}; object {{other}}; rpdo {{changed}}; object {{changed}}",
    ),
    Dialogue(
        "gate", "RPDOs take effect only in OPERATIONAL",
        f"carry 1400 255; {RUNNING}" + "; ".join(f"nmt {command}; rpdo {{changed}}; nmt 128; object {{before}}" for command in (128, 2)),
        "CiA 301 7.3.2.2.5",
    ),
    Dialogue(
        "synchronous", "a synchronous RPDO takes effect at the next SYNC",
        f"carry 1400 1; {RUNNING}rpdo {{other}}; rpdo {{changed}}; object {{before}}; sync; object {{changed}}",
    ),
    Dialogue(
        "short", "an RPDO that is too short is reported and not processed",
        f"need 1014; carry 1400 255 times=2; {RUNNING}rpdo {{changed}}; emcy 8210; object {{before}}",
        "CiA 301 7.2.2.3, 7.2.7.1",
    ),
    Dialogue(
        "long", "an RPDO that is too long is reported",
        f"need 1014; carry 1400 255; {RUNNING}rpdo {{before}}00; emcy 8220; rpdo {{before}}; emcy 0000",
        "CiA 301 7.2.2.3, 7.2.7.1",
    ),
    Dialogue(
        "place-holder", "dummy entries skip bytes of an RPDO",
        f"need 0006; carry 1400 255 behind=0x00060010; {RUNNING}rpdo 55aa{{changed}}; object {{changed}}",
        "CiA 301 7.4.7",
    ),
    Dialogue(
        "deadline", "deadline of an RPDO",
        f"need 1014; carry 1400 255 event_ms=100; {RUNNING}calm 0.3; rpdo {{before}}; clock; emcy 8250; took 0.08 0.16; "
        "rpdo {before}; emcy 0000",
        "CiA 301 7.5.2.35",
    ),
)  # fmt: skip

add_dialogues(TPDO, TPDO_DIALOGUES)
add_dialogues(RPDO, RPDO_DIALOGUES)
add_dialogues(
    DESIGN,
    [
        Dialogue(
            "write-event",
            "a write to a mapped object is an event",
            f"carry 1800 255; {RUNNING}rest 0.1; put {{changed}}; tpdo {{changed}}",
        )
    ],
)


# --- transmit PDOs ---


@TPDO.case("event-timer", "event timer")
def event_timer(probe: CanopenProbe) -> None:
    can_id = set_up(probe, first(probe, 0x1800), [entry(constant(probe))], EVENT, event_ms=50)
    probe.command(START)
    probe.wait_for(can_id, 0.1)
    found = probe.count(can_id, 0.33)
    check(5 <= len(found) <= 8, "a TPDO every 50 ms", f"{len(found)} in 0.33 s")
    mean = (found[-1][0] - found[0][0]) / (len(found) - 1)
    check(0.04 <= mean <= 0.06, "period 0.05 s", f"{mean:.4f} s")


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


def _clear_mapping(probe: CanopenProbe, index: int) -> None:
    """Disable a PDO and clear its mapping."""
    probe.disable_pdo(index)
    probe.set(index + 0x200, 0, 0, 1)


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
