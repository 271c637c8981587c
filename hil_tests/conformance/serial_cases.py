"""Serial conformance: framing, stuffing, forms of the replies, time-outs and pace."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from starhil.hil_tests.conformance.case import Case, CaseFailed, CaseSkipped, case, check, check_equal, rule
from starhil.hil_tests.conformance.link_probe import INVALID_ID, INVALID_LENGTH, INVALID_PARAMETER
from starhil.hil_tests.conformance.serial_probe import SerialProbe, framed

FRAMING: Final = "serial framing 1F 7F … 1F FF (libCubeObc, AlbertaSat adcs_io.c)"
STUFFING: Final = "1F in the data is doubled (libCubeObc, CTS)"
REPLIES: Final = "forms of the replies: a AlbertaSat, b RADSAT, c libCubeObc"
RECOVERY: Final = "configs/icd: communication_status 144, errors of the link are flagged and passed over"

LONG_PAUSE_S: Final = 0.8
"""Longer than the device waits for the rest of a message (0.5 s)."""
SHORT_PAUSE_S: Final = 0.1
CLOCK_GRAIN_S: Final = 1e-4
LONGEST_MESSAGE: Final = 512

_CASES: list[Case[SerialProbe]] = []

READ: Final = "1F 7F 80 1F FF"
"""Request of identification."""


@dataclass(frozen=True)
class Line:
    """A row of the framing table: what is sent, in pieces with a pause after each, and what is answered."""

    id: str
    title: str
    clause: str
    pieces: tuple[str, ...]
    answers: tuple[int, ...]
    pause_s: float = 0.0


LINES: Final = (
    Line("one", "a request is answered once", FRAMING, (READ,), (128,)),
    Line("two-at-once", "two requests in one piece are both answered, in order", FRAMING, (READ + "1F 7F E6 1F FF",), (128, 230)),
    Line("twenty-at-once", "twenty requests in one piece are all answered", FRAMING, (READ * 20,), (128,) * 20),
    Line("byte-by-byte", "a request may come byte by byte", FRAMING, ("1F", "7F", "80", "1F", "FF"), (128,), 0.005),
    Line("cut-in-escape", "a request may be cut between 1F and what follows it", FRAMING, ("1F", "7F 80 1F", "FF"), (128,), 0.02),
    Line("pause", "a pause of 0.1 s within a request does no harm", rule(1), ("1F 7F", "80 1F FF"), (128,), SHORT_PAUSE_S),
    Line("junk-before", "bytes before a request are passed over", FRAMING, ("00 55 AA FF" + READ,), (128,)),
    Line("junk-between", "bytes between requests are passed over", FRAMING, (READ + "00 FF 7F" + READ,), (128, 128)),
    Line("junk-after", "bytes after a request do not spoil the next", FRAMING, (READ + "42", READ), (128, 128), 0.02),
    Line("escape-before", "a lone 1F before a request is passed over", FRAMING, ("1F" + READ,), (128,)),
    Line("escapes-before", "several 1F before a request are passed over", FRAMING, ("1F 1F 1F" + READ,), (128,)),
    Line("junk-escape", "1F and a byte that means nothing, then a request", FRAMING, ("1F 00" + READ,), (128,)),
    Line("end-alone", "an end mark without a start is no message", FRAMING, ("1F FF",), ()),
    Line("end-before", "an end mark before a request is passed over", FRAMING, ("1F FF" + READ,), (128,)),
    Line("start-alone", "a start mark alone is no message", FRAMING, ("1F 7F",), ()),
    Line("starts", "a second start mark begins the message anew", FRAMING, ("1F 7F" + READ,), (128,)),
    Line("cut-off", "a message cut off by another is dropped, the other one answered", FRAMING, ("1F 7F E6" + READ,), (128,)),
    Line("cut-off-data", "a message with data cut off by another is dropped", FRAMING, ("1F 7F 02 11 22 33" + READ,), (128,)),
    Line("empty", "a message without an identifier is no request", FRAMING, ("1F 7F 1F FF",), ()),
    Line("empty-then-good", "a request after an empty message is answered", FRAMING, ("1F 7F 1F FF" + READ,), (128,)),
    Line("bad-escape", "1F before another byte within a message ends it without effect", rule(3), ("1F 7F 80 1F 00",), ()),
    Line("bad-escape-then-good", "a request after a bad escape is answered", rule(3), ("1F 7F 80 1F 00" + READ,), (128,)),
    Line("start-of-ack", "1F 07 is the start of a reply, not of a request", REPLIES, ("1F 07 80 1F FF",), ()),
    Line("start-of-nack", "1F 0F is the start of a reply, not of a request", REPLIES, ("1F 0F 80 1F FF",), ()),
    Line("start-of-event", "1F 2F is the start of an event, not of a request", REPLIES, ("1F 2F 80 1F FF",), ()),
    Line("start-of-unsolicited", "1F 4F is the start of unsolicited telemetry, not of a request", REPLIES, ("1F 4F 80 1F FF",), ()),
    Line("noise", "noise is not answered", FRAMING, ("FF" * 64 + "00" * 64 + "7F" * 64,), ()),
    Line("escapes", "a run of 1F is not answered", FRAMING, ("1F" * 200,), ()),
    Line("ends", "a run of end marks is not answered", FRAMING, ("1F FF" * 100,), ()),
)  # fmt: skip


def _line_case(line: Line) -> Case[SerialProbe]:
    def run(probe: SerialProbe) -> None:
        probe.expecting(*line.answers)
        for piece in line.pieces:
            probe.send(bytes.fromhex(piece))
            probe.sleep(line.pause_s)
        for identifier in line.answers:
            probe.expect_telemetry(identifier)
        probe.expect_silence("no more was asked for")
        # a message that was left open ends by the next one's start
        probe.expect_alive()

    return Case(f"framing.{line.id}", "framing", line.title, line.clause, run)


_CASES += [_line_case(line) for line in LINES]


@case(_CASES, "framing.reply-form", "an answer has the form of its dialect, byte for byte", REPLIES)
def reply_form(probe: SerialProbe) -> None:
    """Start, identifier where the dialect has one, 8 bytes of data, end."""
    probe.send(bytes.fromhex(READ))
    probe.expecting(128)
    data = probe.expect_telemetry(128)
    body = data if probe.dialect == "b" else b"\x80" + data
    start = b"\x1f\x07" if probe.dialect == "c" else b"\x1f\x7f"
    whole = start + body.replace(b"\x1f", b"\x1f\x1f") + b"\x1f\xff"
    seen = "".join(entry.split(" <- ")[1].replace(" ", "") for entry in probe.log if " <- " in entry)
    check_equal(seen, whole.hex().upper(), "bytes")


@case(_CASES, "framing.half", "half a message is given up after a while", rule(2))
def half(probe: SerialProbe) -> None:
    """The rest of it, when it comes too late, is junk; the next request is answered."""
    probe.send(bytes.fromhex("1F 7F 80"))
    probe.sleep(LONG_PAUSE_S)
    probe.send(bytes.fromhex("1F FF"))
    probe.expect_silence("the message had been given up")
    probe.expect_alive()


@case(_CASES, "framing.overlong", "a message that is too long is dropped, the next one answered", rule(4))
def overlong(probe: SerialProbe) -> None:
    """Longer than the 512 bytes of the published host's buffer."""
    probe.send(framed(0x80, bytes(4 * LONGEST_MESSAGE)))
    probe.expect_silence("the message was too long")
    probe.expect_alive()


