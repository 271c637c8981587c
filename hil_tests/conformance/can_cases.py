"""CAN conformance: CAN IDs, lengths, segments, and frames not addressed to the device, with the rows of any unit."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Any, Final

from starhil.hil_tests.conformance.can_probe import (
    TELECOMMAND_SEGMENT,
    CanProbe,
    CanWire,
    can_id_of,
    segments,
)
from starhil.hil_tests.conformance.case import (
    Case,
    CaseArea,
    CaseFailed,
    CaseSkipped,
    check,
    check_equal,
    rule,
)
from starhil.hil_tests.conformance.link_probe import LONG_PAUSE_S
from starhil.hil_tests.conformance.row_cases import bad_values
from starhil.hil_tests.conformance.wire_tables import Exchange, FlagRow, add_exchange_cases, add_flag_cases
from starhil.protocol.can_framing import CanFrame
from starhil.protocol.codec import Row
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.messages import ErrorCode

SEGMENT_RULE: Final = "more than 8 bytes: 7 and a counter down to 0, no padding (libCubeObc)"
TYPES: Final = "message types 0 to 12 (libCubeObc)"

OTHER_HOST: Final = 0x4D
COMBINED: Final = 211
COMBINED_SIZE: Final = 54
CUBESTAR: Final = frozenset({128, 230, 211, 200, 60, 103, 96, 2, 112, 37})
"""Rows, and gaps between them, that a case uses if they are suitable."""
LONGEST: Final = 56
"""Maximum size of telemetry whose segments are checked: 8 segments."""


class CanRows:
    """Rows of a unit that the cases use; None if it has no such row.

    Attributes
    ----------
    single, small
        Telemetry that fits into a frame; the second has fewer than 8 bytes.
    long
        Telemetry in segments.
    unknown_telemetry, unknown_telecommand
        IDs that the unit does not have.
    empty
        Telecommand without data that may be sent at any time.
    refused
        Telecommand that fits into a frame, and data with a value that must be refused.
    eight
        Same, with 8 bytes.
    short
        Telecommand of 2 to 8 bytes.
    longest
        Telecommand with the most bytes.
    """

    def __init__(self, icd: InterfaceDefinition) -> None:
        telemetry, commands = list(icd.telemetry.values()), list(icd.telecommands.values())
        bad = [(row, data) for row in commands for data in _bad_data(row) if len(data) <= 8]
        self.single = _first(row for row in telemetry if row.size <= 8)
        self.small = _first(row for row in telemetry if row.size < 8)
        self.long = _first(
            sorted((row for row in telemetry if 8 < row.size <= LONGEST), key=lambda row: -row.size)
        )
        self.unknown_telemetry = _gap(range(128, 256), {row.id for row in telemetry})
        self.unknown_telecommand = _gap(range(128), {row.id for row in commands})
        self.empty = _first(row for row in commands if not row.size and row.action != "reset")
        self.refused = _first(row for row, _ in bad)
        self.eight = _first(row for row, data in bad if len(data) == 8)
        self.short = _first(row for row in commands if 2 <= row.size <= 8)
        self.longest = _first(sorted((row for row in commands if row.size > 8), key=lambda row: -row.size))

    def texts(self, icd: InterfaceDefinition) -> dict[str, str]:
        """Return the texts for the names in braces in the table of frames; missing rows have none."""
        found = {name: f"{row.id:02X}" for name, row in vars(self).items() if isinstance(row, Row)}
        found |= {name: f"{number:02X}" for name, number in vars(self).items() if isinstance(number, int)}
        for name in ("single", "small"):
            row = getattr(self, name)
            if row is not None:
                found |= {f"{name}_data": ".." * row.size, f"{name}_size": str(row.size)}
        for name in ("refused", "eight"):
            row = getattr(self, name)
            if row is not None:
                data = next(data for data in _bad_data(row)).hex().upper()
                found |= {f"{name}_data": data, f"{name}_first": data[:14], f"{name}_rest": data[14:]}
        for name in ("invalid_id", "invalid_length", "invalid_parameter"):
            found[name] = f"{int(icd.error_number(ErrorCode[name.upper()])):02X}"
        return found


def _bad_data(row: Row) -> list[bytes]:
    return [data for field in row.named_fields.values() for _, data in bad_values(row, field)]


def _first(rows: Iterable[Row]) -> Row | None:
    """Return CubeStar's row if it is among these, otherwise the first."""
    found = list(rows)
    return next((row for row in found if row.id in CUBESTAR), found[0] if found else None)


