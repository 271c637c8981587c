"""Cases on CANopen that are written as text: requests to the node by SDO and LSS, frames, and verbs for the rest.

    40 {text} > *
    70 > abort TOGGLE {text}
    if 1003 kept 1003:0

The language is that of `dialogue`, and the cases are in areas with `links = ["canopen"]` of a file of cases (`case_file`).
`REQUEST > ANSWER` sends bytes by SDO, padded to 8, and checks the next answer of the node; `> ANSWER` checks the one after
that. An answer is one of

    60 {text} 00000000      these bytes; `..` is any byte, a final `*` any others
    abort A|B MUX           an abort with one of these codes, for this object if one is given
    unless abort A|B MUX    either this abort, which ends the dialogue, or another answer
    segment N DATA          segment N of a block, with this data if any is given
    block MUX               the answer to a block download, with a block size of 1 to 127
    silence, *, -           no answer; any answer or none; do not wait
    silence or abort A      one of several answers

Frames are sent as they are; of the answer, the next frame with its CAN ID is checked, which must arrive within 0.5 s:

    000#03{node}            sends a frame; `080#R` a remote frame, `00000000#01` one with a CAN ID of 29 bits
    > {tpdo_id}#2a..        takes a frame; {tpdo_id}#* one with any data

The other steps begin with a verb:

    need 1016 1010:3, lacks 1800:4      skip the case if an object or entry is missing, or is there
    if 1019 LINE                the line, if the EDS has the object or entry
    set 1017:0 20|30 u16        write numbers (u8 to u64, i8 to i64), which must be accepted
    set 1010:1 save, set 2000:1 0a0b bytes      write a text, bytes
    set 1003:0 1 u8 > A|B       each must be refused with one of these aborts; VALUES stands for those of a wrong value
    holds 1005:0 0x80 u32 0x7ff     read a number, a text or bytes; of a number, the bits of a mask if one is given
    default 1017:0              read a number, which is the default of the EDS
    read 1003:1 > A|B, read 1000:0      a read must be refused, accepted
    note 1017:0, kept 1017:0    remember the bytes of an entry; they must be the same again
    segments BYTES              the upload that has begun returns these bytes in segments
    upload MUX 127 BYTES no-crc     block upload with this many segments in a block, of these bytes if any are given
    nmt 1, nmt 1 all, nmt 1 other       an NMT command to the node, to all nodes, to another node
    reset, reset node, boot-up  reset of communication or node with its boot-up message; that message alone
    state 7f                    the next heartbeat, with this state
    event 181#2a00, event 181#2a00 3.0  a frame like this, within a time, s; skip the case if none comes
    none {heartbeat} 0.3 00     no frame with this CAN ID, or with this data too, within a time, s
    count 080 0.15 5 8          the number of frames in a time, s, and its limits
    counted 01 02, period 0.04 0.06     their data, from the first on; limits of their mean distance, s
    guard 7f, guard             node guarding is answered with this state and toggle bit, or not at all
    watched                     a heartbeat of the node that this one watches
    emcy 8130 0.3, register 11  this EMCY within a time, s; its error register has these bits (00: none), as has 1001h
    cause, clear                cause or clear the error {error}
    fill-history                cause and clear it more often than the error history has entries
    map {tpdo} 1 {constant} event_ms=20     configure a PDO: transmission type, mapping entries, and can_id, inhibit, event_ms, start
    off 1800                    disable the PDO with this communication record
    sync, sync 3                a SYNC, or one with a counter
    quiet                       PDOs and heartbeat off
    wait > ANSWER               an answer within as long as a transfer may take to time out
    clock, took 0.08 0.16       start of a time; its limits, s
    lss                         select the node by LSS, to which all further requests go; skip the case if it has none
    scan VENDOR PRODUCT REVISION SERIAL     Fastscan finds this identity
    node 2d                     the node has another node ID from now on

Indices, CAN IDs and data are in hexadecimal. Names in braces are in `canopen_names`; all are found before the first request.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Final

from starhil.hil_tests.client.raw_traffic import matches, parse_frame, pattern
from starhil.hil_tests.conformance.canopen_names import FINDERS, PARTS, TPDO, Names, default_id, provoke
from starhil.hil_tests.conformance.canopen_probe import (
    ANSWER_S,
    LSS_FROM_SLAVE,
    LSS_TO_SLAVE,
    NO_RTR,
    PDO_OFF,
    RESET_COMMUNICATION,
    RESET_NODE,
    VALUE_ABORTS,
    Abort,
    CanopenProbe,
    check_abort,
    check_answer,
)
from starhil.hil_tests.conformance.case import Case, CaseFailed, CaseSkipped, check, check_equal
from starhil.hil_tests.conformance.case_file import text_cases
from starhil.hil_tests.conformance.dialogue import Dialogue, Seconds, check_literal
from starhil.hil_tests.judge.canopen import ABORT, HEARTBEAT, SDO_RESPONSE, SEGMENT, SYNC

LONGEST_TIMEOUT_S: Final = 12.0
"""Maximum time in which a node aborts a transfer whose client stops sending."""
NAMES_OF_VERBS: Final = {"emcy": "emcy_id", "cause": "error", "fill-history": "error", "lss": "vendor"}
"""Verb → name that it needs, found before the first request too."""
ANSWERS: Final = {"abort", "unless", "segment", "block", "silence", "*", "-"}
"""First words of answers other than bytes."""


# --- the words of a line ---


def _entry(text: str) -> tuple[int, int]:
    index, subindex = text.split(":")
    return int(index, 16), int(subindex, 16)


def _item(text: str) -> str:
    if not re.fullmatch("[0-9a-fA-F]{4}(:[0-9a-fA-F]{1,2})?", text):
        raise ValueError(f"{text!r} is not INDEX or INDEX:SUBINDEX")
    return text


def _aborts(text: str) -> tuple[int, ...]:
    return tuple(
        code for name in text.split("|") for code in (VALUE_ABORTS if name == "VALUES" else (Abort[name],))
    )


def _object(text: str) -> tuple[str, int]:
    """Read a mapping entry, with an empty name, or a setting of a PDO, `name=number`."""
    name, _, number = text.rpartition("=")
    if name not in ("", "can_id", "inhibit", "event_ms", "start"):
        raise ValueError(f"unknown setting {name!r}")
    return name, int(number, 0)


def _data_of(values: str, kind: str = "") -> list[bytes]:
    """Return values as bytes: texts, hexadecimal digits, or numbers of a kind such as `u16`."""
    if kind in ("", "bytes"):
        return [bytes.fromhex(value) if kind else value.encode() for value in values.split("|")]
    if not re.fullmatch("[ui](8|16|24|32|40|48|56|64)", kind):
        raise ValueError(f"unknown kind {kind!r}")
    size, signed = int(kind[1:]) // 8, kind[0] == "i"
    return [int(value, 0).to_bytes(size, "little", signed=signed) for value in values.split("|")]


def _name(entry: tuple[int, int]) -> str:
    return f"{entry[0]:04X}h:{entry[1]:02X}h"


Number = Annotated[int, partial(int, base=0)]
Hex = Annotated[int, partial(int, base=16)]
Bytes = Annotated[bytes, bytes.fromhex]
Entry = Annotated[tuple[int, int], _entry]
Item = Annotated[str, _item]
Objects = Annotated[tuple[str, int], _object]
Frame = Annotated[str, pattern]
Aborts = Annotated[tuple[int, ...], _aborts]


def _answer(text: str) -> str:
    """Check what may follow `>`: one or several answers, separated by `or`."""
    for answer in text.removeprefix("unless ").split(" or "):
        kind, *details = answer.split() or [""]
        if not kind or (kind == "abort" and not details):
            raise ValueError("an answer or the code of an abort is missing")
        if kind == "abort":
            _aborts(details[0])
        elif kind not in ANSWERS:
            check_literal(answer, answer=True)
    return text


Answer = Annotated[str, _answer]


# --- holding a case ---


def _check(response: bytes | None, answer: str) -> None:
    kind, *details = answer.split()
    match kind:
        case "silence":
            check(response is None, "no answer", response or "an empty frame")
        case "abort":
            check_abort(response, *_aborts(details[0]), multiplexer="".join(details[1:]))
        case "segment":
            number, *data = details
            check(response is not None, f"segment {number} of the block", response)
            check_equal((response or b"\0")[0] & 0x7F, int(number), "segment number")
            if data:
                check_equal((response or b"")[1:], bytes.fromhex("".join(data)), "data of the segment")
        case "block":
            check(response is not None and response[0] & 0xFB == 0xA0, "answer A0h or A4h", response)
            check_equal((response or b"")[1:4].hex(), details[0], "multiplexer")
            check(1 <= (response or bytes(5))[4] <= 127, "block size 1 to 127", response)
        case "*" | "-":
            pass
        case _:
            check_answer(response, answer)


class CanopenDialogue(Dialogue[CanopenProbe]):
    """A case on CANopen."""

    def __init__(self, probe: CanopenProbe) -> None:
        super().__init__(probe)
        self._names = Names(probe)
        self._has_lss, self._began = False, 0.0
        self._noted: dict[tuple[int, int], bytes] = {}
        self._counted: list[tuple[float, bytes]] = []
        self._emergency = b""

    @classmethod
    def _check_step(cls, step: str) -> None:
        if step.startswith("if "):
            _, needed, step = step.split(maxsplit=2)
            if "{" not in needed:
                _item(needed)
        super()._check_step(step)
        verb, words, _ = cls._parts(step)
        if verb in ("do_set", "do_holds") and "{" not in step:
            _data_of(*words[1:3])

    @classmethod
    def _check_answer(cls, words: Sequence[str], answer: str) -> None:
        if answer or not any("#" in word for word in words):
            _answer(answer)

    def _find_names(self, steps: Sequence[str]) -> Mapping[str, str]:
        for step in steps:
            if step.startswith("need "):
                self._probe.require(*step.split()[1:])
        words = [word for step in steps for word in step.split()]
        for name in (name for verb, name in NAMES_OF_VERBS.items() if verb in words):
            self._names[name]
        return self._names

    def _ends_with(self, step: str) -> bool:
        if step.startswith("if "):
            _, needed, step = step.split(maxsplit=2)
            if self._probe.lacks(needed):
                return False
        return super()._ends_with(step)

    def _exchange(self, words: Sequence[str], answer: str) -> bool:
        """Send a request or frames, and check the answer."""
        frames = [parse_frame(word) for word in words if "#" in word]
        for frame in frames:
            self._probe.send_frame(frame)
        if frames and not answer:
            return False
        if "#" in answer:
            self._expect_frame(answer)
            return False
        timeout_s = {"silence": 0.1, "-": 0.0}.get(answer, ANSWER_S)
        return self._judge(self._ask(bytes.fromhex("".join(words)), timeout_s), answer)

    def _expect_frame(self, frame: str) -> None:
        data = self._probe.expect(int(frame.partition("#")[0], 16), "frame")
        check(_is_frame(frame, data), f"frame {frame}", data)

    def _judge(self, data: bytes | None, answer: str) -> bool:
        """Check an answer of the node; return whether the dialogue ends with it."""
        is_optional = answer.startswith("unless ")
        if is_optional and data is not None and data[0] != ABORT:
            return False
        failures = []
        for alternative in answer.removeprefix("unless ").split(" or "):
            try:
                _check(data, alternative)
            except CaseFailed as failure:
                failures.append(failure)
            else:
                return is_optional
        raise CaseFailed(" or ".join(failure.expected for failure in failures), failures[0].seen)

    def _ask(self, data: bytes, timeout_s: Seconds = ANSWER_S) -> bytes | None:
        """Send a request, unless it is empty, to the SDO server or by LSS; return the next answer within a time."""
        if data and self._has_lss:
            self._probe.send(LSS_TO_SLAVE, data.ljust(8, b"\0"))
        elif data:
            self._probe.send_request(data)
        answers = LSS_FROM_SLAVE if self._has_lss else SDO_RESPONSE + self._probe.node
        return self._probe.wait_for(answers, timeout_s) if timeout_s else None

    # Entries

    def do_need(self, *_entries: Item) -> None:
        pass  # checked before the dialogue

    def do_lacks(self, *entries: Item) -> None:
        for item in entries:
            if not self._probe.lacks(item):
                raise CaseSkipped(f"the EDS has {item}")

    def do_set(self, entry: Entry, values: str, kind: str = "", *, refused: Aborts = ()) -> None:
        for data in _data_of(values, kind):
            if refused:
                self._probe.expect_refusal(*entry, data, *refused)
            else:
                self._probe.set(*entry, data)

    def do_read(self, entry: Entry, *, refused: Aborts = ()) -> None:
        if refused:
            self._probe.expect_unreadable(*entry, *refused)
        else:
            self._probe.read(*entry)

    def do_holds(self, entry: Entry, value: str, kind: str = "", mask: Number = -1) -> None:
        both = self._probe.read(*entry), *_data_of(value, kind)
        numbers = [int.from_bytes(data, "little", signed=kind[:1] == "i") & mask for data in both]
        seen, wanted = numbers if kind[:1] in ("u", "i") else both
        check_equal(seen, wanted, _name(entry))

    def do_default(self, entry: Entry) -> None:
        item = self._probe.od.get_variable(*entry)
        check_equal(self._probe.number(*entry), 0 if item is None else item.default, _name(entry))

    def do_note(self, entry: Entry) -> None:
        self._noted[entry] = self._probe.read(*entry)

    def do_kept(self, entry: Entry) -> None:
        check_equal(self._probe.read(*entry), self._noted[entry], f"{_name(entry)}, as before:")

    # Long transfers

    def do_segments(self, value: Bytes) -> None:
        for start in range(0, len(value), SEGMENT):
            data, toggle = value[start : start + SEGMENT], 0x10 * (start // SEGMENT % 2)
            head = toggle | SEGMENT - len(data) << 1 | (start + SEGMENT >= len(value))
            check_answer(self._ask(bytes([0x60 | toggle])), f"{head:02x}{data.hex()}*")

    def do_upload(self, mux: Bytes, block: Number, value: Bytes = b"", crc: str = "") -> None:
        seen = self._probe.upload_blocks(mux, block, crc=crc != "no-crc")
        if value:
            check_equal(seen, value, "value")

    # States

    def do_nmt(self, command: Number, whom: str = "") -> None:
        node = {"all": 0, "other": self._probe.node % 127 + 1}.get(whom)
        self._probe.nmt(command, node)

    def do_reset(self, whom: str = "") -> None:
        self._probe.drain()
        self._probe.nmt(RESET_NODE if whom == "node" else RESET_COMMUNICATION)
        self._probe.expect_boot_up()

    def do_boot_up(self) -> None:
        self._probe.expect_boot_up()

    def do_state(self, state: str) -> None:
        check_equal(f"{self._probe.state():02x}", state, "state")

    def do_node(self, number: Hex) -> None:
        self._probe.node = number

    def do_guard(self, states: str = "") -> None:
        can_id = HEARTBEAT + self._probe.node
        self._probe.send(can_id, remote=True)
        if states:
            seen = self._probe.expect(can_id, "answer to node guarding").hex()
            check(seen in states.split("|"), f"answer {states} to node guarding", seen)
        else:
            self._probe.expect_silence(can_id, "answer to node guarding", 0.2)

    def do_watched(self) -> None:
        self._probe.send_watched_heartbeat()

    # Frames

    def do_event(self, frame: Frame, within_s: Seconds = ANSWER_S) -> None:
        seen = self._probe.wait_for(int(frame.partition("#")[0], 16), within_s)
        if seen is None:
            raise CaseSkipped("a write to a mapped object is not an event on this device")
        check(_is_frame(frame, seen), f"frame {frame}", seen)

    def do_none(self, can_id: Hex, for_s: Seconds = 0.1, data: Bytes = b"") -> None:
        seen = self._probe.wait_for(can_id, for_s, lambda seen: data in (b"", seen))
        check(seen is None, f"no frame with CAN ID 0x{can_id:03X}", seen or "an empty frame")

    def do_count(self, can_id: Hex, for_s: Seconds, least: Number, most: Number) -> None:
        self._counted = self._probe.count(can_id, for_s)
        number = len(self._counted)
        check(
            least <= number <= most,
            f"{least} to {most} frames with CAN ID 0x{can_id:03X} in {for_s:g} s",
            number,
        )

    def do_counted(self, *data: Bytes) -> None:
        seen = [item.hex() for _, item in self._counted[: len(data)]]
        check_equal(seen, [item.hex() for item in data], "data")

    def do_period(self, least: Seconds, most: Seconds) -> None:
        mean = (self._counted[-1][0] - self._counted[0][0]) / (len(self._counted) - 1)
        check(least <= mean <= most, f"a period of {least:g} to {most:g} s", f"{mean:.4f} s")

    def do_sync(self, *counter: Number) -> None:
        self._probe.send(SYNC, bytes(counter))

    def do_quiet(self) -> None:
        self._probe.quiet()

    def do_wait(self, *, answer: Answer) -> bool:
        return self._judge(self._ask(b"", LONGEST_TIMEOUT_S), answer)

    def do_clock(self) -> None:
        self._began = self._probe.now()

    def do_took(self, least: Seconds, most: Seconds) -> None:
        seconds = self._probe.now() - self._began
        check(least <= seconds <= most, f"after {least:g} to {most:g} s", f"{seconds:.3f} s")

    # EMCY

    def do_emcy(self, code: Hex, within_s: Seconds = ANSWER_S) -> None:
        can_id = int(self._names["emcy_id"], 16)
        self._emergency = self._probe.expect(can_id, f"EMCY {code:04X}h", within_s)
        check_equal(len(self._emergency), 8, "bytes of EMCY")
        check_equal(self._emergency[:2], code.to_bytes(2, "little"), "error code")

    def do_register(self, bits: Hex) -> None:
        seen = self._emergency[2]
        check(seen & bits if bits else not seen, f"error register {bits:02x}", f"{seen:02x}")
        check_equal(self._probe.number(0x1001), seen, "1001h")

    def do_cause(self) -> None:
        provoke(self._probe, int(self._names["error"], 16))

    def do_clear(self) -> None:
        provoke(self._probe, int(self._names["error"], 16), b"")

    def do_fill_history(self) -> None:
        code = int(self._names["error"], 16)
        length = max(self._probe.od.indices[0x1003].subindices)
        for number in range(1, length + 3):
            self.do_cause()
            self.do_emcy(code)
            check_equal(self._probe.number(0x1003, 0), min(number, length), "errors")
            check_equal(self._probe.number(0x1003, 1) & 0xFFFF, code, "newest error")
            self.do_clear()
            self.do_emcy(0)

    # PDOs

    def do_map(self, index: Hex, kind: Number, *words: Objects) -> None:
        """Configure a PDO by the procedure of CiA 301; other PDOs and the heartbeat are off."""
        probe, settings = self._probe, dict(words)
        objects = [number for name, number in words if not name]
        flags = NO_RTR if index >= TPDO else 0
        can_id = flags | settings.get("can_id", default_id(index, probe.node))
        probe.quiet()
        probe.set(index, 1, PDO_OFF | can_id)
        probe.set(index + 0x200, 0, 0, 1)
        for position, value in enumerate(objects, 1):
            probe.set(index + 0x200, position, value)
        probe.set(index + 0x200, 0, len(objects), 1)
        probe.set(index, 2, kind, 1)
        for subindex, setting, size in (
            (3, settings.get("inhibit", 0), 2),
            (5, settings.get("event_ms", 0), 2),
            (6, settings.get("start"), 1),
        ):
            served = not probe.lacks(f"{index:x}:{subindex}")
            if setting and not served:
                raise CaseSkipped(f"{index:04X}h has no sub-index {subindex}")
            if setting is not None and served:
                probe.set(index, subindex, setting, size)
        probe.set(index, 1, can_id)
        probe.drain()

    def do_off(self, index: Hex) -> None:
        self._probe.disable_pdo(index)

    # LSS

    def do_lss(self) -> None:
        if not self._probe.od.device_information.LSS_supported:
            raise CaseSkipped("the EDS has no LSS")
        identity = [bytes.fromhex(self._names[part]) for part in PARTS]
        self._has_lss = True
        answer = [self._ask(bytes([command]) + part, 0.1) for command, part in enumerate(identity, 0x40)][-1]
        check_equal(answer, b"\x44" + bytes(7), "answer to switch state selective")

    def do_scan(self, *identity: Bytes) -> None:
        def ask(number: int, bit: int, part: int, following: int) -> bool:
            data = b"\x51" + number.to_bytes(4, "little") + bytes([bit, part, following])
            return self._ask(data, 0.03) is not None

        check(ask(0, 0x80, 0, 0), "an answer to the start of Fastscan", None)
        for part, value in enumerate(identity):
            number = 0
            for bit in reversed(range(32)):
                number |= (not ask(number, bit, part, part)) << bit
            check_equal(number.to_bytes(4, "little"), value, f"part {part + 1} of the identity")
            check(ask(number, 0, part, (part + 1) % 4), f"part {part + 1} of the identity confirmed", None)


def _is_frame(frame: str, data: bytes) -> bool:
    """Return whether a frame with the CAN ID of a pattern has the data of the pattern."""
    return matches(pattern(frame).partition("#")[2], data.hex().upper())


def dialogue_cases(path: Path) -> list[Case[CanopenProbe]]:
    """Return the cases on CANopen in a file of cases.

    Raises BenchError: the file cannot be read, or has errors; one line for each.
    """
    return text_cases(path, "canopen", {name: f"{{{name}}}" for name in FINDERS}, CanopenDialogue)
