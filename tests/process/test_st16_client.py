"""A client of a running `st16` that holds nothing but the vendor's text, byte by byte: it reads the attitude of the sky.

The numbers in comments are pages of the text's public copy, doclecture.net/1-35909 to 1-35922. The GO code and the parts of the
combination are those of a published test procedure, COMBINATION 00001E2Fh (`st16_lissa`); the layout of the parts is that of
hsfl/cosmos-core, `sinclair_lib.h`, because the pages with it are not in the copy.
"""

from __future__ import annotations

import math
import os
import select
import struct
import time
import tty

import numpy as np
import pytest

from starhil.hil_tests.rig.emulator_process import EmulatorProcess, emulator_command
from tests.process.conftest import NO_IMAGES
from tests.waiting import PATIENCE_S

pytestmark = pytest.mark.process

RA_DEG, DEC_DEG, ROLL_DEG = 201.3, -43.0, 77.0
PROCEDURE = bytes.fromhex("2F 1E 00 00")
"""GO code 2Fh; return code, attitude, rate and epoch."""
VALID = 0x04
ARCMIN = math.radians(1.0) / 60.0
"""Errors of a tracker are arc seconds; another order of the components, another direction or frame is degrees off."""


def crc(body: bytes) -> bytes:
    """x¹⁶ + x¹² + x⁵ + 1, lowest bit first, from FFFFh (35910)."""
    register = 0xFFFF
    for byte in body:
        register ^= byte
        for _ in range(8):
            register = register >> 1 ^ 0x8408 * (register & 1)
    return struct.pack("<H", register)


def message(control: int, data: bytes = b"") -> bytes:
    """A command between FEND characters: addresses, control field, data and CRC (35910), with the two escapes."""
    body = bytes((0x0E, 0x11, control)) + data
    body += crc(body)
    return b"\xc0" + body.replace(b"\xdb", b"\xdb\xdd").replace(b"\xc0", b"\xdb\xdc") + b"\xc0"


def reply(port: int, command: bytes) -> tuple[int, bytes]:
    """Poll; return control field and data of a reply of one message."""
    os.write(port, command)
    line, end = b"", time.monotonic() + PATIENCE_S
    while line.count(b"\xc0") < 2 and time.monotonic() < end:
        if select.select([port], [], [], 0.1)[0]:
            line += os.read(port, 4096)
    body = line.strip(b"\xc0").replace(b"\xdb\xdc", b"\xc0").replace(b"\xdb\xdd", b"\xdb")
    assert body[:2] == b"\x11\x0e", line.hex(" ")
    assert crc(body[:-2]) == body[-2:]
    return body[2], body[3:-2]


def rotation(scalar_first: tuple[float, ...]) -> np.ndarray:
    """The rotation from J2000 to the sensor (35922), as in Shuster, whom the text cites."""
    w, *vector = scalar_first
    x, y, z = vector
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return (w * w - np.dot(vector, vector)) * np.eye(3) + 2 * np.outer(vector, vector) - 2 * w * cross


def sky() -> np.ndarray:
    """The sensor's axes in J2000: +z the outward boresight; +x, here to the right in the image, turned by the roll."""
    ra, dec, roll = np.radians((RA_DEG, DEC_DEG, ROLL_DEG))
    boresight = np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
    north = np.array([-np.sin(dec) * np.cos(ra), -np.sin(dec) * np.sin(ra), np.cos(dec)])
    east = np.array([-np.sin(ra), np.cos(ra), 0.0])
    x = -np.sin(roll) * north - np.cos(roll) * east
    return np.array([x, np.cross(boresight, x), boresight])


def test_a_client_by_the_text_reads_the_attitude_of_a_running_emulator(tmp_path):
    truth = f"truth.attitude={{ ra_deg = {RA_DEG}, dec_deg = {DEC_DEG}, roll_deg = {ROLL_DEG} }}"
    command = emulator_command(
        profile="ideal", unit="st16", seed=1, settings=[*NO_IMAGES, truth], state_dir=tmp_path
    )
    with EmulatorProcess(command) as process:
        port = os.open(process.ready["serial"], os.O_RDWR | os.O_NOCTTY)
        try:
            tty.setraw(port)
            assert reply(port, message(0x80))[0] == 0xA0  # PING: final, acknowledged (35910)
            end, code = time.monotonic() + PATIENCE_S, 0
            while not code & VALID and time.monotonic() < end:
                time.sleep(0.2)
                control, data = reply(port, message(0x80 | 0x12, PROCEDURE))
                if control & 0x20:  # acknowledged: there is a result (35918)
                    sent_before, code, *numbers = struct.unpack("<HI4d3dd", data)
                    assert sent_before == 0
        finally:
            os.close(port)
    assert code & VALID
    attitude = rotation(tuple(numbers[:4]))
    assert np.max(np.linalg.norm(attitude - sky(), axis=1)) < ARCMIN
    assert np.linalg.norm(numbers[4:7]) < ARCMIN  # rad/s, of a sky at rest


def test_other_orders_and_directions_of_that_quaternion_are_degrees_off():
    matrix = sky()
    w = math.sqrt(1.0 + np.trace(matrix)) / 2.0
    x, y, z = (matrix[1, 2] - matrix[2, 1], matrix[2, 0] - matrix[0, 2], matrix[0, 1] - matrix[1, 0])
    right = np.array([w, x / (4 * w), y / (4 * w), z / (4 * w)])
    assert np.allclose(rotation(tuple(right)), matrix)
    for wrong in (np.roll(right, -1), right * (1, -1, -1, -1), right[::-1]):
        assert np.max(np.linalg.norm(rotation(tuple(wrong)) - matrix, axis=1)) > 60.0 * ARCMIN
