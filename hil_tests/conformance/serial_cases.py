"""Serial conformance: framing, stuffing, reply formats, time-outs and pace."""

from __future__ import annotations

from typing import Final

from starhil.hil_tests.conformance.case import CaseArea, CaseFailed, CaseSkipped, check, check_equal, rule
from starhil.hil_tests.conformance.link_probe import (
    INVALID_ID,
    INVALID_LENGTH,
    INVALID_PARAMETER,
    LONG_PAUSE_S,
)
from starhil.hil_tests.conformance.serial_probe import SerialProbe
from starhil.hil_tests.conformance.wire_tables import (
    Exchange,
    FlagRow,
    add_exchange_cases,
    add_flag_cases,
    check_flags,
)

REPLIES: Final = "reply formats: a AlbertaSat, b RADSAT, c libCubeObc"

SHORT_PAUSE_S: Final = 0.1
CLOCK_GRAIN_S: Final = 1e-4
LONGEST_MESSAGE: Final = 512

FRAMING: Final = CaseArea[SerialProbe](
    "framing", "serial framing 1F 7F … 1F FF (libCubeObc, AlbertaSat adcs_io.c)"
)
STUFFING: Final = CaseArea[SerialProbe](
    "stuffing", "1F in the data is doubled (libCubeObc, CTS)", intrusive=True
)
ERRORS: Final = CaseArea[SerialProbe](
    "errors",
    "configs/units/cubestar: communication_status 144, link errors are flagged and otherwise ignored",
    intrusive=True,
)
TIMING: Final = CaseArea[SerialProbe]("timing", "8N1: ten bits a byte")

READ: Final = "1F 7F 80 1F FF"
"""Request for identification."""


EXCHANGES: Final = (
    Exchange("one", "a request is answered once", (READ,), ("128",)),
    Exchange("two-at-once", "two requests sent together are both answered, in order", (READ + "1F 7F E6 1F FF",), ("128", "230")),
    Exchange("twenty-at-once", "twenty requests sent together are all answered", (READ * 20,), ("128",) * 20),
    Exchange("byte-by-byte", "a request may be sent byte by byte", ("1F", "7F", "80", "1F", "FF"), ("128",), pause_s=0.005),
    Exchange("cut-in-escape", "a request may be split after 1F", ("1F", "7F 80 1F", "FF"), ("128",), pause_s=0.02),
    Exchange("pause", "a pause of 0.1 s within a request has no effect", ("1F 7F", "80 1F FF"), ("128",), pause_s=SHORT_PAUSE_S, clause=rule(1)),
    Exchange("junk-before", "bytes before a request are ignored", ("00 55 AA FF" + READ,), ("128",)),
    Exchange("junk-between", "bytes between requests are ignored", (READ + "00 FF 7F" + READ,), ("128", "128")),
    Exchange("junk-after", "bytes after a request do not affect the next one", (READ + "42", READ), ("128", "128"), pause_s=0.02),
    Exchange("escape-before", "a single 1F before a request is ignored", ("1F" + READ,), ("128",)),
    Exchange("escapes-before", "several 1F before a request are ignored", ("1F 1F 1F" + READ,), ("128",)),
    Exchange("junk-escape", "1F and a meaningless byte before a request are ignored", ("1F 00" + READ,), ("128",)),
    Exchange("end-alone", "an end mark without a start is not answered", ("1F FF",)),
    Exchange("end-before", "an end mark before a request is ignored", ("1F FF" + READ,), ("128",)),
    Exchange("start-alone", "a start mark alone is not answered", ("1F 7F",)),
    Exchange("starts", "a second start mark restarts the message", ("1F 7F" + READ,), ("128",)),
    Exchange("cut-off", "a message interrupted by another is dropped, and the other answered", ("1F 7F E6" + READ,), ("128",)),
    Exchange("cut-off-data", "a message with data that is interrupted by another is dropped", ("1F 7F 02 11 22 33" + READ,), ("128",)),
    Exchange("empty", "a message without an ID is not answered", ("1F 7F 1F FF",)),
    Exchange("empty-then-good", "a request after an empty message is answered", ("1F 7F 1F FF" + READ,), ("128",)),
    Exchange("bad-escape", "a bad escape within a message aborts it without effect", ("1F 7F 80 1F 00",), clause=rule(3)),
    Exchange("bad-escape-then-good", "a request after a bad escape is answered", ("1F 7F 80 1F 00" + READ,), ("128",), clause=rule(3)),
    Exchange("start-of-ack", "1F 07 is the start of a reply, not of a request", ("1F 07 80 1F FF",), clause=REPLIES),
    Exchange("start-of-nack", "1F 0F is the start of a reply, not of a request", ("1F 0F 80 1F FF",), clause=REPLIES),
    Exchange("start-of-event", "1F 2F is the start of an event, not of a request", ("1F 2F 80 1F FF",), clause=REPLIES),
    Exchange("start-of-unsolicited", "1F 4F is the start of unsolicited telemetry, not of a request", ("1F 4F 80 1F FF",), clause=REPLIES),
    Exchange("half", "an incomplete message is dropped after a time-out", ("1F 7F 80", "1F FF"), pause_s=LONG_PAUSE_S, clause=rule(2)),
    Exchange("overlong", "a message that is too long is dropped, and the next one answered", ("1F 7F 80" + "00" * 4 * LONGEST_MESSAGE + "1F FF",), clause=rule(4)),
    Exchange("noise", "noise is not answered", ("FF" * 64 + "00" * 64 + "7F" * 64,)),
    Exchange("escapes", "a run of 1F is not answered", ("1F" * 200,)),
    Exchange("ends", "a run of end marks is not answered", ("1F FF" * 100,)),
)  # fmt: skip
add_exchange_cases(FRAMING, EXCHANGES)


