"""A client of the ST-16 written from the public copy of its interface document alone, doclecture.net 1-35909 to 1-35922.

A number in a test's comment is that of the page. What the pages do not give (addresses in EDAC memory, offsets in the result)
is taken from no other source here, unless a comment names it.
"""

from __future__ import annotations

import struct

import numpy as np
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

OBC, TRACKER = 0x11, 0x0E
POLL = FINAL = 0x80
B, ACK = 0x40, 0x20
PING, READ_FILE, WRITE_FILE, READ_EDAC, WRITE_EDAC = 0x00, 0x07, 0x08, 0x09, 0x0A
GO, READ_RESULT, IMAGE, COMBINATION, TIME = 0x0B, 0x0D, 0x10, 0x12, 0x13
ATTITUDE, RATE, RATE_AND_EPOCH = 0x04, 0x08, 0x18
"""Parts of a combination; the bits are those of the driver, sinclair_lib.h."""
ON = 0x0B


def sent(control: int, data: bytes = b"") -> bytes:
    """Return a command as it stands on the line (35910)."""
    body = bytes((TRACKER, OBC, control)) + data
    return slip(body + struct.pack("<H", crc16(body)))


def messages(line: bytes) -> list[tuple[int, bytes]]:
    """Return control field and data of each message, whose addresses and CRC must be right."""
    lines = []
    for body in unslip(line):
        assert body[:2] == bytes((OBC, TRACKER))
        assert struct.unpack("<H", body[-2:])[0] == crc16(body[:-2])
        lines.append((body[2], body[3:-2]))
    return lines


def asked(unit: Emulated, code: int, data: bytes = b"") -> bytes:
    """Poll; return the data of a reply of one message, which must be acknowledged."""
    ((control, content),) = messages(unit.ask(sent(code | POLL, data)))
    assert control == code | FINAL | ACK
    return content


def combined(unit: Emulated, go: int, parts: int) -> bytes:
    """Return the parts of a combination in a row; each message begins with the count of bytes sent before it (35918)."""
    whole = b""
    found = messages(unit.ask(sent(COMBINATION | POLL, struct.pack("<I", go | parts << 8))))
    for number, (control, data) in enumerate(found, 1):
        last = number == len(found)
        assert control == COMBINATION | ACK | (FINAL if last else 0)
        assert struct.unpack_from("<H", data)[0] == len(whole)
        whole += data[2:]
    return whole


def sensor_matrix(scalar_first: tuple[float, ...]) -> np.ndarray:
    """Return the rotation from J2000 to the sensor (35922)."""
    w, x, y, z = scalar_first
    return attitude_matrix(x, y, z, w)


def test_the_attitude_is_right():  # 35922: the scalar part is the first element
    def scenario(unit: Emulated) -> None:
        quaternion = struct.unpack("<4d", combined(unit, ON, ATTITUDE))
        assert arcseconds_between(sensor_matrix(quaternion), true_matrix()) < 0.01

    with_unit("st16", "serial", scenario)


def test_a_command_without_poll_is_executed_and_not_answered():  # 35910
    def scenario(unit: Emulated) -> None:
        assert unit.ask(sent(WRITE_EDAC, struct.pack("<H", 0x180) + b"\x01\x02\x03")) == b""
        assert asked(unit, READ_EDAC, struct.pack("<HB", 0x180, 3))[2:] == b"\x01\x02\x03"

    with_unit("st16", "serial", scenario)


def test_a_refusal_is_not_sent_without_poll_either():  # 35910
    def scenario(unit: Emulated) -> None:
        assert unit.ask(sent(0x1F)) == b""
        ((control, _),) = messages(unit.ask(sent(0x1F | POLL)))
        assert control == 0x1F | FINAL

    with_unit("st16", "serial", scenario)


@pytest.mark.parametrize("code", [PING, 0x1F], ids=["accepted", "refused"])
def test_b_is_copied_into_the_reply(code):  # 35910
    def scenario(unit: Emulated) -> None:
        for bit in (0, B):
            ((control, _),) = messages(unit.ask(sent(code | POLL | bit)))
            assert control & B == bit

    with_unit("st16", "serial", scenario)


