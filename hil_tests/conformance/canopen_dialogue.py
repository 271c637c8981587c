"""Cases written as dialogues: what the master sends, and what the node must answer.

    40 {text} > *; 70 > abort TOGGLE {text}; 60 > abort COMMAND; kept

Lines are separated by semicolons. `REQUEST > ANSWER` sends bytes, padded to 8, and looks at the next frame of the node;
without a request, it looks at the frame after that, and after `wait` for as long as a transfer may take to time out.
An answer is one of

    60 {text} 00000000      these bytes; `..` is any byte, a final `*` any others
    abort A|B MUX           an abort with one of these codes, for this object if one is given
    unless abort A|B MUX    either this abort, which ends the dialogue, or another answer
    segment N               segment N of a block
    block MUX               the answer to a block download, with a block size of 1 to 127
    silence, *, -           no answer; any answer or none; do not wait

Other lines begin with a verb:

    need 1016 1010:3            skip the case if an object or entry is missing
    set 1017:0 20 u16           write a number; it must be accepted
    set 1003:0 1 u8 > A|B       it must be refused with one of these aborts; VALUES stands for those of a wrong value
    set 1010:1 save             write a text
    holds 1005:0 0x80 0x7ff     read a number, and look at the bits of a mask
    value BYTES, kept           read the writable number: these bytes, or as it was before the dialogue
    nmt 1, nmt 1 all, nmt 1 other       an NMT command to the node, to all nodes, to another node
    boot-up, state 7f           the boot-up message; the next heartbeat, with this state
    none {heartbeat} 0.3        no frame with this CAN ID, within a time, s
    guard 7f, guard             node guarding is answered with this state and toggle bit, or not at all
    watched                     a heartbeat of the node that this one watches
    emcy 8130 0.3, calm 0.4     this EMCY, or none, within a time, s
    send 000 01 extended        a frame, with 29 bits of CAN ID or as a remote frame if so said
    sleep 0.2, drain, quiet, reset      wait; forget what was received; PDOs and heartbeat off; reset of the communication
    clock, took 0.08 0.16       start of a time; its limits, s

and of PDOs:

    transmit 1 start=3          the first TPDO carries a constant object, with this transmission type; other settings as in `set_up`
    carry 1800 255 times=2      the first TPDO or RPDO (1400) carries a writable object, which is restored at the end
    off 1800                    disable the PDO with this communication record
    sync, sync 3                a SYNC, or one with a counter
    tpdo 2a00, tpdo, no-tpdo 0.1        the TPDO comes with these bytes or any, or not within a time, s
    event-tpdo 2a00 3.0         the same within a time; skip the case if it does not come
    rest 0.1                    wait for a TPDO that may come or not
    rpdo 2a00, put 2a00, object 2a00    send the RPDO; write the carried object by SDO; its value

Names in braces are in `Names`; all are found before the first request.
"""

from __future__ import annotations

import re
from binascii import crc_hqx
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Final

from canopen.objectdictionary import ODVariable, datatypes

from starhil.hil_tests.conformance.canopen_probe import (
    ANSWER_S,
    NOBODY,
    VALUE_ABORTS,
    Abort,
    CanopenProbe,
    check_abort,
    check_answer,
    is_integer,
    size_of,
)
from starhil.hil_tests.conformance.case import CaseArea, CaseFailed, CaseSkipped, check, check_equal
from starhil.hil_tests.conformance.pdo_setup import (
    TPDO,
    Carried,
    constant,
    entry,
    first,
    pdo_id,
    send_sync,
    set_up,
    writable,
)
from starhil.hil_tests.judge.canopen import HEARTBEAT, SDO_REQUEST, SDO_RESPONSE, multiplexer

LONGEST_TIMEOUT_S: Final = 12.0
"""Maximum time in which a node aborts a transfer whose client stops sending."""

SHOWN_STEPS: Final = 4
"""Number of steps before a failed one in its message."""
IDENTITY: Final = ("vendor", "product", "revision", "serial")
"""Parts of 1018h, from sub-index 1 on."""
COB_IDS: Final = {"request": SDO_REQUEST, "response": SDO_RESPONSE, "heartbeat": HEARTBEAT}
"""CAN IDs to which the node ID is added."""

Ask = Callable[[bytes, float], bytes | None]
"""Sends a request (empty: none) and returns the next answer within a time, or None."""


