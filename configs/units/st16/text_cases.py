"""The points of the vendor's interface document as cases; the clause is the page of its public copy, whose revision is unknown.

Messages are built and parsed here byte by byte, so that the cases do not depend on the definition. A unit whose address is
not 0Eh answers none of them.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Final, NamedTuple

from starhil.hil_tests.conformance.case import CaseArea, check, check_equal
from starhil.hil_tests.conformance.serial_probe import SerialProbe

COPY: Final = "doclecture.net/1-{}.html"
OBC, TRACKER = 0x11, 0x0E
POLL = FINAL = 0x80
B, ACK = 0x40, 0x20
PING, READ_FILE, WRITE_FILE, READ_EDAC, WRITE_EDAC = 0x00, 0x07, 0x08, 0x09, 0x0A
GO, READ_RESULT, IMAGE, COMBINATION, TIME = 0x0B, 0x0D, 0x10, 0x12, 0x13
ON: Final = 0x0B
FREE: Final = 0x180
"""Address in EDAC memory where the unit keeps nothing (our choice)."""
COUNTERS: Final = 0x50
"""Address of the counters (our choice)."""
SOLVED_S: Final = 15.0
"""Longest time to the first attitude."""

CONTROL = CaseArea[SerialProbe]("control", COPY.format(35910), links=("serial",))
MEMORY = CaseArea[SerialProbe]("memory", COPY.format(35916), intrusive=True, links=("serial",))
RESULT = CaseArea[SerialProbe]("result", COPY.format(35917), links=("serial",))
COMBINED = CaseArea[SerialProbe]("combination", COPY.format(35918), intrusive=True, links=("serial",))
COUNTER_POINTS = CaseArea[SerialProbe]("counters", COPY.format(35919), intrusive=True, links=("serial",))


class Message(NamedTuple):
    """Control field and data of a reply."""

    control: int
    data: bytes


def crc(data: bytes) -> bytes:
    """Return the CRC with x¹⁶ + x¹² + x⁵ + 1, the lowest bit first, from FFFFh (1-35910)."""
    register = 0xFFFF
    for byte in data:
        register ^= byte
        for _ in range(8):
            register = register >> 1 ^ (0x8408 if register & 1 else 0)
    return struct.pack("<H", register)


def line(body: bytes) -> bytes:
    """Return a body between FEND bytes."""
    return b"\xc0" + body.replace(b"\xdb", b"\xdb\xdd").replace(b"\xc0", b"\xdb\xdc") + b"\xc0"


def command(control: int, data: bytes = b"") -> bytes:
    """Return a command as it stands on the line."""
    body = bytes((TRACKER, OBC, control)) + data
    return line(body + crc(body))


def bodies(raw: bytes) -> list[bytes]:
    """Return what stands between FEND bytes."""
    return [
        piece.replace(b"\xdb\xdc", b"\xc0").replace(b"\xdb\xdd", b"\xdb")
        for piece in raw.split(b"\xc0")
        if piece
    ]


def received(probe: SerialProbe, sent: bytes) -> Sequence[Message]:
    """Send bytes; return all messages of the reply, whose addresses and CRC must be right.

    A reply to a poll ends with a final message; bytes may come late, as on a busy machine.
    """
    probe.drain()
    probe.send(sent)
    polled, size, since = sent[3:4] > b"\x7f", 0, probe.now()
    while True:
        probe.sleep(probe.times.quiet_s)
        if len(probe.raw) > size:
            size, since = len(probe.raw), probe.now()
            continue
        pieces = bodies(bytes(probe.raw))
        ended = bool(pieces) and probe.raw.endswith(b"\xc0") and bool(pieces[-1][2:3] > b"\x7f")
        if ended or not polled or probe.now() - since > probe.times.answer_s:
            break
    messages = []
    for body in pieces:
        check(body[:2] == bytes((OBC, TRACKER)), f"addresses {OBC:02X} {TRACKER:02X}", body[:2].hex(" "))
        check(crc(body[:-2]) == body[-2:], f"CRC {crc(body[:-2]).hex(' ')}", body[-2:].hex(" "))
        messages.append(Message(body[2], body[3:-2]))
    probe.drain()
    return messages


def reply(probe: SerialProbe, code: int, data: bytes = b"") -> bytes:
    """Poll; return the data of the reply, which must be acknowledged, in one message."""
    found = received(probe, command(code | POLL, data))
    check_equal([item.control for item in found], [code | FINAL | ACK], "control fields")
    return found[0].data


def parts(probe: SerialProbe, bits: int, code: int = ON) -> bytes:
    """Return the data of a combination without the counts at the beginning of its messages."""
    found = received(probe, command(COMBINATION | POLL, struct.pack("<I", code | bits << 8)))
    whole = b""
    for item in found:
        last = FINAL if item is found[-1] else 0
        check_equal(item.control, COMBINATION | ACK | last, "control field")
        check_equal(int.from_bytes(item.data[:2], "little"), len(whole), "bytes sent before")
        whole += item.data[2:]
    return whole


# --- control field ---


@CONTROL.case("no-poll", "a command without poll is executed and not answered", intrusive=True)
def no_poll(probe: SerialProbe) -> None:
    value = b"\x5a"
    reply(probe, WRITE_EDAC, struct.pack("<H", FREE) + b"\0")
    check_equal(len(received(probe, command(WRITE_EDAC, struct.pack("<H", FREE) + value))), 0, "messages")
    check_equal(reply(probe, READ_EDAC, struct.pack("<HB", FREE, 1))[2:], value, "the byte written")


@CONTROL.case("no-poll-refused", "an unknown command without poll is not answered either")
def no_poll_refused(probe: SerialProbe) -> None:
    check_equal(len(received(probe, command(0x1F))), 0, "messages")


@CONTROL.case("b", "B is copied from a command into its reply")
def b_bit(probe: SerialProbe) -> None:
    for code in (PING, TIME, 0x1F):
        for bit in (0, B):
            (found,) = received(probe, command(code | POLL | bit))
            check_equal(found.control & B, bit, "B")


@CONTROL.case("ack-ignored", "ACK of a command is ignored")
def ack_ignored(probe: SerialProbe) -> None:
    plain, marked = (received(probe, command(PING | POLL | bit)) for bit in (0, ACK))
    check_equal(marked, plain, "reply")


@CONTROL.case("nack", "ACK of the reply is 0 if the command cannot be executed")
def nack(probe: SerialProbe) -> None:
    (found,) = received(probe, command(0x1F | POLL))
    check_equal(found.control, 0x1F | FINAL, "control field")


@CONTROL.case("final", "final is set in the last message of a reply only")
def final(probe: SerialProbe) -> None:
    found = received(probe, command(READ_RESULT | POLL, struct.pack("<HH", 0, 600)))
    check(len(found) > 1, "several messages", len(found))
    check_equal([bool(item.control & FINAL) for item in found], [False] * (len(found) - 1) + [True], "final")


# --- memory and result ---


@MEMORY.case("files", "files are four bytes of EDAC memory, in a short and a long form")
def files(probe: SerialProbe) -> None:
    for number, data in ((bytes((FREE // 4,)), b"abcd"), (struct.pack("<H", FREE // 4), b"\xc0\xdb\xdc\xdd")):
        reply(probe, WRITE_FILE, number + data)
        check_equal(reply(probe, READ_FILE, number), number + data, "file")
        check_equal(reply(probe, READ_EDAC, struct.pack("<HB", FREE, 4))[2:], data, "EDAC memory")


@MEMORY.case("edac", "WRITE EDAC writes the bytes that READ EDAC reads")
def edac(probe: SerialProbe) -> None:
    for data in (b"\x01", bytes(range(64))):
        reply(probe, WRITE_EDAC, struct.pack("<H", FREE) + data)
        check_equal(reply(probe, READ_EDAC, struct.pack("<HH", FREE, len(data)))[2:], data, "EDAC memory")


@MEMORY.case("size", "EDAC memory has 512 bytes", COPY.format(35919))
def size(probe: SerialProbe) -> None:
    check_equal(len(reply(probe, READ_EDAC, struct.pack("<HH", 0, 512))), 2 + 512, "bytes")
    for code, data in ((READ_EDAC, struct.pack("<HB", 511, 2)), (READ_FILE, bytes((128,)))):
        (found,) = received(probe, command(code | POLL, data))
        check_equal(found.control, code | FINAL, "control field")


@RESULT.case("count-zero", "count 0 of the short form is 256 bytes, of READ EDAC and READ RESULT")
def count_zero(probe: SerialProbe) -> None:
    for code in (READ_EDAC, READ_RESULT):
        check_equal(len(reply(probe, code, struct.pack("<HB", 0, 0))), 2 + 256, "bytes")


@RESULT.case("forms", "short and long form read the same bytes")
def forms(probe: SerialProbe) -> None:
    short, long = struct.pack("<HB", 0x130, 16), struct.pack("<HH", 0x130, 16)
    check_equal(reply(probe, READ_RESULT, short)[:2], b"\x30\x01", "address")
    check_equal(len(reply(probe, READ_RESULT, short)), len(reply(probe, READ_RESULT, long)), "bytes")


@RESULT.case("dark-window", "a dark window is answered with the command")
def dark_window(probe: SerialProbe) -> None:
    inside = struct.pack("<BB12H", 0, 0, 1, 2, 3, 4, *range(8))
    check_equal(reply(probe, IMAGE, inside), inside, "reply")
    (found,) = received(probe, command(IMAGE | POLL, struct.pack("<BB12H", 0, 0, 0, 0, 0xFFFF, 1, *range(8))))
    check_equal(found.control, IMAGE | FINAL, "control field of a window outside the image")


# --- combination, time, attitude ---


@COMBINED.case("fails", "a combination that fails has ACK 0, a state and a text")
def fails(probe: SerialProbe) -> None:
    (found,) = received(probe, command(COMBINATION | POLL, struct.pack("<I", 0x7F << 8)))
    check_equal(found.control, COMBINATION | FINAL, "control field")
    check(found.data[1:].isascii() and len(found.data) > 1, "a state and a text", found.data)


@COMBINED.case("counts", "each message of a combination begins with the number of bytes sent before")
def counts(probe: SerialProbe) -> None:
    check_equal(len(parts(probe, 0x7F)), 300, "bytes of the first seven parts")
    check_equal(len(parts(probe, 0x780)), 2 * 392 + 104 + 2 * 416 + 2 * 176, "bytes of the next four")


@COMBINED.case("time", "TIME counts microseconds in 48 bits")
def time(probe: SerialProbe) -> None:
    first, begin = int.from_bytes(reply(probe, TIME), "little"), probe.now()
    probe.sleep(1.0)
    second, passed = int.from_bytes(reply(probe, TIME), "little"), probe.now() - begin
    check_equal(len(reply(probe, TIME)), 6, "bytes")
    check(0.9 * passed < (second - first) / 1e6 < 1.1 * passed, f"{passed:.3f} s", (second - first) / 1e6)


@COMBINED.case("time-step", "the lowest bit of TIME is 0")
def time_step(probe: SerialProbe) -> None:
    for _ in range(16):
        check_equal(reply(probe, TIME)[0] & 1, 0, "lowest bit")
        probe.sleep(1e-6)


def solved(probe: SerialProbe) -> bytes:
    """Return return code and quaternion of the first result with an attitude."""
    end = probe.now() + SOLVED_S
    while not (found := parts(probe, 0x06))[0] & 0x04 and probe.now() < end:
        probe.sleep(0.2)
    check(found[0] & 0x04, f"an attitude within {SOLVED_S:g} s", f"return code {found[0]:#x}")
    return found


@COMBINED.case("quaternion", "the quaternion has length 1, its scalar part first", COPY.format(35922))
def quaternion(probe: SerialProbe) -> None:
    components = struct.unpack("<I4d", solved(probe))[1:]
    check(abs(sum(part * part for part in components) - 1.0) < 1e-9, "length 1", components)
    truth = probe.truth() if probe.truth is not None else None
    if truth is not None:
        x, y, z, w = truth
        # A(q) is the conjugate of the rotation of vectors
        product = abs(w * components[0] - x * components[1] - y * components[2] - z * components[3])
        check(
            product > 1.0 - 1e-5,
            f"scalar part {w:.6f} first, then {-x:.6f} {-y:.6f} {-z:.6f}, or all negative",
            components,
        )


@COMBINED.case(
    "matching", "the quaternion of each matching structure has its scalar part first", COPY.format(35920)
)
def matching(probe: SerialProbe) -> None:
    solved(probe)
    found = parts(probe, 0x404)
    for start in (32, 32 + 176):
        check_equal(found[start + 0x60 : start + 0x80], found[:32], "quaternion")


# --- counters ---


def counters(probe: SerialProbe) -> list[int]:
    """Return framing errors, runts, oversize messages, bad CRCs and FIFO overflows."""
    return list(struct.unpack("<5I", reply(probe, READ_EDAC, struct.pack("<HB", COUNTERS, 20))[2:]))


def counted_case(name: str, title: str, sent: bytes, index: int | None) -> None:
    """Declare a case: bytes, and the counter that they raise by one."""

    @COUNTER_POINTS.case(name, title)
    def run(probe: SerialProbe) -> None:
        before = counters(probe)
        check_equal(len(received(probe, sent)), 0, "messages")
        rise = [after - one for after, one in zip(counters(probe), before, strict=True)]
        check_equal(rise, [int(number == index) for number in range(5)], "rise of each counter")


counted_case(
    "framing",
    "FESC before another byte than TFEND or TFESC is a framing error",
    b"\xc0\x0e\x11\xdb\x41\x80\xc0",
    0,
)
counted_case("runt", "a message of fewer than 5 bytes is a runt", b"\xc0\x0e\x11\x80\x00\xc0", 1)
counted_case(
    "oversize", "a message with too many data is oversize", b"\xc0\x0e\x11\x80" + bytes(3000) + b"\xc0", 2
)
counted_case("crc", "a wrong CRC is counted", b"\xc0\x0e\x11\x80\x00\x00\xc0", 3)
counted_case(
    "crc-elsewhere", "a wrong CRC in a message to another unit is not", b"\xc0\x0d\x11\x80\x00\x00\xc0", None
)
counted_case(
    "runt-elsewhere", "a short message to another unit is not a runt", b"\xc0\x0d\x11\x80\x00\xc0", None
)
counted_case("empty", "two FEND in a row are no message", b"\xc0\xc0\xc0", None)
