"""A client for a CubeComputer of generation 2, written from the public tables: bits and bytes of CAN frames and of UART."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from tests.emulator.units.clients import Emulated, true_matrix, with_unit

OBC, ADCS = 1, 4
TELECOMMAND, ACK, NACK, REQUEST, TELEMETRY, REQUEST_NACK, EXTENDED_TELECOMMAND, EXTENDED = (
    1,
    2,
    3,
    4,
    5,
    6,
    7,
    8,
)


def can_id(kind: int, identifier: int, source: int, destination: int) -> int:
    return kind << 24 | identifier << 16 | source << 8 | destination


def read(unit: Emulated, identifier: int) -> bytes:
    """Request telemetry over CAN; put segments with a counter that counts down to 0 together."""
    frames = unit.ask_can(can_id(REQUEST, identifier, OBC, ADCS))
    kinds = {frame.id for frame in frames}
    if kinds == {can_id(TELEMETRY, identifier, ADCS, OBC)}:
        return frames[0].data
    assert kinds == {can_id(EXTENDED, identifier, ADCS, OBC)}
    assert [frame.data[-1] for frame in frames] == list(range(len(frames) - 1, -1, -1))
    return b"".join(frame.data[:-1] for frame in frames)


def command(unit: Emulated, identifier: int, data: bytes) -> int:
    """Send a telecommand over CAN; return its error code."""
    if len(data) <= 8:
        frames = unit.ask_can(can_id(TELECOMMAND, identifier, OBC, ADCS), data)
    else:
        chunks = [data[at : at + 7] for at in range(0, len(data), 7)]
        for left, chunk in zip(range(len(chunks) - 1, -1, -1), chunks, strict=True):
            frames = unit.ask_can(can_id(EXTENDED_TELECOMMAND, identifier, OBC, ADCS), chunk + bytes([left]))
    (answer,) = frames
    if answer.id == can_id(ACK, identifier, ADCS, OBC):
        return 0
    assert answer.id == can_id(NACK, identifier, ADCS, OBC)
    return answer.data[0]


def bits(data: bytes, offset: int, length: int) -> int:
    """Return a bit field as the public tables give it: offset from the lowest bit of the first byte."""
    return int.from_bytes(data, "little") >> offset & ((1 << length) - 1)


def test_raw_cubestar_has_stages_stars_and_time():
    def scenario(unit: Emulated) -> None:
        assert command(unit, 2, struct.pack("<II", 1_800_000_000, 250_000_000)) == 0
        unit.step(2.0)
        data = read(unit, 160)
        assert len(data) == 28
        seconds, nanoseconds = struct.unpack_from("<II", data)
        assert seconds + nanoseconds / 1e9 == pytest.approx(
            unit.bench.device.snapshot().frame.mid_unix_ns / 1e9, abs=1e-9
        )
        assert [bits(data, at, 4) for at in (64, 68, 72)] == [3, 4, 7]
        assert [bits(data, at, 1) for at in (76, 78, 79)] == [0, 1, 0]
        assert bits(data, 77, 1) == (unit.bench.mode == "tracking")
        assert (data[10], data[11]) == (40, 35)
        assert struct.unpack_from("<3h", data, 12) == (0, 0, 0)
        assert data[18:] == bytes(10)

    with_unit("cubestar-gen2", "can", scenario)


def test_valid_flag_and_stages_follow_a_covered_lens():
    def scenario(unit: Emulated) -> None:
        unit.cover()
        unit.step(3.0)
        data = read(unit, 160)
        assert bits(data, 72, 4) == 5
        assert bits(data, 78, 1) == 0
        assert bits(read(unit, 208), 640, 1) == 0

    with_unit("cubestar-gen2", "can", scenario)


def test_rates_are_in_units_of_a_ten_thousandth_of_a_degree_a_second():
    def scenario(unit: Emulated) -> None:
        unit.turn((0.5, -0.25, 0.125))
        assert struct.unpack_from("<3h", read(unit, 160), 12) == pytest.approx((5000, -2500, 1250), abs=2)

    with_unit("cubestar-gen2", "can", scenario)


def test_calibrated_vectors_agree_through_the_true_attitude():
    def scenario(unit: Emulated) -> None:
        data = read(unit, 208)
        assert len(data) == 81
        body = np.array(struct.unpack_from("<9h", data, 8)).reshape(3, 3) / 1e4
        orbit = np.array(struct.unpack_from("<9h", data, 26)).reshape(3, 3) / 1e4
        assert np.linalg.norm(body, axis=1) == pytest.approx(1.0, abs=2e-4)
        assert orbit @ true_matrix().T == pytest.approx(body, abs=3e-4)
        assert bits(data, 640, 2) == 1

    with_unit("cubestar-gen2", "can", scenario)


def test_clock_that_is_set_is_read_back():
    def scenario(unit: Emulated) -> None:
        assert command(unit, 2, struct.pack("<II", 1_700_000_000, 123_456_789)) == 0
        assert struct.unpack("<II", read(unit, 133)) == (1_700_000_000, 123_456_789)

    with_unit("cubestar-gen2", "can", scenario)


def test_unsolicited_set_up_is_read_back():
    def scenario(unit: Emulated) -> None:
        setup = bytes([0x21, 0x03]) + bytes(range(15))
        assert read(unit, 228) == bytes(17)
        assert command(unit, 112, setup) == 0
        assert read(unit, 228) == setup

    with_unit("cubestar-gen2", "can", scenario)


@pytest.mark.parametrize(
    ("identifier", "size"), [(128, 8), (133, 8), (135, 32), (137, 3), (138, 4), (165, 34)]
)
def test_telemetry_has_the_length_of_the_table(identifier, size):
    def scenario(unit: Emulated) -> None:
        assert len(read(unit, identifier)) == size

    with_unit("cubestar-gen2", "can", scenario)


def test_identification_boot_and_acknowledge():
    def scenario(unit: Emulated) -> None:
        data = read(unit, 128)
        assert (bits(data, 0, 4), bits(data, 4, 4)) == (1, 1)
        assert read(unit, 137)[:2] == bytes([3, 3])
        assert command(unit, 2, bytes(3)) == 2
        assert read(unit, 138)[:2] == bytes([2, 2])

    with_unit("cubestar-gen2", "can", scenario)


def test_unknown_identifiers_are_refused():
    def scenario(unit: Emulated) -> None:
        assert command(unit, 98, b"") == 1
        (frame,) = unit.ask_can(can_id(REQUEST, 250, OBC, ADCS))
        assert (frame.id, frame.data) == (can_id(REQUEST_NACK, 250, ADCS, OBC), b"\x01")

    with_unit("cubestar-gen2", "can", scenario)


def test_uart_answers_with_the_start_bytes_of_generation_2():
    def scenario(unit: Emulated) -> None:
        sent = b"\x1f\x7f\x85\x1f\xff"
        reply = unit.ask(sent)
        assert reply[:3] == b"\x1f\x07\x85"
        assert reply[-2:] == b"\x1f\xff"
        assert unit.ask(b"\x1f\x7f\xfa\x1f\xff") == b"\x1f\x0f\xfa\x01\x1f\xff"
        assert unit.ask(b"\x1f\x7f\x02" + bytes(8) + b"\x1f\xff") == b"\x1f\x07\x02\x1f\xff"

    with_unit("cubestar-gen2", "serial", scenario)