@dataclass(frozen=True)
class Dialogue:
    """A case as a dialogue; id, title, clause and intrusive as in a case, with the area's defaults."""

    id: str
    title: str
    lines: str
    clause: str | None = None
    intrusive: bool | None = None


class Names(dict[str, str]):
    """The names in braces, in hexadecimal, each found when it is first used.

    `text`, `number`, `write_only`: multiplexer of a long readable text, of a writable number of 16 bits, of an object
    that cannot be read; `new`, `low`, `high`: another value for the number, and its bytes; `crc`, `bad_crc`: CRC of this
    value, and another; `tpdo`, `tpdo_id`: index and default CAN ID of the first TPDO; `value`: of the constant object;
    `before`, `other`, `changed`: values of the carried object; `node`; `request`, `response`, `heartbeat`: CAN IDs, and
    `other_request`: that of another node; `vendor`, `product`, `revision`, `serial`: parts of the identity.
    """

    def __init__(self, probe: CanopenProbe) -> None:
        self._probe = probe

    @cached_property
    def carried(self) -> Carried:
        """The writable object for a PDO."""
        return writable(self._probe)

    def __missing__(self, name: str) -> str:
        self[name] = found = self._find(name)
        return found

    def _find(self, name: str) -> str:
        probe = self._probe
        if name == "text":
            return mux(long_text(probe)[0])
        if name == "number":
            return mux(writable_number(probe))
        if name == "write_only":
            return mux(probe.find("write-only object", lambda item: item.access_type == "wo"))
        if name == "tpdo":
            return f"{next(iter(probe.pdo_indices(TPDO)), TPDO):04x}"
        if name == "tpdo_id":
            return f"{pdo_id(first(probe, TPDO), probe.node):03x}"
        if name in ("before", "other", "changed"):
            return bytes(getattr(self.carried, name)).hex()
        if name == "value":
            return probe.value(constant(probe)).hex()
        if name == "node":
            return f"{probe.node:02x}"
        if name in COB_IDS:
            return f"{COB_IDS[name] + probe.node:03x}"
        if name == "other_request":
            return f"{COB_IDS['request'] + probe.node % 127 + 1:03x}"
        if name in IDENTITY:
            return probe.read(0x1018, IDENTITY.index(name) + 1).hex()
        before = probe.value(writable_number(probe))
        new = bytes((before[0] ^ 0x55, before[1] ^ 0x01))
        crc = crc_hqx(new, 0).to_bytes(2, "little")
        bad = bytes((crc[0], crc[1] ^ 1))
        return {"new": new, "low": new[:1], "high": new[1:], "crc": crc, "bad_crc": bad}[name].hex()


def add_dialogues(
    area: CaseArea[CanopenProbe],
    table: Iterable[Dialogue],
    ask_of: Callable[[CanopenProbe], Ask] | None = None,
    prepare: Callable[[CanopenProbe], object] = lambda _probe: None,
) -> None:
    """Add one case per dialogue; `ask_of` returns how its requests are sent, by default by SDO; `prepare` precedes it."""

    def run(row: Dialogue, probe: CanopenProbe) -> None:
        prepare(probe)
        hold(probe, row.lines, (ask_of or sdo)(probe))

    for row in table:
        area.case(row.id, row.title, row.clause, intrusive=row.intrusive)(partial(run, row))


def sdo(probe: CanopenProbe) -> Ask:
    """Return how requests are sent to the SDO server."""

    def ask(data: bytes, timeout_s: float) -> bytes | None:
        return probe.ask(data, timeout_s) if data else probe.wait_for(SDO_RESPONSE + probe.node, timeout_s)

    return ask


def hold(probe: CanopenProbe, lines: str, ask: Ask) -> None:
    """Hold a dialogue."""
    for needed in re.findall(r"need ([\w: ]+)", lines):
        probe.require(*needed.split())
    names = Names(probe)
    master = _Master(probe, lines, names)
    steps = [step.strip() for step in lines.format_map(names).split(";")]
    for number, step in enumerate(steps):
        try:
            if _ends(master, step, ask):
                break
        except CaseFailed as failure:
            before = f", after {'; '.join(steps[max(0, number - SHOWN_STEPS) : number])}" if number else ""
            raise CaseFailed(
                f"{failure.expected} (step {number + 1}: {step}{before})", failure.seen
            ) from None
    if "carry" in lines:
        master.put(names.carried.before.hex())