@case(_CASES, "framing.longest", "a message of 512 bytes is still taken, and refused for its length", rule(4))
def longest(probe: SerialProbe) -> None:
    """Identifier and 511 bytes."""
    probe.expect_refusal(0x80, bytes(LONGEST_MESSAGE - 1), INVALID_LENGTH)


# --- stuffing ---


@case(
    _CASES,
    "stuffing.id",
    "identifier 1F doubled is identifier 31, which does not exist",
    STUFFING,
    intrusive=True,
)
def stuffed_identifier(probe: SerialProbe) -> None:
    """Not two bytes."""
    probe.send(bytes.fromhex("1F 7F 1F 1F 1F FF"))
    probe.expecting(0x1F)
    answer = probe.next_answer()
    check(answer.kind == "nack" and answer.code == INVALID_ID, "refusal with code 1", answer)


@case(
    _CASES,
    "stuffing.id-single",
    "identifier 1F not doubled is identifier 31 as well",
    "flight software differs: AlbertaSat, RADSAT",
    intrusive=True,
)
def single_identifier(probe: SerialProbe) -> None:
    """With data, as some senders stuff the data only."""
    probe.send(bytes.fromhex("1F 7F 1F 00 01 1F FF"))
    probe.expecting(0x1F)
    answer = probe.next_answer()
    check(answer.kind == "nack" and answer.code == INVALID_ID, "refusal with code 1", answer)