@FRAMING.case("reply-form", "an answer has the format of its dialect, byte for byte", REPLIES)
def reply_form(probe: SerialProbe) -> None:
    probe.send(bytes.fromhex(READ))
    probe.expecting(128)
    data = probe.expect_telemetry(128)
    body = data if probe.dialect == "b" else b"\x80" + data
    start = b"\x1f\x07" if probe.dialect == "c" else b"\x1f\x7f"
    whole = start + body.replace(b"\x1f", b"\x1f\x1f") + b"\x1f\xff"
    seen = "".join(entry.split(" <- ")[1].replace(" ", "") for entry in probe.log if " <- " in entry)
    check_equal(seen, whole.hex().upper(), "bytes")


@FRAMING.case("longest", "a message of 512 bytes is received and refused for its length", rule(4))
def longest(probe: SerialProbe) -> None:
    probe.expect_refusal(0x80, bytes(LONGEST_MESSAGE - 1), INVALID_LENGTH)


# --- stuffing ---


def _expect_refusal_of(probe: SerialProbe, row_id: int, text: str, code: int) -> None:
    probe.send_text(text)
    probe.expecting(row_id)
    answer = probe.next_answer()
    check(answer.kind == "nack" and answer.code == code, f"refusal with code {code}", answer)


@STUFFING.case("id", "ID 1F doubled is ID 31, which does not exist")
def stuffed_id(probe: SerialProbe) -> None:
    _expect_refusal_of(probe, 0x1F, "1F 7F 1F 1F 1F FF", INVALID_ID)


@STUFFING.case(
    "id-single",
    "ID 1F not doubled is ID 31, too",
    "flight software differs: AlbertaSat, RADSAT",
)
def single_id(probe: SerialProbe) -> None:
    """Sent with data, because some senders stuff only the data."""
    _expect_refusal_of(probe, 0x1F, "1F 7F 1F 00 01 1F FF", INVALID_ID)


@STUFFING.case("taken-out", "a doubled 1F is one byte of data")
def unstuffed(probe: SerialProbe) -> None:
    """Parameter 31 does not exist, so the device refuses its ID, not the length."""
    row = probe.icd.telecommands["select_parameter"]
    _expect_refusal_of(probe, row.id, f"1F 7F {row.id:02X} 1F 1F 1F FF", INVALID_PARAMETER)


@STUFFING.case("not-a-mark", "1F 1F FF within data is a byte 1F and a byte FF, not an end")
def not_a_mark(probe: SerialProbe) -> None:
    """The device refuses the length: three bytes instead of one for select_parameter."""
    row = probe.icd.telecommands["select_parameter"]
    _expect_refusal_of(probe, row.id, f"1F 7F {row.id:02X} 1F 1F FF 00 1F FF", INVALID_LENGTH)


# --- errors are flagged ---

PROTOCOL_ERROR: Final = frozenset({"uart_protocol_error"})
INCOMPLETE: Final = frozenset({"uart_incomplete"})
OVERLONG: Final = "1F 7F 80" + "00" * 600 + "1F FF"
FLAGS: Final = (
    FlagRow("junk", "bytes outside a message", ("00 55 AA",), PROTOCOL_ERROR),
    FlagRow("empty", "a message without an ID", ("1F 7F 1F FF",), PROTOCOL_ERROR),
    FlagRow("bad-escape", "a bad escape within a message", ("1F 7F 80 1F 00",), PROTOCOL_ERROR),
    FlagRow("overlong", "a message that is too long", (OVERLONG,), PROTOCOL_ERROR),
    FlagRow("cut-off", "a message interrupted by another", ("1F 7F 02 11 22",), INCOMPLETE, pause_s=None),
    FlagRow("half", "an incomplete message", ("1F 7F 02 11 22",), INCOMPLETE, pause_s=LONG_PAUSE_S),
)

add_flag_cases(ERRORS, FLAGS)


@ERRORS.case("none", "valid requests set no flag")
def no_flag(probe: SerialProbe) -> None:
    probe.command("clear_counters")
    for _ in range(20):
        probe.expect_alive()
    probe.expecting(*[128] * 5)
    probe.send(bytes.fromhex(READ) * 5)
    for _ in range(5):
        probe.expect_telemetry(128)
    check_flags(probe, frozenset())


# --- time ---


@TIMING.case("pace", "a long reply takes at least its time on the line")
def pace(probe: SerialProbe) -> None:
    if probe.baud is None:
        raise CaseSkipped("the pace is checked only with --baud, the bit rate of the line")
    begin = probe.now()
    probe.post(211)
    data = probe.expect_telemetry(211)
    least = (len(data) + 4) * 10 / probe.baud
    seconds = probe.now() - begin
    if seconds < least - CLOCK_GRAIN_S:
        raise CaseFailed(f"at least {least * 1e3:.2f} ms at {probe.baud} baud", f"{seconds * 1e3:.2f} ms")
