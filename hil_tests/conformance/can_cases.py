"""CAN conformance: CAN IDs, lengths, segments, and frames not addressed to the device, with the rows of any unit."""

from __future__ import annotations

import random
from collections.abc import Iterable, Iterator
from functools import partial
from typing import Any, Final

from starhil.hil_tests.conformance.can_probe import CanProbe
from starhil.hil_tests.conformance.case import (
    Case,
    CaseArea,
    CaseFailed,
    CaseSkipped,
    check_equal,
    rule,
)
from starhil.hil_tests.conformance.link_probe import (
    INVALID_ID,
    INVALID_LENGTH,
    INVALID_PARAMETER,
    LONG_PAUSE_S,
)
from starhil.hil_tests.conformance.ports import CanFrame
from starhil.hil_tests.conformance.row_cases import row_cases
from starhil.hil_tests.conformance.wire_tables import Exchange, add_exchange_cases, filled
from starhil.hil_tests.judge.can import TELECOMMAND_SEGMENT, can_id_of, segments
from starhil.hil_tests.judge.definition import Unit
from starhil.hil_tests.judge.rows import Row

SEGMENT_RULE: Final = "more than 8 bytes: 7 and a counter down to 0, no padding (libCubeObc)"
TYPES: Final = "message types 0 to 12 (libCubeObc)"

OTHER_HOST: Final = 0x4D
LONGEST: Final = 56
"""Maximum size of telemetry whose segments are checked: 8 segments."""


class CanRows:
    """Rows of a unit that the cases use; None if it has no such row.

    `long` is telemetry in segments, if possible with a last one that is not full; `empty` a telecommand that may be sent at any
    time; `refused` and `eight` telecommands in a frame that have a value that must be refused, the second of 8 bytes.
    """

    def __init__(self, unit: Unit) -> None:
        telemetry, commands = list(unit.telemetry.values()), list(unit.telecommands.values())
        bad = [(row, data) for row in commands for data in _bad_data(row) if len(data) <= 8]
        self.single = _first(row for row in telemetry if row.size <= 8)
        self.small = _first(row for row in telemetry if row.size < 8)
        shown = [row for row in telemetry if 8 < row.size <= LONGEST]
        self.long = _first(sorted(shown, key=lambda row: (row.size % 7 == 0, -row.size)))
        self.unknown_telemetry = _gap(range(128, 256), {row.id for row in telemetry})
        self.unknown_telecommand = _gap(range(128), {row.id for row in commands})
        self.empty = _first(row for row in commands if not row.size and row.action != "reset")
        self.refused = _first(row for row, _ in bad)
        self.eight = _first(row for row, data in bad if len(data) == 8)
        self.short = _first(row for row in commands if 2 <= row.size <= 8)
        self.longest = _first(sorted((row for row in commands if row.size > 8), key=lambda row: -row.size))

    def texts(self, unit: Unit) -> dict[str, str]:
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
        for name in (INVALID_ID, INVALID_LENGTH, INVALID_PARAMETER):
            found[name] = f"{unit.code(name):02X}"
        return found


def _bad_data(row: Row) -> list[bytes]:
    return [data for field in row.named.values() for _, data in row.bad_values(field)]


def _first(rows: Iterable[Row]) -> Row | None:
    return next(iter(rows), None)


def _gap(numbers: range, known: set[int]) -> int | None:
    return next((number for number in numbers if number not in known), None)


FRAME_RULE: Final = "29-bit CAN ID: type[28:24] row[23:16] source[15:8] destination[7:0] (libCubeObc)"
REPLY_SEGMENTS: Final = CaseArea[CanProbe]("segments", SEGMENT_RULE)
SEGMENTS: Final = CaseArea[CanProbe]("segments", SEGMENT_RULE, intrusive=True)

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


def _frame_cases(unit: Unit) -> list[Case[CanProbe]]:
    """Return the cases of the tables of frames whose rows the unit has."""
    texts = CanRows(unit).texts(unit)
    area = CaseArea[CanProbe]("frames", FRAME_RULE)
    add_exchange_cases(area, filled(EXCHANGES, texts))
    add_exchange_cases(area, filled(INTRUSIVE_EXCHANGES, texts), intrusive=True)
    area.case("askers", "each sender gets the answer at its own address")(askers)
    return area.cases


def askers(probe: CanProbe) -> None:
    """Send requests from three addresses."""
    for source in (OTHER_HOST, probe.host, 0xFF):
        row = needed(CanRows(probe.unit).single, "telemetry of up to 8 bytes")
        probe.post_as(source, probe.unit.request(row))
    seen = [probe.next_answer() for _ in range(3)]
    check_equal([(answer.kind, answer.other) for answer in seen], [("telemetry", OTHER_HOST), ("telemetry", probe.host), ("telemetry", 0xFF)], "answers to")  # fmt: skip


# --- segments of the answer ---


