"""CAN conformance: identifiers, lengths, segments, and what is not for the device."""

from __future__ import annotations

from typing import Final

from starhil.hil_tests.conformance.can_probe import (
    TELECOMMAND_SEGMENT,
    CanProbe,
    identifier_of,
    segments,
)
from starhil.hil_tests.conformance.case import CaseArea, check, check_equal, rule
from starhil.hil_tests.conformance.link_probe import INVALID_ID, INVALID_LENGTH, LONG_PAUSE_S
from starhil.hil_tests.conformance.wire_tables import Exchange, FlagRow, add_exchange_cases, add_flag_cases
from starhil.protocol.can_framing import CanFrame

SEGMENT_RULE: Final = "more than 8 bytes: 7 and a counter down to 0, no padding (libCubeObc)"
TYPES: Final = "message types 0 to 12 (libCubeObc)"

OTHER_HOST: Final = 0x4D
IDENTIFICATION: Final = 128
COMBINED: Final = 211
COMBINED_SIZE: Final = 54

FRAMES: Final = CaseArea[CanProbe](
    "frames", "29-bit identifier: type[28:24] id[23:16] source[15:8] destination[7:0] (libCubeObc)"
)
REPLY_SEGMENTS: Final = CaseArea[CanProbe]("segments", SEGMENT_RULE)
SEGMENTS: Final = CaseArea[CanProbe]("segments", SEGMENT_RULE, intrusive=True)
UNSOLICITED: Final = CaseArea[CanProbe](
    "unsolicited", "types 10 to 12 (libCubeObc); their use: R20, docs/rules.md", intrusive=True
)
ERRORS: Final = CaseArea[CanProbe](
    "errors", "configs/units/cubestar: communication_status 144, flag can_telecommand_error", intrusive=True
)


IGNORED: Final = ((2, "an acknowledge"), (3, "a telecommand refusal"), (5, "telemetry"), (6, "a telemetry refusal"),
                  (8, "a telemetry segment"), (9, "an event"), (10, "unsolicited telemetry, first"),
                  (11, "unsolicited telemetry, body"), (12, "unsolicited telemetry, last"), (0, "type 0"),
                  (13, "type 13"), (31, "type 31"))  # fmt: skip

EXCHANGES: Final = (
    Exchange("telemetry", "a request of telemetry is answered with type 5, addresses exchanged", ("0480HHDD#",), ("0580DDHH#................",)),
    Exchange("telemetry-6", "telemetry of 6 bytes has 6 bytes, no padding", ("04E6HHDD#",), ("05E6DDHH#............",)),
    Exchange("unknown-telemetry", "an unknown telemetry identifier is refused with type 6 and the code", ("04C8HHDD#",), ("06C8DDHH#01",), clause=TYPES),
    Exchange("other-device", "a frame for another address is not answered", ("0480HHFE#",)),
    Exchange("other-device-zero", "a frame for address 0 is not answered", ("0480HH00#",)),
    Exchange("standard", "a frame with an 11-bit identifier is not answered", ("480#", "604#")),
    Exchange("remote", "a remote frame is not answered", ("0480HHDD#R",)),
    *(Exchange(f"type-{kind}", f"{words} is not answered", (f"{kind:02X}80HHDD#00",), clause=TYPES) for kind, words in IGNORED),
    Exchange("telemetry-as-telecommand", "a telecommand frame with a telemetry identifier is no request", ("0180HHDD#",), clause=rule(6)),
    Exchange("telecommand-as-telemetry", "a telemetry request with a telecommand identifier is no request", ("0402HHDD#",), clause=rule(6)),
    Exchange("two-at-once", "two requests back to back are answered in order", ("0480HHDD#", "04E6HHDD#"), ("0580DDHH#................", "05E6DDHH#............")),
)  # fmt: skip

