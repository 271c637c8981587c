"""Units in which images and files cross the wire: frames with a checksum, burst packets and the hole map, for both ends.

Frames follow the CubeSense node, bursts the CubeComputer; both checksum rules are ours, no public source tells them.
"""

from __future__ import annotations

import binascii
import struct
from collections.abc import Iterable, Iterator
from typing import Final

from starhil.protocol.errors import ProtocolError

FRAME_SIZE: Final = 128
"""Bytes of one image frame."""

PACKET_DATA: Final = 20
"""Bytes of the file in one burst packet."""

MAP_PARTS: Final = 8
"""Telecommands and telemetry rows that carry the hole map."""

MAP_PART_SIZE: Final = 16
"""Bytes of one part of the hole map."""

MAX_PACKETS: Final = MAP_PARTS * MAP_PART_SIZE * 8
"""Packets that the hole map can tell of."""

MAX_BLOCK: Final = MAX_PACKETS * PACKET_DATA
"""Bytes of the largest block."""

_PACKET: Final = struct.Struct(f"<H{PACKET_DATA}s")


def frame_checksum(frame: bytes) -> int:
    """Sum of a frame's bytes modulo 256."""
    return sum(frame) % 256


def block_checksum(block: bytes) -> int:
    """CRC-16/CCITT-FALSE of a block: polynomial 0x1021, initial value 0xFFFF; "123456789" gives 0x29B1."""
    return binascii.crc_hqx(block, 0xFFFF)


def packet_count(size: int) -> int:
    """Packets that a block of `size` bytes takes."""
    return -(-size // PACKET_DATA)


def burst_packet(block: bytes, number: int) -> bytes:
    """Return packet `number` of a block: its number (u16) and 20 bytes, the last ones filled up with zeros."""
    return _PACKET.pack(number, block[number * PACKET_DATA : (number + 1) * PACKET_DATA])


def parse_burst_packet(packet: bytes) -> tuple[int, bytes]:
    """Return number and data of a packet. Raises ProtocolError if it has not 22 bytes."""
    if len(packet) != _PACKET.size:
        raise ProtocolError(f"burst packet of {len(packet)} bytes, must be {_PACKET.size}")
    number, data = _PACKET.unpack(packet)
    return number, data


class HoleMap:
    """Which packets of a block have arrived: bit n of part k (from 1) stands for packet 128 (k - 1) + n."""

    def __init__(self, arrived: Iterable[int] = ()) -> None:
        self._bits = bytearray(MAP_PARTS * MAP_PART_SIZE)
        for number in arrived:
            self.add(number)

    def add(self, number: int) -> None:
        """Note that a packet has arrived; one beyond the map is none of ours."""
        if 0 <= number < MAX_PACKETS:
            self._bits[number // 8] |= 1 << number % 8

    def __contains__(self, number: int) -> bool:
        """Whether a packet has arrived."""
        return 0 <= number < MAX_PACKETS and bool(self._bits[number // 8] >> number % 8 & 1)

    def missing(self, count: int) -> Iterator[int]:
        """Numbers below `count` that have not arrived."""
        return (number for number in range(count) if number not in self)

    def part(self, part: int) -> bytes:
        """Return the 16 bytes of a part, counted from 1."""
        return bytes(self._bits[self._span(part)])

    def set_part(self, part: int, data: bytes) -> None:
        """Replace a part, counted from 1, by 16 bytes."""
        if len(data) != MAP_PART_SIZE:
            raise ProtocolError(f"hole map part of {len(data)} bytes, must be {MAP_PART_SIZE}")
        self._bits[self._span(part)] = data

    @staticmethod
    def _span(part: int) -> slice:
        if not 1 <= part <= MAP_PARTS:
            raise ProtocolError(f"hole map part {part} is outside 1 to {MAP_PARTS}")
        return slice((part - 1) * MAP_PART_SIZE, part * MAP_PART_SIZE)