def test_b_is_in_each_message_of_a_reply():  # 35910
    def scenario(unit: Emulated) -> None:
        found = messages(unit.ask(sent(READ_RESULT | POLL | B, struct.pack("<HH", 0, 600))))
        assert len(found) > 1
        assert all(control & B for control, _ in found)

    with_unit("st16", "serial", scenario)


def test_ack_of_a_command_is_ignored():  # 35910
    def scenario(unit: Emulated) -> None:
        assert unit.ask(sent(PING | POLL | ACK)) == unit.ask(sent(PING | POLL))

    with_unit("st16", "serial", scenario)


@pytest.mark.parametrize("code", [READ_EDAC, READ_RESULT])
def test_count_zero_of_the_short_form_is_256_bytes(code):  # 35917
    def scenario(unit: Emulated) -> None:
        data = asked(unit, code, struct.pack("<HB", 16, 0))
        assert struct.unpack_from("<H", data)[0] == 16
        assert len(data) == 2 + 256
        assert len(asked(unit, code, struct.pack("<HH", 16, 256))) == 2 + 256

    with_unit("st16", "serial", scenario)


def test_short_and_long_forms_read_the_same_result():  # 35917
    def scenario(unit: Emulated) -> None:
        short = asked(unit, READ_RESULT, struct.pack("<HB", 8, 32))
        assert short == asked(unit, READ_RESULT, struct.pack("<HH", 8, 32))
        assert short[:2] == struct.pack("<H", 8)

    with_unit("st16", "serial", scenario)


def test_files_are_four_bytes_of_edac_memory():  # 35916
    def scenario(unit: Emulated) -> None:
        short, long = bytes((0x60,)), struct.pack("<H", 0x60)
        asked(unit, WRITE_FILE, short + b"abcd")
        assert asked(unit, READ_FILE, short) == short + b"abcd"
        asked(unit, WRITE_FILE, long + b"efgh")
        assert asked(unit, READ_FILE, long) == long + b"efgh"
        assert asked(unit, READ_EDAC, struct.pack("<HB", 0x180, 4))[2:] == b"efgh"

    with_unit("st16", "serial", scenario)


@pytest.mark.parametrize(
    ("code", "data"),
    [
        (READ_EDAC, struct.pack("<HB", 511, 2)),
        (WRITE_EDAC, struct.pack("<H", 511) + b"ab"),
        (READ_FILE, bytes((128,))),
        (WRITE_FILE, struct.pack("<H", 128) + b"abcd"),
        (READ_FILE, bytes(3)),
        (WRITE_FILE, bytes(4)),
        (WRITE_EDAC, bytes(2)),
        (READ_EDAC, bytes(2)),
    ],
)
def test_edac_memory_has_512_bytes(code, data):  # 35919
    def scenario(unit: Emulated) -> None:
        assert len(asked(unit, READ_EDAC, struct.pack("<HH", 0, 512))) == 2 + 512
        assert messages(unit.ask(sent(code | POLL, data))) == [(code | FINAL, b"")]

    with_unit("st16", "serial", scenario)


def test_edac_memory_is_cleared_when_the_unit_starts():
    def scenario(unit: Emulated) -> None:
        asked(unit, WRITE_FILE, bytes((0x60,)) + b"abcd")
        unit.bench.device.reset("command")
        unit.step(3.0)
        assert asked(unit, READ_FILE, bytes((0x60,)))[1:] == bytes(4)

    with_unit("st16", "serial", scenario)


@pytest.mark.long
def test_time_is_48_bits_of_microseconds():  # 35918
    def scenario(unit: Emulated) -> None:
        first = int.from_bytes(asked(unit, TIME), "little")
        unit.step(2.0)
        assert int.from_bytes(asked(unit, TIME), "little") - first == pytest.approx(2_000_000, abs=2)
        unit.bench.device.command_mode(unit.bench.device.modes.mode.STANDBY)
        unit.step(4300.0)  # beyond 32 bits
        assert int.from_bytes(asked(unit, TIME), "little") - first == pytest.approx(4_302_000_000, abs=2)
        assert len(asked(unit, TIME)) == 6

    with_unit("st16", "serial", scenario)


def test_the_lowest_bit_of_time_is_zero():  # 35918
    def scenario(unit: Emulated) -> None:
        states = set()
        for _ in range(8):
            unit.step(1e-6)
            states.add(int.from_bytes(asked(unit, TIME), "little"))
        assert len(states) > 1
        assert all(count % 2 == 0 for count in states)

    with_unit("st16", "serial", scenario)