def _gap(numbers: range, known: set[int]) -> int | None:
    gaps = [number for number in numbers if number not in known]
    return next((number for number in gaps if number in CUBESTAR), gaps[0] if gaps else None)


FRAME_RULE: Final = "29-bit CAN ID: type[28:24] row[23:16] source[15:8] destination[7:0] (libCubeObc)"
REPLY_SEGMENTS: Final = CaseArea[CanWire]("segments", SEGMENT_RULE)
SEGMENTS: Final = CaseArea[CanWire]("segments", SEGMENT_RULE, intrusive=True)
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
    Exchange("telemetry", "a telemetry request is answered with type 5 and exchanged addresses", ("04{single}HHDD#",), ("05{single}DDHH#{single_data}",)),
    Exchange("telemetry-{small_size}", "telemetry of {small_size} bytes has {small_size} bytes, no padding", ("04{small}HHDD#",), ("05{small}DDHH#{small_data}",)),
    Exchange("unknown-telemetry", "an unknown telemetry ID is refused with type 6 and the code", ("04{unknown_telemetry}HHDD#",), ("06{unknown_telemetry}DDHH#{invalid_id}",), clause=TYPES),
    Exchange("other-device", "a frame for another address is not answered", ("04{single}HHFE#",)),
    Exchange("other-device-zero", "a frame for address 0 is not answered", ("04{single}HH00#",)),
    Exchange("standard", "a frame with an 11-bit CAN ID is not answered", ("480#", "604#")),
    Exchange("remote", "a remote frame is not answered", ("04{single}HHDD#R",)),
    *(Exchange(f"type-{kind}", f"{words} is not answered", (f"{kind:02X}{{single}}HHDD#00",), clause=TYPES) for kind, words in IGNORED),
    Exchange("telemetry-as-telecommand", "a telecommand frame with a telemetry ID is not answered", ("01{single}HHDD#",), clause=rule(6)),
    Exchange("telecommand-as-telemetry", "a telemetry request with a telecommand ID is not answered", ("04{short}HHDD#",), clause=rule(6)),
    Exchange("two-at-once", "two requests back to back are answered in order", ("04{single}HHDD#", "04{small}HHDD#"), ("05{single}DDHH#{single_data}", "05{small}DDHH#{small_data}")),
)  # fmt: skip

INTRUSIVE_EXCHANGES: Final = (
    Exchange("ack", "an accepted telecommand is answered with type 2 and no data", ("01{empty}HHDD#",), ("02{empty}DDHH#",), clause=TYPES),
    Exchange("nack", "a refused telecommand is answered with type 3 and one byte", ("01{refused}HHDD#{refused_data}",), ("03{refused}DDHH#{invalid_parameter}",), clause=TYPES),
    Exchange("eight", "a telecommand of 8 bytes fits into one frame", ("01{eight}HHDD#{eight_data}",), ("03{eight}DDHH#{invalid_parameter}",), clause=SEGMENT_RULE),
    Exchange("eight-segmented", "a telecommand of 8 bytes may also be sent in segments", ("07{eight}HHDD#{eight_first}01", "07{eight}HHDD#{eight_rest}00"), ("03{eight}DDHH#{invalid_parameter}",), clause=rule(7)),
    Exchange("segmented-unknown", "an unknown telecommand in segments is refused once, after the last", ("07{unknown_telecommand}HHDD#0001020304050601", "07{unknown_telecommand}HHDD#0708090A0B00"), ("03{unknown_telecommand}DDHH#{invalid_id}",), clause=SEGMENT_RULE),
    Exchange("segmented-full-last", "the last segment may hold 7 bytes", ("07{unknown_telecommand}HHDD#0001020304050601", "07{unknown_telecommand}HHDD#0708090A0B0C0D00"), ("03{unknown_telecommand}DDHH#{invalid_id}",), clause=SEGMENT_RULE),
)  # fmt: skip


def _frame_cases(icd: InterfaceDefinition) -> list[Case[CanWire]]:
    """Return the cases of the tables of frames whose rows the unit has."""
    texts = CanRows(icd).texts(icd)
    area = CaseArea[CanWire]("frames", FRAME_RULE)
    add_exchange_cases(area, _filled(EXCHANGES, texts))
    add_exchange_cases(area, _filled(INTRUSIVE_EXCHANGES, texts), intrusive=True)
    area.case("askers", "each sender gets the answer at its own address")(askers)
    return area.cases


