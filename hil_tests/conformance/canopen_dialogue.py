"""Cases told as dialogues: what the master sends, and what the node must answer.

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

Other lines: `nmt N` sends an NMT command, `value BYTES` reads the writable number, `kept` finds it as it was before the
dialogue. Names in braces are in `Names`; all are found before the first request.
"""

from __future__ import annotations

from binascii import crc_hqx
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import Final

from canopen.objectdictionary import ODVariable, datatypes

from starhil.hil_tests.conformance.canopen_probe import (
    ANSWER_S,
    Abort,
    CanopenProbe,
    check_abort,
    check_answer,
    is_integer,
    size_of,
)
from starhil.hil_tests.conformance.case import CaseArea, CaseSkipped, check, check_equal
from starhil.hil_tests.judge.canopen import multiplexer

LONGEST_TIMEOUT_S: Final = 12.0
"""Maximum time in which a node aborts a transfer whose client stops sending."""

IDENTITY: Final = ("vendor", "product", "revision", "serial")
"""Parts of 1018h, from sub-index 1 on."""

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
    value, and another; `node`; `vendor`, `product`, `revision`, `serial`: parts of the identity.
    """

    def __init__(self, probe: CanopenProbe) -> None:
        self._probe = probe

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
        if name == "node":
            return f"{probe.node:02x}"
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
    ask_of: Callable[[CanopenProbe], Ask],
    prepare: Callable[[CanopenProbe], object] = lambda _probe: None,
) -> None:
    """Add one case per dialogue; `ask_of` returns how its requests are sent, `prepare` precedes it."""

    def run(row: Dialogue, probe: CanopenProbe) -> None:
        prepare(probe)
        hold(probe, row.lines, ask_of(probe))

    for row in table:
        area.case(row.id, row.title, row.clause, intrusive=row.intrusive)(partial(run, row))


def sdo(probe: CanopenProbe) -> Ask:
    """Return how requests are sent to the SDO server."""

    def ask(data: bytes, timeout_s: float) -> bytes | None:
        return probe.ask(data, timeout_s) if data else probe.wait_for(0x580 + probe.node, timeout_s)

    return ask


def hold(probe: CanopenProbe, lines: str, ask: Ask) -> None:
    """Hold a dialogue."""
    text = lines.format_map(Names(probe))
    number = writable_number(probe) if "value" in text or "kept" in text else None
    before = b"" if number is None else probe.value(number)
    for line in text.split("; "):
        match line.split():
            case ["nmt", command]:
                probe.command(int(command))
            case ["value", *data] if number is not None:
                check_equal(probe.value(number), bytes.fromhex("".join(data)), "value")
            case ["kept"] if number is not None:
                check_equal(probe.value(number), before, "value as before")
            case _:
                request, _, answer = (part.strip() for part in line.partition(">"))
                if _ends(request, answer, ask):
                    return


def _ends(request: str, answer: str, ask: Ask) -> bool:
    """Send a request and check the answer; return whether the dialogue ends with it."""
    data = b"" if request == "wait" else bytes.fromhex(request)
    kind, *details = answer.split()
    timeout_s = {"silence": 0.1, "-": 0.0}.get(kind, LONGEST_TIMEOUT_S if request == "wait" else ANSWER_S)
    seen = ask(data, timeout_s)
    match kind:
        case "silence":
            check(seen is None, f"no answer to {request}", seen or "an empty frame")
        case "abort":
            _check_abort(seen, *details)
        case "unless":
            if seen is None or seen[0] == 0x80:
                _check_abort(seen, *details[1:])
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


def _check_abort(seen: bytes | None, names: str, multiplexer: str = "") -> None:
    check_abort(seen, *(Abort[name] for name in names.split("|")), multiplexer=multiplexer)


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
