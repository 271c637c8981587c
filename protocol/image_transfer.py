"""Transfer of images and files, for both ends: image frames with a checksum, burst packets and the hole map.

Image frames follow the CubeSense node, bursts the CubeComputer. The checksum of an image frame is our own choice. Files
and blocks have a CRC-16 with initial value 0 (EnduroSat cubeadcs); its polynomial is not public, so it is our own choice.
"""

from __future__ import annotations

import binascii
import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Final

from starhil.protocol.errors import ProtocolError

FRAME_SIZE: Final = 128
"""Bytes of one image frame."""

PACKET_DATA: Final = 20
"""Bytes of the file in one burst packet."""

MAP_PARTS: Final = 8
"""Number of parts of the hole map, each a telecommand and a telemetry row."""

MAP_PART_SIZE: Final = 16
"""Bytes of one part of the hole map."""

MAX_PACKETS: Final = MAP_PARTS * MAP_PART_SIZE * 8
"""Number of packets that the hole map covers."""

MAX_BLOCK: Final = MAX_PACKETS * PACKET_DATA
"""Bytes of the largest block."""

_PACKET: Final = struct.Struct(f"<H{PACKET_DATA}s")


def frame_checksum(frame: bytes) -> int:
    """Return the sum of an image frame's bytes modulo 256."""
    return sum(frame) % 256


def file_checksum(data: bytes) -> int:
    """Return the CRC-16/XMODEM of a file or block.

    Polynomial 0x1021, initial value 0; "123456789" gives 0x31C3.
    """
    return binascii.crc_hqx(data, 0)


def packet_count(size: int) -> int:
    """Return the number of packets of a block of `size` bytes."""
    return -(-size // PACKET_DATA)


def burst_packet(block: bytes, number: int) -> bytes:
    """Return packet `number` of a block: its number (u16) and 20 bytes, padded with zeros."""
    return _PACKET.pack(number, block[number * PACKET_DATA : (number + 1) * PACKET_DATA])


def parse_burst_packet(packet: bytes) -> tuple[int, bytes]:
    """Return number and data of a packet. Raises ProtocolError if it is not 22 bytes long."""
    if len(packet) != _PACKET.size:
        raise ProtocolError(f"burst packet of {len(packet)} bytes, must be {_PACKET.size}")
    number, data = _PACKET.unpack(packet)
    return number, data


@dataclass(frozen=True)
class HoleMap:
    """Which packets of a block have arrived: bit n of part k (from 1) is packet 128 (k - 1) + n."""

    bits: bytes = bytes(MAP_PARTS * MAP_PART_SIZE)

    @classmethod
    def of(cls, arrived: Iterable[int]) -> HoleMap:
        """Return the map of these packets; numbers that it does not cover are left out."""
        bits = bytearray(MAP_PARTS * MAP_PART_SIZE)
        for number in arrived:
            if 0 <= number < MAX_PACKETS:
                bits[number // 8] |= 1 << number % 8
        return cls(bytes(bits))

    def __contains__(self, number: int) -> bool:
        """Return whether a packet has arrived."""
        return 0 <= number < MAX_PACKETS and bool(self.bits[number // 8] >> number % 8 & 1)

    def missing(self, count: int) -> Iterator[int]:
        """Return the numbers below `count` of packets that have not arrived."""
        return (number for number in range(count) if number not in self)

    def part(self, part: int) -> bytes:
        """Return the 16 bytes of a part; parts count from 1."""
        return self.bits[self._span(part)]

    def with_part(self, part: int, data: bytes) -> HoleMap:
        """Return the map with other 16 bytes in a part; parts count from 1."""
        if len(data) != MAP_PART_SIZE:
            raise ProtocolError(f"hole map part of {len(data)} bytes, must be {MAP_PART_SIZE}")
        span = self._span(part)
        return HoleMap(self.bits[: span.start] + data + self.bits[span.stop :])

    @staticmethod
    def _span(part: int) -> slice:
        if not 1 <= part <= MAP_PARTS:
            raise ProtocolError(f"hole map part {part} is outside 1 to {MAP_PARTS}")
        return slice((part - 1) * MAP_PART_SIZE, part * MAP_PART_SIZE)