def _filled(table: Iterable[Exchange], texts: dict[str, str]) -> Iterator[Exchange]:
    """Yield the rows of a table with names in braces replaced by texts; skip rows with a missing text."""
    for row in table:
        with suppress(KeyError):
            sent, answers = (tuple(text.format(**texts) for text in part) for part in (row.sent, row.answers))
            name, title = row.id.format(**texts), row.title.format(**texts)
            yield replace(row, id=name, title=title, sent=sent, answers=answers)


def askers(probe: CanWire) -> None:
    """Send requests from three addresses."""
    for source in (OTHER_HOST, probe.host, 0xFF):
        probe.post_as(source, needed(CanRows(probe.icd).single, "telemetry of up to 8 bytes").id)
    seen = [probe.next_answer() for _ in range(3)]
    check_equal([(answer.kind, answer.other) for answer in seen], [("telemetry", OTHER_HOST), ("telemetry", probe.host), ("telemetry", 0xFF)], "answers to")  # fmt: skip


# --- segments of the answer ---


def _segmented_reply(row: Row) -> Case[CanWire]:
    count = -(-row.size // 7)
    rest = row.size - 7 * (count - 1)

    def run(probe: CanWire) -> None:
        probe.post_as(probe.host, row.id)
        frames = [probe.next_frame() for _ in range(count)]
        can_id = can_id_of(8, row.id, probe.device, probe.host)
        seen = [
            (frame.id, len(frame.data), frame.data[-1] if frame.data else -1)
            for frame in frames
            if frame is not None
        ]
        wanted = [(can_id, 8, left) for left in range(count - 1, 0, -1)] + [(can_id, rest + 1, 0)]
        check_equal(seen, wanted, "segments")

    title = (
        f"{row.size} bytes are sent in {count} segments that count from {count - 1} to 0, "
        f"the last with {rest} bytes and its counter"
    )
    return Case("segments.reply", "segments", title, SEGMENT_RULE, run)


@REPLY_SEGMENTS.case("all-rows", "every row of up to 8 bytes is sent in one frame, longer rows in segments")
def all_rows(probe: CanWire) -> None:
    for row in probe.icd.telemetry.values():
        probe.post_as(probe.host, row.id)
        frame = probe.next_frame()
        if frame is None:
            raise CaseFailed(f"an answer to {row.id}", "nothing")
        kind = 5 if row.size <= 8 else 8
        check_equal(frame.id >> 24, kind, f"type of the answer to {row.id} ({row.size} bytes)")
        for _ in range(frame.data[-1] if kind == 8 and frame.data else 0):
            probe.next_frame()


@UNSOLICITED.case(
    "segments", "an unsolicited long row is sent as first, body and last, with counters down to 0"
)
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


def _unknown_frames(probe: CanWire, data: bytes, source: int | None = None) -> list[CanFrame]:
    """Return the segments of an unknown telecommand, whose refusal shows that the message was complete."""
    number = CanRows(probe.icd).unknown_telecommand
    if number is None:
        raise CaseSkipped("the unit has a telecommand for every ID")
    source = probe.host if source is None else source
    can_id = can_id_of(TELECOMMAND_SEGMENT, number, source, probe.device)
    return [CanFrame(can_id, part) for part in segments(data)]


def needed(row: Row | None, what: str) -> Row:
    """Return a row; skip the case if it is None."""
    if row is None:
        raise CaseSkipped(f"the unit has no {what}")
    return row


def _send(probe: CanWire, frames: list[CanFrame]) -> None:
    for frame in frames:
        probe.send(frame)


LONG: Final = bytes(range(30))


def _expect_one_refusal(probe: CanWire) -> None:
    probe.expect_answer("nack", "one refusal of an unknown telecommand", ErrorCode.INVALID_ID)
    probe.expect_silence("one message was sent")


@SEGMENTS.case("lost", "a message with a lost segment has no effect, the next one is answered")
def lost_segment(probe: CanWire) -> None:
    frames = _unknown_frames(probe, LONG)
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
    ("doubled", "a message with a duplicate segment has no effect", (0, 1, 1, 2, 3, 4)),
    ("swapped", "a message with exchanged segments has no effect", (0, 2, 1, 3, 4)),
    ("empty", "a segment without a counter has no effect", ()),
)
"""Name, title, and the order in which the five segments of a message are sent; empty: one segment without a
counter."""