def test_time_is_that_of_the_final_fend():  # 35918
    def scenario(unit: Emulated) -> None:
        first, command = int.from_bytes(asked(unit, TIME), "little"), sent(TIME | POLL)
        assert unit.ask(command[:-1]) == b""
        unit.step(0.1)
        ((_, data),) = messages(unit.ask(command[-1:]))
        assert int.from_bytes(data, "little") - first == pytest.approx(100_000, abs=2)

    with_unit("st16", "serial", scenario)


def test_the_epoch_counts_as_time_does():  # 35918, 35922: the sensor has no clock that could be set
    def scenario(unit: Emulated) -> None:
        *_, epoch = struct.unpack("<4d", combined(unit, ON, RATE_AND_EPOCH))
        now = int.from_bytes(asked(unit, TIME), "little") / 1e6
        age = (unit.bench.clock.now_ns() - unit.bench.device.snapshot().frame.mid_ns) / 1e9
        assert now - epoch == pytest.approx(age, abs=3e-6)

    with_unit("st16", "serial", scenario)


def test_a_combination_that_fails_says_why():  # 35918
    def scenario(unit: Emulated) -> None:
        ((control, data),) = messages(unit.ask(sent(COMBINATION | POLL, struct.pack("<I", ATTITUDE << 8))))
        assert control == COMBINATION | FINAL
        assert data[1:].decode("ascii").isprintable()
        assert len(data) > 1

    with_unit("st16", "serial", scenario)


def test_a_dark_window_is_echoed_or_refused_if_it_is_outside_the_image():  # 35917
    def scenario(unit: Emulated) -> None:
        inside = struct.pack("<BB12H", 0, 1, 10, 20, 30, 40, *range(8))
        assert asked(unit, IMAGE, inside) == inside
        outside = struct.pack("<BB12H", 0, 1, 10, 20, 60000, 40, *range(8))
        assert messages(unit.ask(sent(IMAGE | POLL, outside))) == [(IMAGE | FINAL, b"")]

    with_unit("st16", "serial", scenario)


def test_each_matching_structure_has_the_attitude_scalar_first():  # 35920, table 45
    def scenario(unit: Emulated) -> None:
        both = combined(unit, ON, 0x400)
        assert len(both) == 2 * 0xB0
        for found in (both[:0xB0], both[0xB0:]):
            matrix = sensor_matrix(struct.unpack_from("<4d", found, 0x60))
            assert arcseconds_between(matrix, true_matrix()) < 0.01

    with_unit("st16", "serial", scenario)


COUNTERS = ("framing", "runt", "oversize", "crc", "overflow")
"""In this order from address 50h: the pages in hand have no addresses, so that these are those of the emulated unit."""


def counted(unit: Emulated) -> dict[str, int]:
    data = asked(unit, READ_EDAC, struct.pack("<HB", 0x50, 20))
    return dict(zip(COUNTERS, struct.unpack_from("<5I", data, 2), strict=True))


@pytest.mark.parametrize(
    ("line", "counter"),
    [
        (b"\xc0\x0e\x11\xdb\x41\x80\xc0", "framing"),  # FESC before neither TFESC nor TFEND
        (b"\xc0\x0e\x11\x80\x00\xc0", "runt"),  # fewer than 5 bytes
        (b"\xc0\x0e\x11\x80" + bytes(3000) + b"\xc0", "oversize"),
        (b"\xc0\x0e\x11\x80\x00\x00\xc0", "crc"),
        (b"\xc0\x0d\x11\x80\x00\x00\xc0", None),  # bad CRC, but to another address
        (b"\xc0\x0d\x11\x80\x00\xc0", None),  # short, but to another address
        (b"\xc0\xc0\xc0", None),  # no message at all
    ],
)
def test_what_is_no_message_is_counted(line, counter):  # 35919
    def scenario(unit: Emulated) -> None:
        before = counted(unit)
        assert unit.ask(line) == b""
        after = counted(unit)
        assert {name: after[name] - before[name] for name in COUNTERS} == {
            name: int(name == counter) for name in COUNTERS
        }

    with_unit("st16", "serial", scenario)