class _Master:
    """The verbs of a dialogue, with the words that follow them."""

    def __init__(self, probe: CanopenProbe, lines: str, names: Names) -> None:
        self.drain, self.quiet, self.reset = probe.drain, probe.quiet, probe.reset_communication
        self.boot_up, self.watched = probe.expect_boot_up, probe.send_watched_heartbeat
        self._probe, self._names = probe, names
        self._pdo_id, self._began = 0, 0.0
        self._emergency = probe.emergency_id() if re.search("emcy|calm", lines) else 0
        self._number = writable_number(probe) if re.search("value|kept", lines) else None
        self._before = b"" if self._number is None else probe.value(self._number)

    def need(self, *_indices: str) -> None:
        pass  # checked before the dialogue

    def set(self, entry: str, value: str, kind: str = "", *refused: str) -> None:
        index, subindex = (int(part, 16) for part in entry.split(":"))
        data = int(value, 0).to_bytes(int(kind[1:]) // 8, "little") if kind else value.encode()
        if refused:
            self._probe.expect_refusal(index, subindex, data, len(data), *_codes(refused[1]))
        else:
            self._probe.set(index, subindex, data)

    def holds(self, entry: str, number: str, mask: str = "-1") -> None:
        index, subindex = (int(part, 16) for part in entry.split(":"))
        check_equal(self._probe.number(index, subindex) & int(mask, 0), int(number, 0), f"{index:04X}h")

    def value(self, *data: str) -> None:
        check_equal(self._read(), bytes.fromhex("".join(data)), "value")

    def kept(self) -> None:
        check_equal(self._read(), self._before, "value as before")

    def _read(self) -> bytes:
        return b"" if self._number is None else self._probe.value(self._number)

    def nmt(self, command: str, whom: str = "") -> None:
        node = {"all": 0, "other": self._probe.node % 127 + 1}.get(whom)
        self._probe.command(int(command), node)

    def state(self, wanted: str) -> None:
        check_equal(f"{self._probe.state():02x}", wanted, "state")

    def none(self, can_id: str, for_s: str = "0.1") -> None:
        self._probe.expect_silence(int(can_id, 16), f"frame with CAN ID 0x{can_id}", float(for_s))

    def guard(self, wanted: str = "") -> None:
        can_id = HEARTBEAT + self._probe.node
        self._probe.send(can_id, remote=True)
        if wanted:
            seen = self._probe.expect(can_id, "answer to node guarding").hex()
            check(seen in wanted.split("|"), f"answer {wanted} to node guarding", seen)
        else:
            self._probe.expect_silence(can_id, "answer to node guarding", 0.2)

    def emcy(self, code: str, within_s: str = str(ANSWER_S)) -> None:
        self._probe.expect_emergency(self._emergency, int(code, 16), float(within_s))

    def calm(self, for_s: str) -> None:
        self._probe.expect_silence(self._emergency, "EMCY", float(for_s))

    def send(self, can_id: str, *content: str) -> None:
        data = "".join(word for word in content if word not in ("extended", "remote"))
        self._probe.send(int(can_id, 16), data, extended="extended" in content, remote="remote" in content)

    def sleep(self, seconds: str) -> None:
        self._probe.wait_for(NOBODY, float(seconds))

    def clock(self) -> None:
        self._began = self._probe.port.now()

    def took(self, least: str, most: str) -> None:
        seconds = self._probe.port.now() - self._began
        check(float(least) <= seconds <= float(most), f"after {least} to {most} s", f"{seconds:.3f} s")

    # PDOs

    def transmit(self, kind: str, *settings: str) -> None:
        self._set_up(TPDO, [entry(constant(self._probe))], kind, settings)

    def carry(self, kind: str, transmission: str, *settings: str) -> None:
        given = dict(setting.split("=") for setting in settings)
        objects = [int(given.pop("behind"), 0)] if "behind" in given else []
        objects += [entry(self._names.carried.item)] * int(given.pop("times", "1"))
        self._set_up(int(kind, 16), objects, transmission, [f"{name}={text}" for name, text in given.items()])

    def _set_up(self, kind: int, objects: list[int], transmission: str, settings: Iterable[str]) -> None:
        given = {name: int(text, 0) for name, text in (setting.split("=") for setting in settings)}
        self._pdo_id = set_up(self._probe, first(self._probe, kind), objects, int(transmission), **given)

    def off(self, index: str) -> None:
        self._probe.disable_pdo(int(index, 16))

    def sync(self, counter: str = "") -> None:
        send_sync(self._probe, int(counter) if counter else None)

    def tpdo(self, *data: str) -> None:
        self._check_tpdo(self._probe.expect(self._pdo_id, "TPDO"), *data)

    def event_tpdo(self, wanted: str, within_s: str = str(ANSWER_S)) -> None:
        seen = self._probe.wait_for(self._pdo_id, float(within_s))
        if seen is None:
            raise CaseSkipped("a write to a mapped object is not an event on this device")
        self._check_tpdo(seen, wanted)

    def _check_tpdo(self, seen: bytes, *wanted: str) -> None:
        for data in wanted:
            check_equal(seen, bytes.fromhex(data), "data")

    def no_tpdo(self, for_s: str = "0.1") -> None:
        self._probe.expect_silence(self._pdo_id, "TPDO", float(for_s))

    def rest(self, seconds: str) -> None:
        self._probe.wait_for(self._pdo_id, float(seconds))

    def rpdo(self, data: str) -> None:
        self._probe.send(self._pdo_id, data)

    def put(self, data: str) -> None:
        self._probe.put(self._names.carried.item, bytes.fromhex(data))

    def object(self, data: str) -> None:
        check_equal(self._probe.value(self._names.carried.item), bytes.fromhex(data), "value")


def _codes(names: str) -> tuple[int, ...]:
    return VALUE_ABORTS if names == "VALUES" else tuple(Abort[name] for name in names.split("|"))


def _ends(master: _Master, line: str, ask: Ask) -> bool:
    """Do what a line says, and check the answer; return whether the dialogue ends with it."""
    verb, *words = line.split()
    act = getattr(master, verb.replace("-", "_"), None) if verb[:1].isalpha() else None
    if act is not None:
        act(*words)
        return False
    request, _, answer = (part.strip() for part in line.partition(">"))
    data = b"" if request == "wait" else bytes.fromhex(request)
    kind, *details = answer.split()
    timeout_s = {"silence": 0.1, "-": 0.0}.get(kind, LONGEST_TIMEOUT_S if request == "wait" else ANSWER_S)
    seen = ask(data, timeout_s)
    match kind:
        case "silence":
            check(seen is None, f"no answer to {request}", seen or "an empty frame")
        case "abort":
            check_abort(seen, *_codes(details[0]), multiplexer="".join(details[1:]))
        case "unless":
            if seen is None or seen[0] == 0x80:
                check_abort(seen, *_codes(details[1]), multiplexer="".join(details[2:]))
                return True
        case "segment":
            check(seen is not None, f"segment {details[0]} of the block", seen)
            check_equal((seen or b"\0")[0] & 0x7F, int(details[0]), "segment number")
        case "block":
            check(seen is not None and seen[0] & 0xFB == 0xA0, "answer A0h or A4h", seen)
            check_equal((seen or b"")[1:4].hex(), details[0], "multiplexer")
            check(1 <= (seen or bytes(5))[4] <= 127, "block size 1 to 127", seen)
        case "*" | "-":
            pass
        case _:
            check_answer(seen, answer)
    return False


# --- objects that every node has in some form ---


def mux(item: ODVariable) -> str:
    """Return the multiplexer of an object as hexadecimal text."""
    return multiplexer(item.index, item.subindex).hex()


def long_text(probe: CanopenProbe) -> tuple[ODVariable, bytes]:
    """Return a readable text that takes three segments, or two full ones if there is no longer text."""
    two_segments: tuple[ODVariable, bytes] | None = None
    for item in probe.variables():
        if item.data_type in {datatypes.VISIBLE_STRING, datatypes.OCTET_STRING} and item.readable:
            value = probe.try_read(item.index, item.subindex)
            if isinstance(value, bytes) and len(value) > 14:
                return item, value
            if isinstance(value, bytes) and len(value) == 14 and two_segments is None:
                two_segments = item, value
    if two_segments is None:
        raise CaseSkipped("no readable text of 14 bytes or more")
    return two_segments


def writable_number(probe: CanopenProbe) -> ODVariable:
    """Return a writable 16-bit number without side effects, preferably the heartbeat time."""
    return probe.od.get_variable(0x1017) or probe.find(
        "writable 16-bit number",
        lambda item: item.access_type == "rw" and is_integer(item) and size_of(item) == 2,
    )
