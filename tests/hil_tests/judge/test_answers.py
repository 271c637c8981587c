"""What the judge takes for an answer, and what not; and the values that it makes up and finds wrong."""

from __future__ import annotations

import random
from dataclasses import replace

import pytest

from starhil.hil_tests.judge import can
from starhil.hil_tests.judge.definition import read_unit
from starhil.hil_tests.judge.messages import Answer
from starhil.hil_tests.judge.serial import SerialLine
from starhil.protocol.can.frame import CanFrame
from starhil.protocol.files.bundled import bundled_units

CUBESTAR = read_unit("cubestar")
PACKET = bytes(range(22))
START_A, START_TELEMETRY, START_NACK, START_UNSOLICITED = b"\x1f\x7f", b"\x1f\x07", b"\x1f\x0f", b"\x1f\x10"
END = b"\x1f\xff"


@pytest.mark.parametrize(
    ("answer", "text"),
    [
        (Answer("nack", 3, row_id=5), "refusal of 5 with code 3"),
        (Answer("nack", 3, row_id=5, message_class="set"), "refusal of set 5 with code 3"),
        (Answer("telemetry", data=b"\1\2"), "telemetry, 2 bytes: 01 02"),
        (Answer("burst", data=bytes(30), row_id=119), f"burst of 119, 30 bytes: {bytes(24).hex(' ')}"),
        (Answer("malformed", data=b"\xff"), "malformed, 1 bytes: ff"),
        (Answer("ack", row_id=5), "acknowledge of 5"),
        (Answer("none"), "nothing"),
    ],
)
def test_an_answer_is_described_in_one_line(answer, text):
    assert str(answer) == text


# -- CAN ---------------------------------------------------------------------------------------------------------------


def frame(kind, row_id, data=b""):
    return CanFrame(kind << 24 | row_id << 16 | 0x0401, data)


ON_CAN = {
    "acknowledge": ([frame(2, 5)], Answer("ack", row_id=5, other=1)),
    "acknowledge with data": ([frame(2, 5, b"1")], "malformed"),
    "telemetry": ([frame(5, 200, b"1")], Answer("telemetry", data=b"1", row_id=200, other=1)),
    "telemetry of a telecommand": ([frame(5, 5, b"1")], "malformed"),
    "packet": ([frame(8, 119, b"1234567\1"), frame(8, 119, b"89\0")], Answer("burst", data=b"123456789", row_id=119, other=1)),
    "segments of a telecommand": ([frame(8, 5, b"1234567\0")], "malformed"),
    "one segment": ([frame(8, 200, b"1234567\0")], "malformed"),
    "segment without a counter": ([frame(8, 200)], "malformed"),
    "short segment before the last": ([frame(8, 200, b"12345\1"), frame(8, 200, b"89\0")], "malformed"),
    "no last segment": ([frame(8, 200, b"1234567\1")], "malformed"),
    "segment of another row": ([frame(8, 200, b"1234567\1"), frame(8, 201, b"1\0")], "malformed"),
    "refusal of telemetry as of a telecommand": ([frame(3, 200, b"\3")], "malformed"),
    "refusal without a code": ([frame(6, 200, b"\0")], "malformed"),
}  # fmt: skip


@pytest.mark.parametrize("name", ON_CAN)
def test_frames_are_an_answer_or_malformed(name):
    frames, expected = ON_CAN[name]
    following = iter([*frames[1:], None])
    answer = can.read_answer(frames[0], lambda: next(following))
    assert answer == expected or answer.kind == expected


def test_unsolicited_messages_are_joined_and_one_without_its_end_is_left_out():
    first, body, last = (
        frame(kind, 200, data) for kind, data in ((10, b"1234567\2"), (11, b"890abcd\1"), (12, b"ef\0"))
    )
    found = can.unsolicited([first, body, last, frame(9, 3), frame(12, 201, b"xy"), first])
    assert [(answer.row_id, answer.data) for answer in found] == [(200, b"1234567890abcdef"), (201, b"xy")]


# -- the dialects of the serial line -------------------------------------------------------------------------------------

TELECOMMAND = CUBESTAR.telecommands["clear_counters"]
ON_SERIAL = {
    ("b", "packet"): (START_A + bytes((119,)) + PACKET + END, Answer("burst", data=PACKET, row_id=119)),
    ("b", "no request"): (START_A + b"\0" + END, "malformed"),
    ("a", "empty"): (START_A + END, "malformed"),
    ("c", "empty"): (START_TELEMETRY + END, "malformed"),
    ("c", "acknowledge with data"): (START_TELEMETRY + b"\5\1" + END, "malformed"),
    ("c", "telemetry"): (START_TELEMETRY + b"\xc8ab" + END, Answer("telemetry", data=b"ab", row_id=200)),
    ("c", "refusal of two bytes"): (START_NACK + b"\5\1\1" + END, "malformed"),
}  # fmt: skip


@pytest.mark.parametrize(("dialect", "name"), ON_SERIAL)
def test_bytes_are_an_answer_in_their_dialect_or_malformed(dialect, name):
    sent, expected = ON_SERIAL[dialect, name]
    (answer,) = SerialLine(CUBESTAR, dialect).feed(sent)
    if isinstance(expected, str):
        assert answer.kind == expected
    else:
        assert (answer.kind, answer.data, answer.row_id) == (expected.kind, expected.data, expected.row_id)


# -- values ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", bundled_units())
def test_values_made_up_of_special_bytes_or_at_random_are_within_the_limits(name):
    rng = random.Random(7)
    for row in read_unit(name).rows:
        for turn in range(4):
            values = {
                key: item.any_value(b"\x1f\xff\xc0", turn, rng)
                for key, item in row.named.items()
                if item.const is None
            }
            data = row.encode(values)
            assert list(row.faults(data)) == [], (row, turn, values)


def test_what_no_row_can_hold_is_an_error():
    row = CUBESTAR.telemetry["quaternion"]
    with pytest.raises(LookupError, match="quaternion has no field q_v"):
        row.encode({"q_v": 1.0})
    with pytest.raises(ValueError, match="quaternion: 5 bytes, must be 6"):
        row.decode(bytes(5))
    with pytest.raises(TypeError, match="q_x: bytes are not a number"):
        row.named["q_x"].raw_of(b"1")


def test_values_outside_their_limits_and_unused_bits_are_named():
    mode = CUBESTAR.telecommands["set_mode"]
    assert list(mode.faults(b"\x63")) == ["set_mode.mode: 99, not in its enumeration"]
    reset = CUBESTAR.telecommands["reset"]
    assert list(reset.faults(b"\0")) == ["reset.magic: 0, outside 90 to 90"]
    rows = [
        row
        for unit in bundled_units()
        for row in read_unit(unit).rows
        if any(item.kind == "unused" for item in row.fields)
    ]
    row = rows[0]
    data = bytearray(row.encode())
    unused = next(item for item in row.fields if item.kind == "unused")
    data[unused.offset : unused.offset + unused.size] = b"\xff" * unused.size
    assert any("unused" in fault and "zeros expected" in fault for fault in row.faults(bytes(data)))


@pytest.mark.parametrize(
    ("errors", "error", "code"),
    [({}, "busy", 6), ({"busy": 40}, "busy", 40), ({"other": 7}, "busy", 7), ({"ok": 0}, "busy", 6)],
)
def test_an_error_has_the_number_of_the_unit_or_the_published_one(errors, error, code):
    assert replace(CUBESTAR, errors=errors).code(error) == code
