"""What published OBC software does with the files of a CubeComputer, from its bytes: list, erase, capture, download, reset.

Each driver is written from its wire facts, with its own framing, time-outs and assumptions, and shares no code with the product.
What AlbertaSat's own code sent and took is in `test_recorded`.

AlbertaSat
    ex2_hal/adcs in AlbertaSat/ex2_obc_software: UART, replies with ID. It waits for no reply to telecommands 1, 101 and 119.
EnduroSat
    cubeadcs_driver.c, cubeadcs_ftransf.c: UART, replies with ID, a CRC-8 after each telecommand. After a reset it waits for a time-out.
CTS
    adcs_commands.c in CalgaryToSpace/CTS-SAT-1-OBC-Firmware: I2C, where nothing answers a telecommand but row 240, and row 241 is read
    packet by packet; a CRC-8 after each telecommand. A bridge from I2C to the serial line stands between.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import pytest

from tests.emulator.units.clients import Emulated, with_unit

STAR, SIZE_64, SIZE_128, SIZE_256 = 2, 4, 3, 2
JPG, BMP, INDEX = 3, 4, 15
BLOCK = 20480
NEVER = 2000
"""More polls than any driver needs."""


def crc8(data: bytes) -> int:
    """The CRC-8 of a telecommand's data, by section 5.5 of the firmware reference manual as CTS and EnduroSat have it."""
    table = []
    for value in range(256):
        for _ in range(8):
            value = (value ^ 0x91 if value & 1 else value) >> 1
        table.append(value)
    crc = 0
    for byte in data:
        crc = table[crc ^ byte]
    return crc if data else 0xFF


def crc16(data: bytes) -> int:
    crc = 0
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ 0x1021 if crc & 0x8000 else crc << 1) & 0xFFFF
    return crc


@dataclass
class FileInfo:
    type: int
    updating: bool
    counter: int
    size: int
    time: int
    crc: int

    @classmethod
    def of(cls, data: bytes) -> FileInfo:
        first, counter, size, time, crc = struct.unpack("<BBIIH", data)
        return cls(first & 0xF, bool(first >> 4 & 1), counter, size, time, crc)

    @property
    def date(self) -> tuple[int, ...]:
        """Year, month, day, hour, minute, second of the MS-DOS date and time."""
        t = self.time
        return (
            (t >> 25) + 1980, t >> 21 & 15, t >> 16 & 31, t >> 11 & 31, t >> 5 & 63, (t & 31) << 1,
        )  # fmt: skip


class NoByteError(Exception):
    pass


class Uart:
    """The receive buffer of a UART; time passes on the device while a driver waits."""

    def __init__(self, unit: Emulated) -> None:
        self.unit = unit
        self._queue: deque[int] = deque()

    def send(self, data: bytes) -> None:
        self.unit.wire.take()
        self.unit.wire.arrive(data)
        self._collect()

    def _collect(self) -> None:
        for message in self.unit.wire.take():
            self._queue.extend(message)

    def byte(self) -> int:
        """The next byte, or NoByteError after 1.5 s without one."""
        if not self._queue:
            for message in self.unit.step(1.5):
                self._queue.extend(message)
        if not self._queue:
            raise NoByteError
        return self._queue.popleft()

    def flush(self) -> None:
        self._queue.clear()

    def wait(self, seconds: float) -> None:
        for message in self.unit.step(seconds):
            self._queue.extend(message)

    @property
    def silent(self) -> bool:
        return not self._queue


def framed(body: bytes) -> bytes:
    return b"\x1f\x7f" + body.replace(b"\x1f", b"\x1f\x1f") + b"\x1f\xff"


