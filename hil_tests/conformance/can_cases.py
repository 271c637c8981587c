"""CAN conformance: identifiers, lengths, segments, and what is not for the device."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from starhil.hil_tests.conformance.can_probe import (
    TELECOMMAND_SEGMENT,
    TELEMETRY_REQUEST,
    CanProbe,
    identifier_of,
    segments,
)
from starhil.hil_tests.conformance.case import Case, case, check, check_equal, rule
from starhil.hil_tests.conformance.link_probe import INVALID_ID, INVALID_LENGTH
from starhil.hil_tests.errors import BenchError
from starhil.hil_tests.raw_exchange import format_frame, matches, parse_frame, pattern
from starhil.protocol.can_framing import CanFrame

LAYOUT: Final = "29-bit identifier: type[28:24] id[23:16] source[15:8] destination[7:0] (libCubeObc)"
TYPES: Final = "message types 0 to 12 (libCubeObc)"
SEGMENTS: Final = "more than 8 bytes: 7 and a counter down to 0, no padding (libCubeObc)"
ERRORS: Final = "configs/icd: communication_status 144, flag can_telecommand_error"

LONG_PAUSE_S: Final = 0.8
"""Longer than the device waits for the next segment (0.5 s)."""
OTHER_HOST: Final = 0x4D
IDENTIFICATION: Final = 128
COMBINED: Final = 211
COMBINED_SIZE: Final = 54

_CASES: list[Case[CanProbe]] = []


@dataclass(frozen=True)
class Exchange:
    """A row of the frame table; HH and DD stand for the addresses of host and device, `..` for any byte."""

    id: str
    title: str
    clause: str
    sent: tuple[str, ...]
    answers: tuple[str, ...]


IGNORED: Final = ((2, "an acknowledge"), (3, "a telecommand refusal"), (5, "telemetry"), (6, "a telemetry refusal"),
                  (8, "a telemetry segment"), (9, "an event"), (10, "unsolicited telemetry, first"),
                  (11, "unsolicited telemetry, body"), (12, "unsolicited telemetry, last"), (0, "type 0"),
                  (13, "type 13"), (31, "type 31"))  # fmt: skip

EXCHANGES: Final = (
    Exchange("telemetry", "a request of telemetry is answered with type 5, addresses exchanged", LAYOUT, ("0480HHDD#",), ("0580DDHH#................",)),
    Exchange("telemetry-6", "telemetry of 6 bytes has 6 bytes, no padding", LAYOUT, ("04E6HHDD#",), ("05E6DDHH#............",)),
    Exchange("unknown-telemetry", "an unknown telemetry identifier is refused with type 6 and the code", TYPES, ("04C8HHDD#",), ("06C8DDHH#01",)),
    Exchange("request-with-data", "a request of telemetry with data is refused for its length", rule(5), ("0480HHDD#00",), ("0680DDHH#02",)),
    Exchange("other-device", "a frame for another address is not answered", LAYOUT, ("0480HHFE#",), ()),
    Exchange("other-device-zero", "a frame for address 0 is not answered", LAYOUT, ("0480HH00#",), ()),
    Exchange("standard", "a frame with an 11-bit identifier is not answered", LAYOUT, ("480#", "604#"), ()),
    Exchange("remote", "a remote frame is not answered", LAYOUT, ("0480HHDD#R",), ()),
    *(Exchange(f"type-{kind}", f"{words} is not answered", TYPES, (f"{kind:02X}80HHDD#00",), ()) for kind, words in IGNORED),
    Exchange("telemetry-as-telecommand", "a telecommand frame with a telemetry identifier is no request", rule(6), ("0180HHDD#",), ()),
    Exchange("telecommand-as-telemetry", "a telemetry request with a telecommand identifier is no request", rule(6), ("0402HHDD#",), ()),
    Exchange("two-at-once", "two requests back to back are answered in order", LAYOUT, ("0480HHDD#", "04E6HHDD#"), ("0580DDHH#................", "05E6DDHH#............")),
)  # fmt: skip

INTRUSIVE_EXCHANGES: Final = (
    Exchange("ack", "an accepted telecommand is answered with type 2 and no data", TYPES, ("0167HHDD#",), ("0267DDHH#",)),
    Exchange("nack", "a refused telecommand is answered with type 3 and one byte", TYPES, ("0160HHDD#4D",), ("0360DDHH#03",)),
    Exchange("unknown-telecommand", "an unknown telecommand is refused with code 1", TYPES, ("013CHHDD#",), ("033CDDHH#01",)),
    Exchange("short-telecommand", "a telecommand that is too short is refused with code 2", TYPES, ("0102HHDD#0102",), ("0302DDHH#02",)),
    Exchange("long-telecommand", "a telecommand that is too long is refused with code 2", TYPES, ("0167HHDD#00",), ("0367DDHH#02",)),
    Exchange("eight", "a telecommand of 8 bytes goes in one frame", SEGMENTS, ("0170HHDD#0200000000000100",), ("0370DDHH#03",)),
    Exchange("eight-segmented", "a telecommand of 8 bytes may also come in segments", rule(7), ("0770HHDD#0200000000000101", "0770HHDD#0000"), ("0370DDHH#03",)),
    Exchange("segmented-unknown", "an unknown telecommand in segments is refused once, after the last", SEGMENTS, ("073CHHDD#0001020304050601", "073CHHDD#0708090A0B00"), ("033CDDHH#01",)),
    Exchange("segmented-full-last", "the last segment may hold 7 bytes", SEGMENTS, ("073CHHDD#0001020304050601", "073CHHDD#0708090A0B0C0D00"), ("033CDDHH#01",)),
)  # fmt: skip


def _exchange_case(row: Exchange, *, intrusive: bool) -> Case[CanProbe]:
    def run(probe: CanProbe) -> None:
        for text in row.sent:
            probe.send(_frame(probe, text))
        for text in row.answers:
            wanted = pattern(_placed(probe, text))
            frame = probe.next_frame()
            seen = "nothing" if frame is None else format_frame(frame)
            check(matches(wanted, seen), wanted, seen)
        probe.expect_silence("no more was asked for")
        probe.expect_alive()

    return Case(f"frames.{row.id}", "frames", row.title, row.clause, run, intrusive)


def _placed(probe: CanProbe, text: str) -> str:
    return text.replace("HH", f"{probe.host:02X}").replace("DD", f"{probe.device:02X}")


def _frame(probe: CanProbe, text: str) -> CanFrame:
    try:
        return parse_frame(_placed(probe, text))
    except BenchError as error:  # a slip in the tables above
        raise AssertionError(text) from error


_CASES += [_exchange_case(row, intrusive=False) for row in EXCHANGES]
_CASES += [_exchange_case(row, intrusive=True) for row in INTRUSIVE_EXCHANGES]


@case(_CASES, "frames.askers", "each asker gets the answer at its own address", LAYOUT)
def askers(probe: CanProbe) -> None:
    """Two hosts at once."""
    for source in (OTHER_HOST, probe.host, 0xFF):
        probe.post_as(source, IDENTIFICATION)
    seen = [probe.next_answer() for _ in range(3)]
    check_equal([(answer.kind, answer.other) for answer in seen], [("telemetry", OTHER_HOST), ("telemetry", probe.host), ("telemetry", 0xFF)], "answers to")  # fmt: skip


# --- segments of the answer ---


@case(
    _CASES,
    "segments.reply",
    "54 bytes come in 8 segments that count 7 to 0, the last with 5 bytes and its counter",
    SEGMENTS,
)
def segmented_reply(probe: CanProbe) -> None:
    """All under one identifier of type 8."""
    probe.post(COMBINED)
    frames = [probe.next_frame() for _ in range(8)]
    identifier = identifier_of(8, COMBINED, probe.device, probe.host)
    seen = [
        (frame.id, len(frame.data), frame.data[-1] if frame.data else -1)
        for frame in frames
        if frame is not None
    ]
    check_equal(seen, [(identifier, 8, left) for left in range(7, 0, -1)] + [(identifier, 6, 0)], "segments")


@case(_CASES, "segments.all-rows", "every row goes in one frame up to 8 bytes, in segments above", SEGMENTS)
def all_rows(probe: CanProbe) -> None:
    """The type of the first frame tells."""
    for row in probe.icd.telemetry.values():
        probe.post(row.id)
        frame = probe.next_frame()
        check(frame is not None, f"an answer to {row.id}", "nothing")
        if frame is not None:
            check_equal(
                frame.id >> 24,
                5 if row.size <= 8 else 8,
                f"type of the answer to {row.id} ({row.size} bytes)",
            )
            for _ in range(0 if row.size <= 8 else frame.data[-1] if frame.data else 0):
                probe.next_frame()


@case(
    _CASES,
    "unsolicited.segments",
    "a long row comes unsolicited as first, body and last, counters down to 0",
    "types 10 to 12 (libCubeObc); their use: R20, docs/rules.md",
    intrusive=True,
)
def unsolicited_segments(probe: CanProbe) -> None:
    """star_tracker, 54 bytes: 8 frames."""
    probe.command("set_unsolicited", telemetry=COMBINED, rate=5.0)
    try:
        probe.unasked(1.0)
        seen = probe.unsolicited[:8]
    finally:
        probe.command("set_unsolicited", telemetry=COMBINED, rate=0.0)
    check_equal([frame.id >> 24 for frame in seen], [10, *[11] * 6, 12], "types")
    check_equal([frame.data[-1] if frame.data else -1 for frame in seen], list(range(7, -1, -1)), "counters")
    check_equal(sum(len(frame.data) - 1 for frame in seen), COMBINED_SIZE, "bytes")


# --- segments of telecommands ---


def _segment_frames(probe: CanProbe, number: int, data: bytes, source: int | None = None) -> list[CanFrame]:
    identifier = identifier_of(
        TELECOMMAND_SEGMENT, number, probe.host if source is None else source, probe.device
    )
    return [CanFrame(identifier, part) for part in segments(data)]


def _send(probe: CanProbe, frames: list[CanFrame]) -> None:
    for frame in frames:
        probe.send(frame)


UNKNOWN: Final = 60
"""A telecommand that does not exist: its refusal shows that a message was complete."""
LONG: Final = bytes(range(30))


def _expect_one_refusal(probe: CanProbe) -> None:
    answer = probe.next_answer()
    check(
        answer.kind == "nack" and answer.code == INVALID_ID, f"one refusal of {UNKNOWN} with code 1", answer
    )
    probe.expect_silence("one message was sent")


@case(
    _CASES,
    "segments.lost",
    "a message with a lost segment has no effect, the next one has",
    SEGMENTS,
    intrusive=True,
)
def lost_segment(probe: CanProbe) -> None:
    """Each of the segments in turn."""
    frames = _segment_frames(probe, UNKNOWN, LONG)
    for lost in range(len(frames)):
        _send(probe, frames[:lost] + frames[lost + 1 :])
        # a message without its first segment cannot be told from a shorter one
        if lost == 0:
            probe.sleep(probe.times.quiet_s)
            probe.drain()
            continue
        if lost == len(frames) - 1:
            probe.expect_silence("the last segment is missing", LONG_PAUSE_S)
        else:
            probe.expect_silence(f"segment {lost} is missing")
        _send(probe, frames)
        _expect_one_refusal(probe)


@case(_CASES, "segments.doubled", "a message with a doubled segment has no effect", SEGMENTS, intrusive=True)
def doubled_segment(probe: CanProbe) -> None:
    """The second of five."""
    frames = _segment_frames(probe, UNKNOWN, LONG)
    _send(probe, [frames[0], frames[1], frames[1], *frames[2:]])
    probe.expect_silence("a segment came twice")
    _send(probe, frames)
    _expect_one_refusal(probe)


@case(_CASES, "segments.swapped", "a message with exchanged segments has no effect", SEGMENTS, intrusive=True)
def swapped_segments(probe: CanProbe) -> None:
    """The second and the third of five."""
    frames = _segment_frames(probe, UNKNOWN, LONG)
    _send(probe, [frames[0], frames[2], frames[1], *frames[3:]])
    probe.expect_silence("the counters were out of order")
    _send(probe, frames)
    _expect_one_refusal(probe)


@case(_CASES, "segments.empty", "a segment without a counter has no effect", SEGMENTS, intrusive=True)
def empty_segment(probe: CanProbe) -> None:
    """No data at all."""
    probe.send(CanFrame(identifier_of(TELECOMMAND_SEGMENT, UNKNOWN, probe.host, probe.device)))
    probe.expect_silence("there was no counter")
    _send(probe, _segment_frames(probe, UNKNOWN, LONG))
    _expect_one_refusal(probe)


@case(_CASES, "segments.half", "half a message is given up after a while", rule(2), intrusive=True)
def half_message(probe: CanProbe) -> None:
    """The last segment, when it comes too late, has no effect (two of them would be a message of their own)."""
    frames = _segment_frames(probe, UNKNOWN, LONG)
    _send(probe, frames[:-1])
    probe.sleep(LONG_PAUSE_S)
    _send(probe, frames[-1:])
    probe.expect_silence("the message had been given up")
    _send(probe, frames)
    _expect_one_refusal(probe)


@case(_CASES, "segments.pause", "a pause of 0.1 s between segments does no harm", rule(1), intrusive=True)
def pause_between(probe: CanProbe) -> None:
    """As slow hosts send."""
    for frame in _segment_frames(probe, UNKNOWN, LONG):
        probe.send(frame)
        probe.sleep(0.1)
    _expect_one_refusal(probe)


@case(_CASES, "segments.anew", "a message may begin anew before it was ended", rule(8), intrusive=True)
def begun_anew(probe: CanProbe) -> None:
    """Two segments, then all of them."""
    frames = _segment_frames(probe, UNKNOWN, LONG)
    _send(probe, frames[:2] + frames)
    _expect_one_refusal(probe)


@case(_CASES, "segments.two-hosts", "segments of two hosts do not mix", LAYOUT, intrusive=True)
def two_hosts(probe: CanProbe) -> None:
    """One from each in turn; both messages are complete."""
    ours, theirs = _segment_frames(probe, UNKNOWN, LONG), _segment_frames(probe, UNKNOWN, LONG, OTHER_HOST)
    for one, other in zip(ours, theirs, strict=True):
        _send(probe, [one, other])
    seen = [probe.next_answer() for _ in range(2)]
    check_equal([(answer.kind, answer.code, answer.other) for answer in seen], [("nack", INVALID_ID, probe.host), ("nack", INVALID_ID, OTHER_HOST)], "answers")  # fmt: skip


@case(
    _CASES,
    "segments.request-between",
    "a request between segments is answered at once and does no harm",
    LAYOUT,
    intrusive=True,
)
def request_between(probe: CanProbe) -> None:
    """Telemetry after the second of five segments."""
    frames = _segment_frames(probe, UNKNOWN, LONG)
    _send(probe, frames[:2])
    probe.expect_alive()
    _send(probe, frames[2:])
    _expect_one_refusal(probe)


@case(
    _CASES,
    "segments.overlong",
    "a message that is too long has no effect, the next one has",
    rule(4),
    intrusive=True,
)
def overlong(probe: CanProbe) -> None:
    """1750 bytes; the published host's buffer has 512."""
    _send(probe, _segment_frames(probe, UNKNOWN, bytes(250 * 7)))
    probe.expect_silence("the message was too long")
    _send(probe, _segment_frames(probe, UNKNOWN, LONG))
    _expect_one_refusal(probe)