INTRUSIVE_EXCHANGES: Final = (
    Exchange("ack", "an accepted telecommand is answered with type 2 and no data", ("0167HHDD#",), ("0267DDHH#",), clause=TYPES),
    Exchange("nack", "a refused telecommand is answered with type 3 and one byte", ("0160HHDD#4D",), ("0360DDHH#03",), clause=TYPES),
    Exchange("eight", "a telecommand of 8 bytes goes in one frame", ("0170HHDD#0200000000000100",), ("0370DDHH#03",), clause=SEGMENT_RULE),
    Exchange("eight-segmented", "a telecommand of 8 bytes may also come in segments", ("0770HHDD#0200000000000101", "0770HHDD#0000"), ("0370DDHH#03",), clause=rule(7)),
    Exchange("segmented-unknown", "an unknown telecommand in segments is refused once, after the last", ("073CHHDD#0001020304050601", "073CHHDD#0708090A0B00"), ("033CDDHH#01",), clause=SEGMENT_RULE),
    Exchange("segmented-full-last", "the last segment may hold 7 bytes", ("073CHHDD#0001020304050601", "073CHHDD#0708090A0B0C0D00"), ("033CDDHH#01",), clause=SEGMENT_RULE),
)  # fmt: skip


add_exchange_cases(FRAMES, EXCHANGES)
add_exchange_cases(FRAMES, INTRUSIVE_EXCHANGES, intrusive=True)


@FRAMES.case("askers", "each asker gets the answer at its own address")
def askers(probe: CanProbe) -> None:
    for source in (OTHER_HOST, probe.host, 0xFF):
        probe.post_as(source, IDENTIFICATION)
    seen = [probe.next_answer() for _ in range(3)]
    check_equal([(answer.kind, answer.other) for answer in seen], [("telemetry", OTHER_HOST), ("telemetry", probe.host), ("telemetry", 0xFF)], "answers to")  # fmt: skip


# --- segments of the answer ---


@REPLY_SEGMENTS.case(
    "reply",
    "54 bytes come in 8 segments that count 7 to 0, the last with 5 bytes and its counter",
)
def segmented_reply(probe: CanProbe) -> None:
    probe.post(COMBINED)
    frames = [probe.next_frame() for _ in range(8)]
    identifier = identifier_of(8, COMBINED, probe.device, probe.host)
    seen = [
        (frame.id, len(frame.data), frame.data[-1] if frame.data else -1)
        for frame in frames
        if frame is not None
    ]
    check_equal(seen, [(identifier, 8, left) for left in range(7, 0, -1)] + [(identifier, 6, 0)], "segments")


@REPLY_SEGMENTS.case("all-rows", "every row goes in one frame up to 8 bytes, in segments above")
def all_rows(probe: CanProbe) -> None:
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


@UNSOLICITED.case("segments", "a long row comes unsolicited as first, body and last, counters down to 0")
def unsolicited_segments(probe: CanProbe) -> None:
    """star_tracker has 54 bytes, so 8 frames."""
    probe.command("set_unsolicited", telemetry=COMBINED, rate=5.0)
    try:
        probe.receive_unsolicited(1.0)
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


@SEGMENTS.case("lost", "a message with a lost segment has no effect, the next one has")
def lost_segment(probe: CanProbe) -> None:
    frames = _segment_frames(probe, UNKNOWN, LONG)
    for lost in range(len(frames)):
        _send(probe, frames[:lost] + frames[lost + 1 :])
        # a message without its first segment looks like a shorter one
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


FAULTY: Final = (
    ("doubled", "a message with a doubled segment has no effect", (0, 1, 1, 2, 3, 4)),
    ("swapped", "a message with exchanged segments has no effect", (0, 2, 1, 3, 4)),
    ("empty", "a segment without a counter has no effect", ()),
)
"""Name, title, and the order in which the five segments of a message are sent; one without a counter if none."""


def _add_faulty_case(name: str, title: str, order: tuple[int, ...]) -> None:
    @SEGMENTS.case(name, title)
    def run(probe: CanProbe) -> None:
        frames = _segment_frames(probe, UNKNOWN, LONG)
        _send(probe, [frames[place] for place in order] or [CanFrame(frames[0].id)])
        probe.expect_silence(title)
        _send(probe, frames)
        _expect_one_refusal(probe)


for _faulty in FAULTY:
    _add_faulty_case(*_faulty)


@SEGMENTS.case("half", "an incomplete message is dropped after a time-out", rule(2))
def half_message(probe: CanProbe) -> None:
    """The last segment arrives too late (the last two would form a message)."""
    frames = _segment_frames(probe, UNKNOWN, LONG)
    _send(probe, frames[:-1])
    probe.sleep(LONG_PAUSE_S)
    _send(probe, frames[-1:])
    probe.expect_silence("the message has timed out")
    _send(probe, frames)
    _expect_one_refusal(probe)


