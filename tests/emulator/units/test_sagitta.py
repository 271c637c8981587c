"""A client for the Sagitta, written from its table: byte offsets and formulas, none of our codec."""

from __future__ import annotations

import struct
from itertools import pairwise

import pytest

from tests.emulator.units.clients import (
    Emulated,
    arcseconds_between,
    attitude_matrix,
    slip,
    true_matrix,
    unslip,
    with_unit,
    xxh32,
)

SET, GET, TELEMETRY, ACTION = 0, 1, 2, 3
SOLUTION, TEMPERATURE = 24, 27
UNIX_US = 1_800_000_000_123_456


def request(message_class: int, row: int, data: bytes = b"") -> bytes:
    body = bytes([0x21, message_class, row]) + data
    return slip(body + xxh32(body, 1425).to_bytes(4, "little"))


def replies(stream: bytes) -> list[bytes]:
    """Return the bodies without their check, which is verified."""
    bodies = unslip(stream)
    for body in bodies:
        assert body[-4:] == xxh32(body[:-4], 1425).to_bytes(4, "little")
        assert body[0] == 0x21
    return [body[:-4] for body in bodies]


def ask(unit: Emulated, message_class: int, row: int, data: bytes = b"") -> bytes:
    (reply,) = replies(unit.ask(request(message_class, row, data)))
    assert reply[1:3] == bytes([128 + message_class, row])
    return reply[3:]


def quaternion(solution: bytes, offset: int) -> tuple[float, float, float, float]:
    w, x, y, z = struct.unpack_from("<4f", solution, offset)
    return x, y, z, w


def solution(unit: Emulated) -> bytes:
    """Return the solution from the status on; offsets of the table are less by 3."""
    reply = ask(unit, TELEMETRY, SOLUTION)
    assert len(reply) + 3 + 4 == 87
    return reply


def test_attitude_is_the_truth_and_flagged_valid():
    def scenario(unit: Emulated) -> None:
        reply = solution(unit)
        assert reply[0] == 0
        for offset in (16, 36, 55):
            found = attitude_matrix(*quaternion(reply, offset - 3))
            assert arcseconds_between(found, true_matrix()) < 0.1
        confidence = struct.unpack_from("<f", reply, 32 - 3)[0]
        assert 0.9 < confidence <= 1.0
        removed, centroided, matched = reply[52 - 3 : 55 - 3]
        assert (removed, centroided, matched) == (3, 40, 35)
        assert reply[77 - 3] == 1
        assert struct.unpack_from("<I", reply, 78 - 3)[0] == unit.bench.device.frames_valid
        assert (reply[76 - 3], reply[82 - 3]) in {(1, 4), (0, 5)}

    with_unit("sagitta", "serial", scenario)


def test_validity_clears_when_the_lens_is_covered_and_the_count_of_stable_solutions_restarts():
    def scenario(unit: Emulated) -> None:
        unit.cover()
        unit.step(3.0)
        reply = solution(unit)
        assert reply[0] == 0
        assert reply[77 - 3] == 0
        assert struct.unpack_from("<I", reply, 78 - 3)[0] == 0
        unit.bench.pipeline.fail = ""
        unit.step(3.0)
        reply = solution(unit)
        assert reply[77 - 3] == 1
        assert 1 <= struct.unpack_from("<I", reply, 78 - 3)[0] < unit.bench.device.frames_valid

    with_unit("sagitta", "serial", scenario)


def test_time_that_is_set_appears_in_the_telemetry_header():
    def scenario(unit: Emulated) -> None:
        assert ask(unit, ACTION, 14, struct.pack("<Q", UNIX_US)) == b"\0"
        unit.step(2.5)
        reply = ask(unit, TELEMETRY, TEMPERATURE)
        ticks, unix_us = struct.unpack_from("<IQ", reply, 1)
        assert unix_us == UNIX_US + 2_500_000
        assert ticks == (unit.bench.clock.now_ns() - unit.bench.device.started_ns) // 1_000_000
        assert len(reply) == 1 + 12 + 12

    with_unit("sagitta", "serial", scenario)


PARAMETERS = [
    (3, bytes(range(16))),
    (5, struct.pack("<B10f", 1, *range(10))),
    (6, struct.pack("<4f", 0.5, -0.5, 0.5, -0.5)),
    (8, struct.pack("<B16f", 2, *range(16))),
    (9, struct.pack("<B3fhBB16sI", 1, 25.0, 0.125, 0.25, -7, 2, 40, bytes(range(16)), 5)),
    (10, struct.pack("<BBHHB", 1, 1, 20, 5, 1)),
    (11, struct.pack("<B12f", 1, *range(12))),
    (12, struct.pack("<I10fBBf", 3, *range(10), 9, 4, 0.25)),
    (13, struct.pack("<2f", 0.5, 0.25)),
    (14, struct.pack("<3fB", 0.5, 0.25, 0.125, 1)),
    (15, struct.pack("<B2fB", 3, 0.25, 0.5, 4)),
    (16, struct.pack("<BfBfB", 2, 0.25, 4, 0.125, 5)),
    (23, struct.pack("<BBHHf", 1, 20, 3, 200, 0.25)),
    (25, struct.pack("<2f", 0.25, 0.5)),
    (30, struct.pack("<4H", 1, 2, 3, 4)),
    (31, struct.pack("<5Q3B", 1 << 60, 2, 3, 4, 5, 6, 7, 8)),
]