@case(_CASES, "stuffing.taken-out", "a doubled 1F is one byte of data", STUFFING, intrusive=True)
def taken_out(probe: SerialProbe) -> None:
    """Parameter 31 does not exist: refused as a parameter, not for its length."""
    row = probe.icd.telecommands["select_parameter"]
    probe.send(bytes.fromhex(f"1F 7F {row.id:02X} 1F 1F 1F FF"))
    probe.expecting(row.id)
    answer = probe.next_answer()
    check(answer.kind == "nack" and answer.code == INVALID_PARAMETER, "refusal with code 3", answer)


@case(
    _CASES,
    "stuffing.not-a-mark",
    "1F 1F FF within data is a byte 1F and a byte FF, not an end",
    STUFFING,
    intrusive=True,
)
def not_a_mark(probe: SerialProbe) -> None:
    """Two bytes where select_parameter takes one."""
    row = probe.icd.telecommands["select_parameter"]
    probe.send(bytes.fromhex(f"1F 7F {row.id:02X} 1F 1F FF 1F FF"))
    probe.expecting(row.id)
    answer = probe.next_answer()
    check(answer.kind == "nack" and answer.code == INVALID_LENGTH, "refusal with code 2", answer)


# --- errors are flagged ---

FLAGS: Final = (
    ("junk", "bytes outside a message", "00 55 AA", 0.0, {"uart_protocol_error"}),
    ("empty", "a message without an identifier", "1F 7F 1F FF", 0.0, {"uart_protocol_error"}),
    ("bad-escape", "a bad escape within a message", "1F 7F 80 1F 00", 0.0, {"uart_protocol_error"}),
    (
        "overlong",
        "a message that is too long",
        "1F 7F 80" + "00" * 600 + "1F FF",
        0.0,
        {"uart_protocol_error"},
    ),
    ("cut-off", "a message cut off by another", "1F 7F 02 11 22", 0.0, {"uart_incomplete"}),
    ("half", "a message that does not end", "1F 7F 02 11 22", LONG_PAUSE_S, {"uart_incomplete"}),
)
FLAG_NAMES: Final = (
    "telecommand_overrun", "uart_protocol_error", "uart_incomplete", "i2c_telemetry_error", "i2c_telecommand_error",
    "can_telecommand_error",
)  # fmt: skip


def _flag_case(name: str, title: str, sent: str, pause_s: float, flags: set[str]) -> Case[SerialProbe]:
    def run(probe: SerialProbe) -> None:
        probe.command("clear_counters")
        probe.send(bytes.fromhex(sent))
        probe.sleep(pause_s)
        if not pause_s:
            probe.expect_silence("no request was made") if name != "cut-off" else None
        status = probe.telemetry("communication_status")
        seen = {flag for flag in FLAG_NAMES if status[flag]}
        allowed = flags | ({"uart_protocol_error"} if name == "overlong" else set())
        check(
            flags <= seen <= allowed, f"flags {', '.join(sorted(flags))}", ", ".join(sorted(seen)) or "none"
        )
        counts = (status["telecommand_count"], status["telemetry_count"])
        check_equal(counts, (0, 1), "counts of telecommands and telemetry")
        probe.command("clear_counters")

    return Case(
        f"errors.{name}",
        "errors",
        f"{title} sets its flag and counts as nothing",
        RECOVERY,
        run,
        intrusive=True,
    )


_CASES += [_flag_case(*row) for row in FLAGS]


@case(_CASES, "errors.none", "good requests set no flag", RECOVERY, intrusive=True)
def no_flag(probe: SerialProbe) -> None:
    """Twenty of them, in one piece and with pauses."""
    probe.command("clear_counters")
    for _ in range(20):
        probe.expect_alive()
    probe.expecting(*[128] * 5)
    probe.send(bytes.fromhex(READ) * 5)
    for _ in range(5):
        probe.expect_telemetry(128)
    status = probe.telemetry("communication_status")
    seen = [flag for flag in FLAG_NAMES if status[flag]]
    check(not seen, "no flag", ", ".join(seen))


# --- time ---


@case(_CASES, "timing.pace", "a long reply takes its time on the line", "8N1: ten bits a byte")
def pace(probe: SerialProbe) -> None:
    """Nothing is faster than the bit rate: telemetry 211 has 54 bytes."""
    if probe.baud is None:
        raise CaseSkipped("the pace is not checked without --baud, the bit rate of the line")
    begin = probe.now()
    probe.post(211)
    data = probe.expect_telemetry(211)
    least = (len(data) + 4) * 10 / probe.baud
    seconds = probe.now() - begin
    if seconds < least - CLOCK_GRAIN_S:
        raise CaseFailed(f"at least {least * 1e3:.2f} ms at {probe.baud} baud", f"{seconds * 1e3:.2f} ms")


CASES: Final = tuple(_CASES)