@case(
    _CASES,
    "segments.long",
    "a message of 500 bytes is taken and refused for its length",
    rule(4),
    intrusive=True,
)
def long_message(probe: CanProbe) -> None:
    """set_star_config has 53."""
    row = probe.icd.telecommands["set_star_config"]
    probe.expect_refusal(row.id, bytes(500), INVALID_LENGTH)


# --- errors are flagged ---

FLAGS: Final = (
    ("type", "a message type that is no request", ("0580HHDD#00",), 0.0),
    ("swapped-kinds", "a telecommand frame with a telemetry identifier", ("0180HHDD#",), 0.0),
    ("sequence", "a segment out of order", ("073CHHDD#0001020304050602", "073CHHDD#0001020304050600"), 0.0),
    ("begins-nothing", "a last segment without others", ("073CHHDD#00010203040500",), 0.0),
    ("no-counter", "a segment without a counter", ("073CHHDD#",), 0.0),
    ("half", "half a message", ("073CHHDD#0001020304050602",), LONG_PAUSE_S),
)


def _flag_case(name: str, title: str, sent: tuple[str, ...], pause_s: float) -> Case[CanProbe]:
    def run(probe: CanProbe) -> None:
        probe.command("clear_counters")
        for text in sent:
            probe.send(_frame(probe, text))
        probe.expect_silence("no request was made", max(pause_s, probe.times.quiet_s))
        status = probe.telemetry("communication_status")
        check(status["can_telecommand_error"], "flag can_telecommand_error", "not set")
        check(
            not status["uart_protocol_error"] and not status["uart_incomplete"],
            "no flag of the serial line",
            "set",
        )
        counts = (status["telecommand_count"], status["telemetry_count"])
        check_equal(counts, (0, 1), "counts of telecommands and telemetry")
        probe.command("clear_counters")
        status = probe.telemetry("communication_status")
        check(not status["can_telecommand_error"], "flag cleared", "still set")

    return Case(
        f"errors.{name}",
        "errors",
        f"{title} sets its flag and counts as nothing",
        ERRORS,
        run,
        intrusive=True,
    )


_CASES += [_flag_case(*row) for row in FLAGS]


@case(_CASES, "errors.none", "good requests, and frames for others, set no flag", ERRORS, intrusive=True)
def no_flag(probe: CanProbe) -> None:
    """11-bit, remote and foreign frames are nobody's error."""
    probe.command("clear_counters")
    for text in ("0480HHFE#", "1F80HHFE#00", "480#0102", "0480HHDD#R", "073CHHFE#00"):
        probe.send(_frame(probe, text))
    probe.expect_silence("they are not for the device")
    _send(probe, _segment_frames(probe, UNKNOWN, LONG))
    _expect_one_refusal(probe)
    status = probe.telemetry("communication_status")
    check(not status["can_telecommand_error"], "no flag", "can_telecommand_error")


# --- time ---


@case(_CASES, "timing.burst", "two hundred requests back to back are all answered", rule(10))
def many_at_once(probe: CanProbe) -> None:
    """In order, none lost."""
    identifier = identifier_of(TELEMETRY_REQUEST, IDENTIFICATION, probe.host, probe.device)
    _send(probe, [CanFrame(identifier)] * 200)
    for _ in range(200):
        probe.expect_telemetry(IDENTIFICATION, 2.0)


CASES: Final = tuple(_CASES)