def _faulty_message(title: str, order: tuple[int, ...], probe: CanWire) -> None:
    frames = _unknown_frames(probe, LONG)
    _send(probe, [frames[place] for place in order] or [CanFrame(frames[0].id)])
    probe.expect_silence(title)
    _send(probe, frames)
    _expect_one_refusal(probe)


for _name, _title, _order in FAULTY:
    SEGMENTS.case(_name, _title)(partial(_faulty_message, _title, _order))


@SEGMENTS.case("half", "an incomplete message is dropped after a time-out", rule(2))
def half_message(probe: CanWire) -> None:
    """The last segment arrives too late; the last two would form a message."""
    frames = _unknown_frames(probe, LONG)
    _send(probe, frames[:-1])
    probe.sleep(LONG_PAUSE_S)
    _send(probe, frames[-1:])
    probe.expect_silence("the message has timed out")
    _send(probe, frames)
    _expect_one_refusal(probe)


@SEGMENTS.case("pause", "a pause of 0.1 s between segments has no effect", rule(1))
def pause_between(probe: CanWire) -> None:
    for frame in _unknown_frames(probe, LONG):
        probe.send(frame)
        probe.sleep(0.1)
    _expect_one_refusal(probe)


@SEGMENTS.case("restart", "a message may be restarted before its end", rule(8))
def restarted_message(probe: CanWire) -> None:
    frames = _unknown_frames(probe, LONG)
    _send(probe, frames[:2] + frames)
    _expect_one_refusal(probe)


@SEGMENTS.case("two-hosts", "segments of two hosts are not mixed", FRAME_RULE)
def two_hosts(probe: CanWire) -> None:
    ours, theirs = _unknown_frames(probe, LONG), _unknown_frames(probe, LONG, OTHER_HOST)
    for one, other in zip(ours, theirs, strict=True):
        _send(probe, [one, other])
    seen = [probe.next_answer() for _ in range(2)]
    code = int(probe.icd.error_number(ErrorCode.INVALID_ID))
    check_equal([(answer.kind, answer.code, answer.other) for answer in seen], [("nack", code, probe.host), ("nack", code, OTHER_HOST)], "answers")  # fmt: skip


@SEGMENTS.case(
    "request-between",
    "a request between segments is answered at once and does not disturb the message",
    FRAME_RULE,
)
def request_between(probe: CanWire) -> None:
    frames = _unknown_frames(probe, LONG)
    _send(probe, frames[:2])
    probe.expect_alive()
    _send(probe, frames[2:])
    _expect_one_refusal(probe)


@SEGMENTS.case("overlong", "a message that is too long has no effect, the next one is answered", rule(4))
def overlong(probe: CanWire) -> None:
    """The message has 1750 bytes; the buffer of the published host software has 512."""
    _send(probe, _unknown_frames(probe, bytes(250 * 7)))
    probe.expect_silence("the message was too long")
    _send(probe, _unknown_frames(probe, LONG))
    _expect_one_refusal(probe)


@SEGMENTS.case("long", "a message of 500 bytes is received and refused for its length", rule(4))
def long_message(probe: CanWire) -> None:
    row = needed(CanRows(probe.icd).longest, "telecommand of more than 8 bytes")
    probe.post_as(probe.host, row.id, bytes(500))
    probe.expect_answer("nack", f"refusal of {row.name} for its length", ErrorCode.INVALID_LENGTH)


# --- errors are flagged ---

CAN_ERROR: Final = frozenset({"can_telecommand_error"})
FLAGS: Final = (
    FlagRow("type", "a message type that is not a request", ("0580HHDD#00",), CAN_ERROR),
    FlagRow("swapped-kinds", "a telecommand frame with a telemetry ID", ("0180HHDD#",), CAN_ERROR),
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
    _send(probe, _unknown_frames(probe, LONG))
    _expect_one_refusal(probe)
    status = probe.telemetry("communication_status")
    check(not status["can_telecommand_error"], "no flag", "can_telecommand_error")


def can_cases(icd: InterfaceDefinition, *, cubestar: bool) -> list[Case[Any]]:
    """Return the cases for a unit with a CAN link; some are for CubeStar only."""
    long = CanRows(icd).long
    return [
        *_frame_cases(icd),
        *([] if long is None else [_segmented_reply(long)]),
        *REPLY_SEGMENTS.cases,
        *(UNSOLICITED.cases if cubestar else []),
        *SEGMENTS.cases,
        *(ERRORS.cases if cubestar else []),
    ]
