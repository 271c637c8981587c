"""What the driver of cosmos-core sends to an ST-16 and how it takes the replies: its table of commands and its result structure.

`test_st16_text` has a client by the vendor's text.
"""

from __future__ import annotations

import math
import struct

import pytest

from tests.emulator.units.clients import (
    Emulated,
    arcseconds_between,
    attitude_matrix,
    crc16,
    slip,
    true_matrix,
    unslip,
    with_unit,
)

HOST, TRACKER = 0x11, 0x0E
ACK, FINAL = 0x20, 0x80
INIT, READ_EDAC, GO, READ_RESULT, COMBINATION = 0x01, 0x09, 0x0B, 0x0D, 0x12
SUCCESS = 0x04
PARTS = (
    (0x00, 4), (0x04, 4), (0x08, 32), (0x28, 24), (0x40, 8), (0x48, 56), (0x80, 172),
    (0x130, 784), (0x440, 104), (0x4A8, 832), (0x7E8, 352),
)  # fmt: skip
RESULT_SIZE = 0x948
SELF_TEST_SIZE = 652


def message(command: int, data: bytes = b"") -> bytes:
    body = bytes([TRACKER, HOST, command | FINAL]) + data
    return slip(body + struct.pack("<H", crc16(body)))


def replies(unit: Emulated, command: int, data: bytes = b"") -> list[tuple[int, bytes]]:
    """Return control field and data of each reply; address and CRC are verified."""
    frames = []
    for body in unslip(unit.ask(message(command, data))):
        assert struct.unpack("<H", body[-2:])[0] == crc16(body[:-2])
        assert body[:2] == bytes([HOST, TRACKER])
        assert body[2] & 0x1F == command
        frames.append((body[2], body[3:-2]))
    return frames


def answer(unit: Emulated, command: int, data: bytes = b"") -> bytes:
    ((control, content),) = replies(unit, command, data)
    assert control & (ACK | FINAL) == ACK | FINAL
    return content


def combination(unit: Emulated, parts: int, code: int = 0x0B) -> bytes:
    """Put the messages together where their first two bytes say, as the driver does."""
    frames = replies(unit, COMBINATION, struct.pack("<BI", code, parts)[:4])
    assert [bool(control & FINAL) for control, _ in frames] == [False] * (len(frames) - 1) + [True]
    result = bytearray(RESULT_SIZE)
    end = 0
    for control, content in frames:
        assert control & ACK
        offset = struct.unpack_from("<H", content)[0]
        end = offset + len(content) - 2
        result[offset:end] = content[2:]
    return bytes(result[:end])


def test_init_and_ping_are_answered_as_a_driver_connects():
    def scenario(unit: Emulated) -> None:
        assert answer(unit, INIT, struct.pack("<I", 0x2000)) == b""
        assert answer(unit, 0).startswith(b"starhil")

    with_unit("st16", "serial", scenario)


def test_combination_has_the_true_attitude_sequence_rate_and_epoch():
    def scenario(unit: Emulated) -> None:
        result = combination(unit, 0x7F)
        assert struct.unpack_from("<I", result, 0)[0] == unit.bench.device.cycle.published
        assert struct.unpack_from("<I", result, 4)[0] & SUCCESS
        # COSMOS's quaternion is x, y, z, w: by the text, which wins, the first of the four is the scalar part
        w, x, y, z = struct.unpack_from("<4d", result, 8)
        assert arcseconds_between(attitude_matrix(x, y, z, w), true_matrix()) < 0.01
        assert struct.unpack_from("<3d", result, 0x28) == pytest.approx((0, 0, 0), abs=1e-9)
        assert struct.unpack_from("<d", result, 0x40)[0] == pytest.approx(
            (unit.bench.device.snapshot().frame.mid_ns - unit.bench.device.started_ns) / 1e9, abs=1e-6
        )

    with_unit("st16", "serial", scenario)


@pytest.mark.parametrize("parts", [1, 4, 0x14, 0x7F, 0x40, 0x80, 0x100, 0x200, 0x400, 0x7FF])
def test_combination_has_the_parts_in_a_row(parts):
    def scenario(unit: Emulated) -> None:
        whole = answer_in_parts(unit, READ_RESULT, struct.pack("<HH", 0, RESULT_SIZE))
        wanted = [whole[start : start + size] for bit, (start, size) in enumerate(PARTS) if parts >> bit & 1]
        assert combination(unit, parts) == b"".join(wanted)

    with_unit("st16", "serial", scenario)


def answer_in_parts(unit: Emulated, command: int, data: bytes) -> bytes:
    found = replies(unit, command, data)
    assert all(control & ACK for control, _ in found)
    return b"".join(content[2:] for _, content in found)


