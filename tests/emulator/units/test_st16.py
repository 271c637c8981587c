"""A client for the ST-16, written from its table of NSP commands and its result structure."""

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
PARTS = ((0x00, 4), (0x04, 4), (0x08, 32), (0x28, 24), (0x40, 8), (0x48, 56), (0x80, 172))


def message(command: int, data: bytes = b"") -> bytes:
    body = bytes([TRACKER, HOST, command | FINAL]) + data
    return slip(body + struct.pack("<H", crc16(body)))


def replies(unit: Emulated, command: int, data: bytes = b"") -> list[tuple[int, bytes]]:
    """Return control field and data of each reply; address and CRC are verified."""
    found = []
    for body in unslip(unit.ask(message(command, data))):
        assert struct.unpack("<H", body[-2:])[0] == crc16(body[:-2])
        assert body[:2] == bytes([HOST, TRACKER])
        assert body[2] & 0x1F == command
        found.append((body[2], body[3:-2]))
    return found


def answer(unit: Emulated, command: int, data: bytes = b"") -> bytes:
    ((control, content),) = replies(unit, command, data)
    assert control & (ACK | FINAL) == ACK | FINAL
    return content


def combination(unit: Emulated, parts: int) -> bytes:
    """Put the frames together by their offsets, as a driver does."""
    frames = replies(unit, COMBINATION, struct.pack("<BI", 0x0B, parts)[:4])
    assert [bool(control & FINAL) for control, _ in frames] == [False] * (len(frames) - 1) + [True]
    result = bytearray(300)
    for control, content in frames:
        assert control & ACK
        offset = struct.unpack_from("<H", content)[0]
        result[offset : offset + len(content) - 2] = content[2:]
    return bytes(result)


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
        assert (
            arcseconds_between(attitude_matrix(*struct.unpack_from("<4d", result, 8)), true_matrix()) < 0.01
        )
        assert struct.unpack_from("<3d", result, 0x28) == pytest.approx((0, 0, 0), abs=1e-9)
        assert struct.unpack_from("<d", result, 0x40)[0] == pytest.approx(
            unit.bench.device.snapshot().frame.mid_unix_ns / 1e9, abs=1e-6
        )

    with_unit("st16", "serial", scenario)


@pytest.mark.parametrize("parts", [1, 4, 0x14, 0x7F, 0x40])
def test_combination_has_a_frame_for_each_part(parts):
    def scenario(unit: Emulated) -> None:
        frames = replies(unit, COMBINATION, struct.pack("<BI", 0, parts)[:4])
        wanted = [part for bit, part in enumerate(PARTS) if parts >> bit & 1]
        assert [(struct.unpack_from("<H", data)[0], len(data) - 2) for _, data in frames] == wanted

    with_unit("st16", "serial", scenario)


def test_rate_is_the_true_one_in_radians_a_second():
    def scenario(unit: Emulated) -> None:
        unit.turn((0.5, -0.25, 0.125))
        found = struct.unpack_from("<3d", combination(unit, 0x08), 0x28)
        assert found == pytest.approx([math.radians(rate) for rate in (0.5, -0.25, 0.125)], rel=1e-3)

    with_unit("st16", "serial", scenario)


def test_return_code_is_not_success_when_the_lens_is_covered():
    def scenario(unit: Emulated) -> None:
        unit.cover()
        unit.step(3.0)
        assert not struct.unpack_from("<I", combination(unit, 0x02), 4)[0] & SUCCESS

    with_unit("st16", "serial", scenario)


def test_result_is_read_by_address():
    def scenario(unit: Emulated) -> None:
        content = answer(unit, READ_RESULT, struct.pack("<HH", 8, 32))
        assert struct.unpack_from("<H", content)[0] == 8
        assert content[2:] == combination(unit, 0x7F)[8:40]
        frames = replies(unit, READ_RESULT, struct.pack("<HH", 0, 300))
        assert b"".join(data[2:] for _, data in frames) == combination(unit, 0x7F)
        assert len(frames) == 2

    with_unit("st16", "serial", scenario)


def test_memory_has_the_length_of_the_result_and_eight_analog_values():
    def scenario(unit: Emulated) -> None:
        assert answer(unit, READ_EDAC, struct.pack("<HB", 0x4C, 4)) == struct.pack("<HI", 0x4C, 300)
        assert len(answer(unit, READ_EDAC, struct.pack("<HB", 0x04, 32))) == 34
        assert answer(unit, GO, b"\x0b") == b"\x0b"

    with_unit("st16", "serial", scenario)


@pytest.mark.parametrize(
    ("command", "data"),
    [
        (READ_EDAC, struct.pack("<HB", 0x60, 4)),
        (READ_RESULT, struct.pack("<HH", 290, 60)),
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
