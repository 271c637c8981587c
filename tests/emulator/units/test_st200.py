"""A client for the ST200, written from what its flight driver does (libgs hyp_st200.c): none of our codec."""

from __future__ import annotations

import struct

import pytest

from tests.emulator.units.clients import Emulated, arcseconds_between, attitude_matrix, true_matrix, with_unit

CONFIGURATION = ("set frame-type binary standard", "set keep-alive off", "set dumping-mode polling")
BUFFER = 200
"""Bytes that the driver reads at most, up to a pause of 5 ms."""


def crc8_table() -> list[int]:
    """Return the table of the driver: remainders of polynomial 07."""
    table = []
    for byte in range(256):
        register = byte
        for _ in range(8):
            register = (register << 1 ^ 7) & 0xFF if register & 0x80 else register << 1
        table.append(register)
    assert table[:5] + table[-1:] == [0x00, 0x07, 0x0E, 0x09, 0x1C, 0xF3]
    return table


def destuff(buffer: bytes) -> bytes:
    """Return a frame without stuffing: F0 is left out, and the byte after it gets the bits F0."""
    frame, position = bytearray(buffer[:1]), 1
    while position < len(buffer):
        if buffer[position] == 0xF0:
            frame.append(0xF0 | buffer[position + 1])
            position += 1
        else:
            frame.append(buffer[position])
        position += 1
    return bytes(frame)


def is_ready(buffer: bytes) -> bool:
    """Return whether READY is found as the driver looks for it: with a byte after it."""
    return any(buffer[at : at + 5] == b"READY" for at in range(max(len(buffer) - 5, 0)))


def frame_of(buffer: bytes) -> bytes:
    """Return the frame in what was read before a pause."""
    assert 53 <= len(buffer) <= BUFFER
    start = buffer.index(0xF1)
    assert start + 53 <= len(buffer)
    frame = destuff(buffer[start:])
    register, table = 0, crc8_table()
    for byte in frame[:52]:
        register = table[register ^ byte]
    assert register == frame[52]
    return frame


def sample(unit: Emulated) -> bytes:
    return frame_of(unit.ask(b"show record\r"))


def test_the_driver_configures_the_unit_and_reads_the_true_attitude():
    def scenario(unit: Emulated) -> None:
        assert unit.ask(b"ping\r") == b""
        for command in CONFIGURATION:
            assert is_ready(unit.ask(command.encode() + b"\r")), command
        frame = sample(unit)
        assert len(frame) == 53
        assert frame[0] == 0xF1
        assert frame[2] == 0b10
        found = attitude_matrix(*struct.unpack_from(">4f", frame, 11))
        assert arcseconds_between(found, true_matrix()) < 0.1
        assert frame[51] == 35
        exposure, seconds, sub_seconds = struct.unpack_from(">HIH", frame, 3)
        assert exposure == round(float(unit.bench.device.parameters["exposure"]))
        clock_s = unit.bench.device.time.unix_ns() / 1e9
        assert 0 < clock_s - (seconds + sub_seconds / 1000) < 3

    with_unit("st200", "serial", scenario)


def test_pitch_yaw_and_roll_turn_the_axes_of_icrs_into_those_of_the_sensor():
    def scenario(unit: Emulated) -> None:
        import numpy as np

        pitch, yaw, roll = np.radians(struct.unpack_from(">3f", sample(unit), 27))
        about_z = [[np.cos(yaw), np.sin(yaw), 0], [-np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]]
        about_y = [[np.cos(pitch), 0, -np.sin(pitch)], [0, 1, 0], [np.sin(pitch), 0, np.cos(pitch)]]
        about_x = [[1, 0, 0], [0, np.cos(roll), np.sin(roll)], [0, -np.sin(roll), np.cos(roll)]]
        found = np.array(about_x) @ np.array(about_y) @ np.array(about_z)
        assert arcseconds_between(found, true_matrix()) < 0.5

    with_unit("st200", "serial", scenario)


def test_no_byte_of_the_stuffed_range_is_sent_but_the_header_and_escapes():
    def scenario(unit: Emulated) -> None:
        escapes = 0
        for _ in range(20):
            unit.turn((0.05, 0.02, -0.03))
            answer = unit.ask(b"show record\r")
            above = [byte for byte in answer if byte >= 0xF0]
            assert above[0] == 0xF1
            assert set(above[1:]) <= {0xF0}
            assert all(answer[at + 1] < 0x10 for at in range(1, len(answer)) if answer[at] == 0xF0)
            assert len(answer) == 53 + above.count(0xF0)
            frame_of(answer)
            escapes += above.count(0xF0)
        assert escapes > 5

    with_unit("st200", "serial", scenario)


def test_acquisition_is_cleared_when_the_lens_is_covered():
    def scenario(unit: Emulated) -> None:
        unit.cover()
        unit.step(3.0)
        frame = sample(unit)
        assert frame[2] == 0
        assert struct.unpack_from(">4f", frame, 11) == (0, 0, 0, 0)

    with_unit("st200", "serial", scenario)


def test_the_general_error_is_reported_in_error_mode_alone():
    def scenario(unit: Emulated) -> None:
        assert sample(unit)[2] & 0b01 == 0
        unit.bench.device.modes.fail("sensor")
        assert sample(unit)[2] & 0b01 == 1

    with_unit("st200", "serial", scenario)


@pytest.mark.parametrize(
    "command", ["show  record", "set keep-alive on", "shwo record", "SHOW RECORD", "", "\x00\xff"]
)
def test_a_damaged_command_is_not_ready_and_the_next_one_is_answered(command):
    def scenario(unit: Emulated) -> None:
        answer = unit.ask(command.encode("latin-1") + b"\r")
        if command.split() == ["show", "record"]:
            frame_of(answer)
        else:
            assert answer == b"ERROR 1\r\n"
        assert is_ready(unit.ask(b"set keep-alive off\r"))
        assert sample(unit)[2] == 0b10

    with_unit("st200", "serial", scenario)


def test_a_command_of_the_drivers_shell_ends_in_a_space():
    """The shell's `custom` puts a space after every word (hyp_st200_cmd.c)."""

    def scenario(unit: Emulated) -> None:
        assert is_ready(unit.ask(b"set keep-alive off \r"))
        frame_of(unit.ask(b"show record \r"))

    with_unit("st200", "serial", scenario)


def test_a_command_in_pieces_is_answered_and_half_a_command_forgotten():
    def scenario(unit: Emulated) -> None:
        assert unit.ask(b"show rec") == b""
        frame_of(unit.ask(b"ord\r"))
        assert unit.ask(b"show rec") == b""
        unit.step(1.0)
        frame_of(unit.ask(b"show record\r"))

    with_unit("st200", "serial", scenario)