def test_parts_of_the_driver_s_structures_have_what_was_seen():
    def scenario(unit: Emulated) -> None:
        snapshot = unit.bench.device.snapshot()
        stars, frame = snapshot.stars, snapshot.frame
        first = stars[0]
        for image in (combination(unit, 0x80)[:392], combination(unit, 0x80)[392:]):
            flag, code, _, peaks, _, captured = struct.unpack_from("<IiiI2d", image)
            assert (flag, code, peaks) == (1, 0, min(len(stars), 30))
            assert captured == pytest.approx((frame.mid_ns - unit.bench.device.started_ns) / 1e9)
            assert struct.unpack_from("<2i", image, 32) == (round(first.x), round(first.y))
        flag, code, *mapping = struct.unpack_from("<Ii10i", combination(unit, 0x100))
        assert (flag, code, mapping[0]) == (1, 0, first.hip)
        centroids = combination(unit, 0x200)[:416]
        assert struct.unpack_from("<Iii", centroids) == (1, 0, frame.result.matched)
        assert struct.unpack_from("<2d", centroids, 16) == pytest.approx((first.x, first.y))
        assert struct.unpack_from("<3d", centroids, 16 + 160) == pytest.approx(first.vector)
        assert struct.unpack_from("<i", combination(unit, 0x400), 0x38) == (first.hip,)

    with_unit("st16", "serial", scenario)


def test_self_test_has_a_result_of_its_own():
    def scenario(unit: Emulated) -> None:
        assert len(combination(unit, 0x800, code=0x1B)) == SELF_TEST_SIZE
        assert answer(unit, READ_EDAC, struct.pack("<HB", 0x4C, 4))[2:] == struct.pack("<I", SELF_TEST_SIZE)
        assert struct.unpack_from("<ff", combination(unit, 0x800, code=0x1B)) == pytest.approx((0.1, 5.0))
        for code, parts in ((0x0B, 0x800), (0x1B, 0x7F)):
            ((control, _),) = replies(unit, COMBINATION, struct.pack("<BI", code, parts)[:4])
            assert not control & ACK

    with_unit("st16", "serial", scenario)


def test_rate_is_the_true_one_in_radians_a_second():
    def scenario(unit: Emulated) -> None:
        unit.turn((0.5, -0.25, 0.125))
        found = struct.unpack("<3d", combination(unit, 0x08))
        assert found == pytest.approx([math.radians(rate) for rate in (0.5, -0.25, 0.125)], rel=1e-3)

    with_unit("st16", "serial", scenario)


def test_return_code_is_not_success_when_the_lens_is_covered():
    def scenario(unit: Emulated) -> None:
        unit.cover()
        unit.step(3.0)
        assert not struct.unpack("<I", combination(unit, 0x02))[0] & SUCCESS

    with_unit("st16", "serial", scenario)


def test_result_is_read_by_address():
    def scenario(unit: Emulated) -> None:
        content = answer(unit, READ_RESULT, struct.pack("<HH", 8, 32))
        assert struct.unpack_from("<H", content)[0] == 8
        assert content[2:] == combination(unit, 0x7F)[8:40]
        assert answer_in_parts(unit, READ_RESULT, struct.pack("<HH", 0, 300)) == combination(unit, 0x7F)

    with_unit("st16", "serial", scenario)


def test_memory_has_the_length_of_the_result_and_eight_analog_values():
    def scenario(unit: Emulated) -> None:
        length = struct.pack("<HB", 0x4C, 4)
        assert answer(unit, READ_EDAC, length) == struct.pack("<HI", 0x4C, 0)
        assert answer(unit, GO, b"\x0b") == b"\x0b"
        assert answer(unit, READ_EDAC, length) == struct.pack("<HI", 0x4C, 0)
        unit.step(2.0)  # the sequence has a result
        assert answer(unit, READ_EDAC, length) == struct.pack("<HI", 0x4C, RESULT_SIZE)
        assert answer(unit, INIT, struct.pack("<I", 0x2000)) == b""
        assert answer(unit, READ_EDAC, length) == struct.pack("<HI", 0x4C, 0)
        assert len(answer(unit, READ_EDAC, struct.pack("<HB", 0x04, 32))) == 34

    with_unit("st16", "serial", scenario)


@pytest.mark.parametrize(
    ("command", "data"),
    [
        (READ_EDAC, struct.pack("<HB", 0x1FE, 4)),
        (READ_RESULT, struct.pack("<HH", 0x940, 60)),
        (INIT, b"\0"),
        (0x1F, b""),
    ],
)
def test_refusal_has_no_ack(command, data):
    def scenario(unit: Emulated) -> None:
        ((control, content),) = replies(unit, command, data)
        assert control & (ACK | FINAL) == FINAL
        assert content == b""

    with_unit("st16", "serial", scenario)


def test_message_with_a_wrong_crc_is_not_answered():
    def scenario(unit: Emulated) -> None:
        wrong = bytearray(message(0))
        wrong[-2] ^= 4
        assert unit.ask(bytes(wrong)) == b""
        assert answer(unit, 0).startswith(b"starhil")

    with_unit("st16", "serial", scenario)