@pytest.mark.parametrize(
    ("row", "data"), PARAMETERS, ids=lambda value: str(value) if isinstance(value, int) else ""
)
def test_parameter_that_is_set_is_read_back(row, data):
    def scenario(unit: Emulated) -> None:
        default = ask(unit, GET, row)
        assert len(default) == len(data)
        assert default != data
        assert ask(unit, SET, row, data) == b"\0"
        assert ask(unit, GET, row) == data
        unit.bench.device.reset("command")
        unit.step(3.0)
        assert ask(unit, GET, row) == default

    with_unit("sagitta", "serial", scenario)


def test_camera_has_the_defaults_of_the_driver():
    def scenario(unit: Emulated) -> None:
        found = struct.unpack("<B3fhBB16sI", ask(unit, GET, 9))
        assert found == (
            2,
            pytest.approx(25.2),
            pytest.approx(0.2),
            pytest.approx(0.2),
            0,
            3,
            58,
            bytes(16),
            3,
        )

    with_unit("sagitta", "serial", scenario)


def test_subscribed_telemetry_comes_with_each_frame_until_the_list_is_cleared():
    def scenario(unit: Emulated) -> None:
        wanted = bytes([SOLUTION, TEMPERATURE]) + bytes(14)
        assert ask(unit, SET, 18, wanted) == b"\0"
        assert ask(unit, GET, 18) == wanted
        found = replies(b"".join(unit.step(3.0)))
        assert [(body[1], body[2]) for body in found] == [(132, SOLUTION), (132, TEMPERATURE)] * 3
        assert all(body[77] == 1 for body in found if body[2] == SOLUTION)
        times = [struct.unpack_from("<Q", body, 8)[0] for body in found if body[2] == SOLUTION]
        assert [later - earlier for earlier, later in pairwise(times)] == [1_000_000] * 2
        assert ask(unit, SET, 18, bytes(16)) == b"\0"
        assert unit.step(3.0) == []

    with_unit("sagitta", "serial", scenario)


def test_subscription_to_unknown_telemetry_is_refused_and_the_list_stays():
    def scenario(unit: Emulated) -> None:
        assert ask(unit, SET, 18, bytes([99]) + bytes(15)) != b"\0"
        assert ask(unit, GET, 18) == bytes(16)

    with_unit("sagitta", "serial", scenario)


def test_stars_are_reported_interleaved():
    def scenario(unit: Emulated) -> None:
        matched = ask(unit, TELEMETRY, 40)[1 + 12 :]
        assert len(matched) == 321
        assert matched[0] == 35
        first, second = (struct.unpack_from("<I4f", matched, 1 + 20 * n) for n in (0, 1))
        assert (first[0], first[1], first[2]) == (32349, pytest.approx(86.0), pytest.approx(824.6))
        assert second[0] == 101772
        centroids = ask(unit, TELEMETRY, 37)[1 + 12 :]
        assert len(centroids) == 2 + 16 * 9
        assert struct.unpack_from("<Hff", centroids) == (40, pytest.approx(86.0), pytest.approx(824.6))

    with_unit("sagitta", "serial", scenario)


@pytest.mark.parametrize(
    ("row", "size"), [(11, 64), (27, 12), (28, 144), (36, 38), (37, 146), (39, 4), (40, 321), (49, 65)]
)
def test_telemetry_has_the_length_of_the_table(row, size):
    def scenario(unit: Emulated) -> None:
        assert len(ask(unit, TELEMETRY, row)) == 1 + 12 + size

    with_unit("sagitta", "serial", scenario)


def test_boot_is_accepted_and_wrong_lengths_are_refused():
    def scenario(unit: Emulated) -> None:
        assert ask(unit, ACTION, 1, b"\x01") == b"\0"
        assert ask(unit, ACTION, 14, b"\x01") != b"\0"
        assert ask(unit, SET, 99, b"\x01") != b"\0"
        assert ask(unit, TELEMETRY, 99)[0] != 0
        assert unit.ask(request(GET, 99)) == b""

    with_unit("sagitta", "serial", scenario)


def test_wrong_check_and_other_address_are_not_answered_and_the_next_request_is():
    def scenario(unit: Emulated) -> None:
        wrong = bytearray(request(TELEMETRY, SOLUTION))
        wrong[-2] ^= 1
        body = bytes([0x22, TELEMETRY, SOLUTION])
        other = slip(body + xxh32(body, 1425).to_bytes(4, "little"))
        assert unit.ask(bytes(wrong)) == b""
        assert unit.ask(other) == b""
        assert unit.ask(b"\x1f\x7f\x80\x1f\xff") == b""
        assert solution(unit)[77 - 3] == 1

    with_unit("sagitta", "serial", scenario)