class AlbertaSat:
    """`adcs_io.c` and `adcs_handler.c`."""

    def __init__(self, unit: Emulated) -> None:
        self.uart = Uart(unit)

    def telecommand(self, *command: int) -> int:
        """`send_uart_telecommand`: six bytes of reply, the fourth is the error."""
        self.uart.send(framed(bytes(command)))
        reply = bytes(self.uart.byte() for _ in range(6))
        self.uart.flush()
        return reply[3]

    def telecommand_no_reply(self, *command: int) -> None:
        """`send_uart_telecommand_no_reply`: data are not stuffed."""
        self.uart.send(b"\x1f\x7f" + bytes(command) + b"\x1f\xff")

    def telemetry(self, identifier: int, length: int) -> bytes:
        """`request_uart_telemetry`: reads to the first 1F FF, and takes the stuffing out from the fourth byte on."""
        self.uart.send(bytes((0x1F, 0x7F, identifier, 0x1F, 0xFF)))
        reply = bytearray()
        index = 0
        while index < 2:
            reply.append(self.uart.byte())
            index = index + 1 if reply[-1] == (0x1F, 0xFF)[index] else 0
        self.uart.flush()
        stuffed, data, position = bytes(reply[3:-2]), bytearray(), 0
        while position < len(stuffed):
            data.append(stuffed[position])
            position += 2 if stuffed[position] == 0x1F else 1
        assert len(data) == length
        return bytes(data)

    def packet(self) -> tuple[int, bytes]:
        """`receive_file_download_uart_packet`: from 1F 7F 77 to the first 1F FF after 25 bytes, at most 33."""
        reply = bytearray()
        while bytes(reply[-3:]) != b"\x1f\x7f\x77":
            reply.append(self.uart.byte())
        reply = reply[-3:]
        while len(reply) < 27 or reply[-2:] != b"\x1f\xff":
            reply.append(self.uart.byte())
            assert len(reply) < 27 + 6
        data = bytes(reply[3:-2]).replace(b"\x1f\x1f", b"\x1f")
        return data[1] << 8 | data[0], data[2:22]

    def save_image(self, size: int) -> None:
        assert self.telecommand(80, STAR, size) == 0
        for _ in range(NEVER):
            self.uart.wait(0.05)
            if tuple(self.telemetry(233, 2)) == (100, 0):
                return
        pytest.fail("the image is never saved")

    def file_list(self) -> list[FileInfo]:
        """`ADCS_get_file_list`."""
        assert self.telecommand(118) == 0
        files: list[FileInfo] = []
        for _ in range(NEVER):
            info = FileInfo.of(self.telemetry(243, 12))
            if info.updating:
                self.uart.wait(0.005)
                continue
            if (info.counter, info.size, info.time, info.crc) == (0, 0, 0, 0):
                return files
            assert self.telecommand(113) == 0
            files.append(info)
        pytest.fail("the file list never ends")

    def download(self, info: FileInfo) -> bytes:
        """`ADCS_download_file`: blocks of 20 480 bytes; the length of each is read from row 242."""
        file, offset, block_length = bytearray(), 0, BLOCK
        while offset < info.size:
            assert (
                self.telecommand(112, info.type, info.counter, *struct.pack("<IH", offset, block_length)) == 0
            )
            ready = False
            while not ready:
                flags, _crc, block_length = struct.unpack("<BHH", self.telemetry(242, 5))
                ready = bool(flags & 1)
            self.telecommand_no_reply(119, 20, 1)
            left = block_length
            for number in range(-(-block_length // 20)):
                counter, data = self.packet()
                assert counter == number  # otherwise it fills the file with 33 hexadecimal
                file += data[: min(20, left)]
                left -= min(20, left)
            offset += block_length
        return bytes(file)


class EnduroSat:
    """`cubeadcs_driver.c` and `cubeadcs_ftransf.c`."""

    def __init__(self, unit: Emulated) -> None:
        self.uart = Uart(unit)

    def send(self, identifier: int, data: bytes = b"") -> None:
        """Telecommands, with an ID below 128, have a CRC-8 at their end."""
        self.uart.flush()
        self.uart.send(
            framed(bytes((identifier,)) + data + (bytes((crc8(data),)) if identifier < 128 else b""))
        )

    def message(self) -> bytes:
        """The body of a message; anything but stuffing after 1F within one is an error."""
        body, started = bytearray(), False
        while True:
            byte = self.uart.byte()
            if byte != 0x1F:
                if started:
                    body.append(byte)
                continue
            byte = self.uart.byte()
            assert (byte, started) in ((0x1F, True), (0x7F, False), (0xFF, True))
            if byte == 0xFF:
                return bytes(body)
            if byte == 0x1F:
                body.append(byte)
            started = True

    def fetch(self, identifier: int, length: int, data: bytes = b"") -> bytes:
        self.send(identifier, data)
        body = self.message()
        assert body[0] == identifier
        assert len(body) == 1 + length
        return body[1:]

    def telecommand(self, identifier: int, data: bytes = b"") -> int:
        return self.fetch(identifier, 1, data)[0]

    def file_list(self) -> list[FileInfo]:
        assert self.telecommand(118) == 0
        files: list[FileInfo] = []
        for _ in range(NEVER):
            info = FileInfo.of(self.fetch(243, 12))
            if info.updating:
                self.uart.wait(0.01)
                continue
            if info.time == 0 and info.size == 0:
                return files
            files.append(info)
            assert self.telecommand(113) == 0
        pytest.fail("the file list never ends")

    def download(self, info: FileInfo, lose: Callable[[int, int], bool]) -> bytes:
        """Blocks of 20 480 bytes; `lose` returns whether a packet is lost in a burst of a block."""
        file, offset = bytearray(-(-info.size // 20) * 20), 0
        received = 0
        while received < -(-info.size // 20):
            assert self.telecommand(112, struct.pack("<BBIH", info.type, info.counter, offset, BLOCK)) == 0
            flags, crc, length = struct.unpack("<BHH", self.fetch(242, 5))
            assert flags == 1  # compared with pdTRUE
            hole_map, ignore = bytearray(128), 1
            for burst in range(5):
                self.send(119, bytes((20, ignore)))
                for number, data in self._burst():
                    if not lose(burst, number):
                        assert number < 1024
                        hole_map[number // 8] |= 1 << number % 8
                        file[offset + 20 * number : offset + 20 * number + 20] = data
                count = int.from_bytes(hole_map, "little").bit_count()
                if count + received >= -(-info.size // 20) or count == 1024:
                    break
                for part in range(8):
                    assert self.telecommand(120 + part, bytes(hole_map[16 * part : 16 * part + 16])) == 0
                ignore = 0
            assert crc16(file[offset : offset + length]) == crc
            received += count
            offset += BLOCK
        return bytes(file[: info.size])

    def _burst(self) -> list[tuple[int, bytes]]:
        packets = []
        while True:
            try:
                body = self.message()
            except NoByteError:
                return packets
            assert (body[0], len(body)) == (119, 23)
            packets.append((body[2] << 8 | body[1], body[3:]))

    def reset(self) -> None:
        """`cubeadcs_reset`: only a time-out is a success."""
        self.send(1, b"\x5a")
        with pytest.raises(NoByteError):
            self.message()


class Cts:
    """`adcs_commands.c`, over a bridge from I2C that drops whatever answers a write."""

    def __init__(self, unit: Emulated) -> None:
        self.unit = unit

    def telecommand(self, identifier: int, data: bytes = b"") -> int:
        """`ADCS_i2c_send_command_and_check`: write, then read row 240 until the telecommand is processed."""
        self.unit.ask(framed(bytes((identifier,)) + data + bytes((crc8(data),))))
        for _ in range(NEVER):
            last, flags, error, _index = self.telemetry(240, 4)
            if flags & 1:
                assert last == identifier
                return error
            self.unit.step(0.004)
        pytest.fail(f"telecommand {identifier} is never processed")

    def telemetry(self, identifier: int, length: int) -> bytes:
        body = self.unit.ask(bytes((0x1F, 0x7F, identifier, 0x1F, 0xFF)))
        data = body[2:-2].replace(b"\x1f\x1f", b"\x1f")
        assert data[0] == identifier
        assert len(data) == 1 + length
        return data[1:]

    def file_list(self) -> list[FileInfo]:
        """`ADCS_get_sd_card_file_list`: fixed pauses instead of the flag."""
        assert self.telecommand(118) == 0
        self.unit.step(0.2)
        blocks = []
        for _ in range(20):
            info = FileInfo.of(self.telemetry(243, 12))
            if (info.crc, info.time, info.size) == (0, 0, 0):
                break
            blocks.append(info)
            assert self.telecommand(113) == 0
            self.unit.step(0.1)
        return blocks

    def download(self, info: FileInfo) -> bytes:
        """`ADCS_load_sd_file_block_to_filesystem`: 1024 as the length of a block, and 1024 readings of row 241."""
        file = bytearray()
        for block in range(-(-info.size // BLOCK)):
            load = struct.pack("<BBIH", info.type, info.counter, block * BLOCK, 1024)
            assert self.telecommand(112, load) == 0
            assert self.telemetry(242, 5)[0] & 1
            assert self.telecommand(119, bytes((20, 1))) == 0
            self.unit.step(0.1)
            buffer, numbers = bytearray(BLOCK), set()
            for _ in range(1024):
                packet = self.telemetry(241, 22)
                number = int.from_bytes(packet[:2], "little") % 1024
                buffer[20 * number : 20 * number + 20] = packet[2:]
                numbers.add(number)
            left = min(BLOCK, info.size - block * BLOCK)
            assert len(numbers) <= -(
                -left // 20
            )  # more packets than expected, and it asks again until it gives up
            file += buffer[:left]
        return bytes(file)


def image_of(file: bytes) -> np.ndarray:
    image = cv2.imdecode(np.frombuffer(file, np.uint8), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return image


def run(scenario: Callable[[Emulated], None]) -> None:
    """Run a scenario on CubeStar's serial line, whose replies have an ID."""

    def with_ids(unit: Emulated) -> None:
        unit.bench.device.parameters.set({"serial_dialect": "a"})
        unit.bench.command("save_parameters")
        scenario(unit)

    with_unit("cubestar", "serial", with_ids)


def test_albertasat_captures_lists_downloads_and_erases_images():
    def scenario(unit: Emulated) -> None:
        obc = AlbertaSat(unit)
        assert obc.telecommand(2, *struct.pack("<IH", 1_900_000_000, 0)) == 0
        assert obc.file_list() == []
        for size in (SIZE_64, SIZE_256):
            obc.save_image(size)
        files = obc.file_list()
        assert [(info.type, info.counter) for info in files] == [(BMP, 1), (BMP, 2)]
        assert files[0].date[:3] == (2030, 3, 17)
        for info, edge in zip(files, (64, 256), strict=True):
            file = obc.download(info)
            assert (len(file), crc16(file)) == (info.size, info.crc)
            assert image_of(file).shape == (edge, edge)
            assert (image_of(file) == np.arange(edge) % 251).all()
        assert obc.telecommand(108, BMP, 1, 0) == 0
        assert obc.file_list() == files[1:]
        assert obc.telecommand(108, BMP, 1, 0) == 3
        assert obc.telecommand(112, BMP, 1, *struct.pack("<IH", 0, BLOCK)) == 3
        assert obc.telecommand(108, BMP, 0, 1) == 0
        obc.uart.wait(1.0)
        assert obc.telemetry(234, 1) == b"\0"
        assert obc.file_list() == []

    run(scenario)


def test_albertasat_expects_silence_after_a_reset_and_after_starting_a_program():
    def scenario(unit: Emulated) -> None:
        obc = AlbertaSat(unit)
        obc.telecommand_no_reply(101)
        assert obc.uart.silent
        assert obc.telemetry(240, 4) == bytes((101, 1, 0, 0))
        boots = obc.telemetry(129, 6)[1]
        obc.telecommand_no_reply(1, 0x5A)
        assert obc.uart.silent
        obc.uart.wait(5.0)
        assert obc.uart.silent
        assert obc.telemetry(129, 6)[1] == boots + 1

    run(scenario)


def test_a_refusal_of_a_telecommand_without_reply_is_silent_too_and_read_from_the_acknowledge():
    def scenario(unit: Emulated) -> None:
        obc = AlbertaSat(unit)
        for command, code in (((119, 20, 1), 7), ((1, 0x55), 3), ((119, 20), 2), ((101, 1, 2), 2)):
            obc.telecommand_no_reply(*command)
            assert obc.uart.silent
            assert obc.telemetry(240, 4)[:3] == bytes((command[0], 1, code))

    run(scenario)


def test_endurosat_downloads_with_holes_and_hole_maps():
    def scenario(unit: Emulated) -> None:
        obc = EnduroSat(unit)
        for size in (SIZE_128, SIZE_256):
            assert obc.telecommand(80, bytes((STAR, size))) == 0
            obc.uart.wait(2.0)
        small, large = obc.file_list()
        assert (small.counter, large.counter) == (1, 2)

        def lose(burst: int, number: int) -> bool:
            return (burst == 0 and 200 <= number < 330) or (burst < 3 and number % 7 == burst)

        for info, edge in ((small, 128), (large, 256)):
            file = obc.download(info, lose)
            assert crc16(file) == info.crc
            assert (image_of(file) == np.arange(edge) % 251).all()
        assert obc.telecommand(108, bytes((BMP, 2, 0))) == 0
        assert obc.file_list() == [small]
        obc.reset()

    run(scenario)


def test_cts_reads_a_file_packet_by_packet():
    def scenario(unit: Emulated) -> None:
        obc = Cts(unit)
        assert obc.telecommand(80, bytes((STAR, SIZE_256))) == 0
        unit.step(2.0)
        (info,) = obc.file_list()
        file = obc.download(info)
        assert crc16(file) == info.crc
        assert (image_of(file) == np.arange(256) % 251).all()
        index = obc.download(FileInfo(type=INDEX, updating=False, counter=0, size=12, time=0, crc=0))
        assert (index[0], index[1]) == (BMP, info.counter)
        assert obc.telecommand(108, bytes((BMP, info.counter, 0))) == 0
        assert obc.telecommand(33, b"\x5a") == 0
        assert obc.file_list() == []

    run(scenario)


def test_cts_converts_an_image_and_downloads_the_jpg_file():
    """`TCMDEXEC_adcs_convert_to_jpg_by_index`: polls row 133 every 50 ms while the result is 0 or 3, at most 255 times."""

    def scenario(unit: Emulated) -> None:
        obc = Cts(unit)
        assert obc.telecommand(80, bytes((STAR, SIZE_128))) == 0
        unit.step(2.0)
        (image,) = obc.file_list()
        assert image.type == BMP
        assert obc.telecommand(57, bytes((image.counter, 95, 0))) == 0
        for _ in range(255):
            percent, result, counter = obc.telemetry(133, 3)
            if result not in (0, 3):
                break
            unit.step(0.05)
        assert (percent, result) == (100, 1)
        (jpg,) = (info for info in obc.file_list() if (info.type, info.counter) == (JPG, counter))
        file = obc.download(jpg)
        assert crc16(file) == jpg.crc
        assert image_of(file).shape == (128, 128)
        assert obc.telecommand(57, bytes((99, 95, 0))) == 0
        assert obc.telemetry(133, 3)[1] == 2
        assert obc.telecommand(57, bytes((image.counter, 0, 0))) == 3

    run(scenario)


def test_a_telecommand_with_a_wrong_crc_is_refused():
    def scenario(unit: Emulated) -> None:
        obc = AlbertaSat(unit)
        assert (crc8(b"\x5a"), crc8(b"123456789")) == (0x72, 0x25)
        assert obc.telecommand(80, STAR, SIZE_64, crc8(bytes((STAR, SIZE_64))) ^ 1) == 4
        assert obc.telemetry(240, 4) == bytes((80, 1, 4, 0))
        assert obc.telecommand(113, 0xFF) == 0
        assert obc.telecommand(113, 0xFE) == 4
        assert obc.telecommand(113, 0xFF, 0xFF) == 2

    run(scenario)