@SEGMENTS.case("pause", "a pause of 0.1 s between segments does no harm", rule(1))
def pause_between(probe: CanProbe) -> None:
    for frame in _segment_frames(probe, UNKNOWN, LONG):
        probe.send(frame)
        probe.sleep(0.1)
    _expect_one_refusal(probe)


@SEGMENTS.case("restart", "a message may restart before its end", rule(8))
def restarted_message(probe: CanProbe) -> None:
    frames = _segment_frames(probe, UNKNOWN, LONG)
    _send(probe, frames[:2] + frames)
    _expect_one_refusal(probe)


@SEGMENTS.case("two-hosts", "segments of two hosts do not mix", FRAMES.clause)
def two_hosts(probe: CanProbe) -> None:
    ours, theirs = _segment_frames(probe, UNKNOWN, LONG), _segment_frames(probe, UNKNOWN, LONG, OTHER_HOST)
    for one, other in zip(ours, theirs, strict=True):
        _send(probe, [one, other])
    seen = [probe.next_answer() for _ in range(2)]
    check_equal([(answer.kind, answer.code, answer.other) for answer in seen], [("nack", INVALID_ID, probe.host), ("nack", INVALID_ID, OTHER_HOST)], "answers")  # fmt: skip


@SEGMENTS.case(
    "request-between", "a request between segments is answered at once and does no harm", FRAMES.clause
)
def request_between(probe: CanProbe) -> None:
    frames = _segment_frames(probe, UNKNOWN, LONG)
    _send(probe, frames[:2])
    probe.expect_alive()
    _send(probe, frames[2:])
    _expect_one_refusal(probe)


@SEGMENTS.case("overlong", "a message that is too long has no effect, the next one has", rule(4))
def overlong(probe: CanProbe) -> None:
    """1750 bytes; the buffer of the published host software has 512."""
    _send(probe, _segment_frames(probe, UNKNOWN, bytes(250 * 7)))
    probe.expect_silence("the message was too long")
    _send(probe, _segment_frames(probe, UNKNOWN, LONG))
    _expect_one_refusal(probe)


@SEGMENTS.case("long", "a message of 500 bytes is taken and refused for its length", rule(4))
def long_message(probe: CanProbe) -> None:
    """set_star_config has 53 bytes."""
    row = probe.icd.telecommands["set_star_config"]
    probe.expect_refusal(row.id, bytes(500), INVALID_LENGTH)


# --- errors are flagged ---

CAN_ERROR: Final = frozenset({"can_telecommand_error"})
FLAGS: Final = (
    FlagRow("type", "a message type that is no request", ("0580HHDD#00",), CAN_ERROR),
    FlagRow("swapped-kinds", "a telecommand frame with a telemetry identifier", ("0180HHDD#",), CAN_ERROR),
    FlagRow("sequence", "a segment out of order", ("073CHHDD#0001020304050602", "073CHHDD#0001020304050600"), CAN_ERROR),
    FlagRow("begins-nothing", "a last segment without others", ("073CHHDD#00010203040500",), CAN_ERROR),
    FlagRow("no-counter", "a segment without a counter", ("073CHHDD#",), CAN_ERROR),
    FlagRow("half", "half a message", ("073CHHDD#0001020304050602",), CAN_ERROR, pause_s=LONG_PAUSE_S),
)  # fmt: skip
add_flag_cases(ERRORS, FLAGS)


@ERRORS.case("none", "good requests, and frames for others, set no flag")
def no_flag(probe: CanProbe) -> None:
    probe.command("clear_counters")
    for text in ("0480HHFE#", "1F80HHFE#00", "480#0102", "0480HHDD#R", "073CHHFE#00"):
        probe.send_text(text)
    probe.expect_silence("they are not for the device")
    _send(probe, _segment_frames(probe, UNKNOWN, LONG))
    _expect_one_refusal(probe)
    status = probe.telemetry("communication_status")
    check(not status["can_telecommand_error"], "no flag", "can_telecommand_error")


CASES: Final = (
    *FRAMES.cases,
    *REPLY_SEGMENTS.cases,
    *UNSOLICITED.cases,
    *SEGMENTS.cases,
    *ERRORS.cases,
)