def _segmented_reply(row: Row) -> Case[CanProbe]:
    count = -(-row.size // 7)
    rest = row.size - 7 * (count - 1)

    def run(probe: CanProbe) -> None:
        probe.post(row)
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
def all_rows(probe: CanProbe) -> None:
    for row in probe.unit.telemetry.values():
        probe.post(row)
        frame = probe.next_frame()
        if frame is None:
            raise CaseFailed(f"an answer to {row.id}", "nothing")
        kind = 5 if row.size <= 8 else 8
        check_equal(frame.id >> 24, kind, f"type of the answer to {row.id} ({row.size} bytes)")
        for _ in range(frame.data[-1] if kind == 8 and frame.data else 0):
            probe.next_frame()


# --- segments of telecommands ---


def _unknown_frames(probe: CanProbe, data: bytes, source: int | None = None) -> list[CanFrame]:
    """Return the segments of an unknown telecommand, whose refusal shows that the message was complete."""
    number = CanRows(probe.unit).unknown_telecommand
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


def _send(probe: CanProbe, frames: list[CanFrame]) -> None:
    for frame in frames:
        probe.send(frame)


LONG: Final = bytes(range(30))


def _expect_one_refusal(probe: CanProbe) -> None:
    probe.expect_answer("nack", "one refusal of an unknown telecommand", INVALID_ID)
    probe.expect_silence("one message was sent")


@SEGMENTS.case("lost", "a message with a lost segment has no effect, the next one is answered")
def lost_segment(probe: CanProbe) -> None:
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


def _faulty_message(title: str, order: tuple[int, ...], probe: CanProbe) -> None:
    frames = _unknown_frames(probe, LONG)
    _send(probe, [frames[place] for place in order] or [CanFrame(frames[0].id)])
    probe.expect_silence(title)
    _send(probe, frames)
    _expect_one_refusal(probe)


for _name, _title, _order in FAULTY:
    SEGMENTS.case(_name, _title)(partial(_faulty_message, _title, _order))


@SEGMENTS.case("half", "an incomplete message is dropped after a time-out", rule(2))
def half_message(probe: CanProbe) -> None:
    """The last segment arrives too late; the last two would form a message."""
    frames = _unknown_frames(probe, LONG)
    _send(probe, frames[:-1])
    probe.sleep(LONG_PAUSE_S)
    _send(probe, frames[-1:])
    probe.expect_silence("the message has timed out")
    _send(probe, frames)
    _expect_one_refusal(probe)


@SEGMENTS.case("pause", "a pause of 0.1 s between segments has no effect", rule(1))
def pause_between(probe: CanProbe) -> None:
    for frame in _unknown_frames(probe, LONG):
        probe.send(frame)
        probe.sleep(0.1)
    _expect_one_refusal(probe)


@SEGMENTS.case("restart", "a message may be restarted before its end", rule(8))
def restarted_message(probe: CanProbe) -> None:
    frames = _unknown_frames(probe, LONG)
    _send(probe, frames[:2] + frames)
    _expect_one_refusal(probe)


@SEGMENTS.case("two-hosts", "segments of two hosts are not mixed", FRAME_RULE)
def two_hosts(probe: CanProbe) -> None:
    ours, theirs = _unknown_frames(probe, LONG), _unknown_frames(probe, LONG, OTHER_HOST)
    for one, other in zip(ours, theirs, strict=True):
        _send(probe, [one, other])
    seen = [probe.next_answer() for _ in range(2)]
    code = probe.unit.code(INVALID_ID)
    check_equal([(answer.kind, answer.code, answer.other) for answer in seen], [("nack", code, probe.host), ("nack", code, OTHER_HOST)], "answers")  # fmt: skip


@SEGMENTS.case(
    "request-between",
    "a request between segments is answered at once and does not disturb the message",
    FRAME_RULE,
)
def request_between(probe: CanProbe) -> None:
    frames = _unknown_frames(probe, LONG)
    _send(probe, frames[:2])
    probe.expect_alive()
    _send(probe, frames[2:])
    _expect_one_refusal(probe)


@SEGMENTS.case("overlong", "a message that is too long has no effect, the next one is answered", rule(4))
def overlong(probe: CanProbe) -> None:
    """The message has 1750 bytes; the buffer of the published host software has 512."""
    _send(probe, _unknown_frames(probe, bytes(250 * 7)))
    probe.expect_silence("the message was too long")
    _send(probe, _unknown_frames(probe, LONG))
    _expect_one_refusal(probe)


@SEGMENTS.case("long", "a message of 500 bytes is received and refused for its length", rule(4))
def long_message(probe: CanProbe) -> None:
    row = needed(CanRows(probe.unit).longest, "telecommand of more than 8 bytes")
    probe.post(row, bytes(500))
    probe.expect_answer("nack", f"refusal of {row.name} for its length", INVALID_LENGTH)


# --- noise ---


def noise(probe: CanProbe) -> None:
    rng = random.Random(7)  # noqa: S311 -- noise, not a secret
    for _ in range(400):
        kind = rng.choice((0, 2, 3, 5, 6, 9, 13, 20, 31))
        can_id = can_id_of(kind, rng.randrange(256), probe.host, probe.device)
        probe.send(CanFrame(can_id, rng.randbytes(rng.randrange(9))))
    probe.sleep(probe.times.quiet_s)
    probe.drain()
    probe.expect_alive()


def can_cases(unit: Unit) -> Iterator[Case[Any]]:
    """Yield the cases for a unit with a CAN link."""
    long = CanRows(unit).long
    yield from _frame_cases(unit)
    if long is not None:
        yield _segmented_reply(long)
    yield from REPLY_SEGMENTS.cases
    yield from SEGMENTS.cases
    yield from row_cases(unit)
    yield Case("recovery.noise", "recovery", "after noise the next valid request is answered", rule(9), noise)
