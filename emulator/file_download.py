"""Download of files in blocks: loading, bursts of numbered packets, and the hole map of what has arrived.

Files are the stored image as `bmp` and an `index`: one entry of 12 bytes a file, `<type u8, counter u8, edge u16, size u32,
frame u32>`. The layout of the index is ours.
"""

from __future__ import annotations

import binascii
import struct
from collections.abc import Callable
from typing import TYPE_CHECKING, Final

from emulator.images import ImageStore
from protocol.messages import BURST_ID, Reply, ReplyKind
from protocol.values import Value

if TYPE_CHECKING:
    from emulator.device import Device

PACKET_BYTES: Final = 20
MAPS: Final = 8
MAP_BYTES: Final = 16
BMP_TYPE: Final = 4
PACKET: Final = struct.Struct(f"<H{PACKET_BYTES}s")
INDEX_ENTRY: Final = struct.Struct("<BBHII")


class FileDownload:
    """The block that is loaded, and which of its packets have arrived."""

    def __init__(self, images: ImageStore) -> None:
        self._images = images
        self.clear()

    def clear(self) -> None:
        """Forget the block and the hole map."""
        self.data = b""
        self.ready = False
        self.parameter_error = False
        self.hole_map = bytearray(MAPS * MAP_BYTES)

    @property
    def checksum(self) -> int:
        """CRC-16/CCITT-FALSE of the block."""
        return binascii.crc_hqx(self.data, 0xFFFF) if self.ready else 0

    def load(self, file_type: str, counter: int, offset: int, length: int) -> bool:
        """Load a block of a file; False, with an empty block, if there is no such file or range."""
        file = self._file(file_type, counter)
        self.data = b""
        self.ready = file is not None and length > 0 and offset + length <= len(file)
        self.parameter_error = not self.ready
        self.hole_map = bytearray(MAPS * MAP_BYTES)
        if file is not None and self.ready:
            self.data = file[offset : offset + length]
        return self.ready

    def _file(self, file_type: str, counter: int) -> bytes | None:
        image = self._images.stored
        if file_type == "index":
            if image is None:
                return b""
            size = len(image.bmp())
            return INDEX_ENTRY.pack(BMP_TYPE, image.number, image.edge, size, image.frame)
        if file_type == "bmp" and image is not None and counter in {0, image.number}:
            return image.bmp()
        return None

    def set_hole_map(self, part: int, data: bytes) -> None:
        """Take one of the eight parts of the hole map, counted from 1."""
        self.hole_map[(part - 1) * MAP_BYTES : part * MAP_BYTES] = data

    def get_hole_map(self, part: int) -> bytes:
        """Return one of the eight parts of the hole map, counted from 1."""
        return bytes(self.hole_map[(part - 1) * MAP_BYTES : part * MAP_BYTES])

    def burst(self, *, ignore_hole_map: bool) -> list[Reply]:
        """Return the packets of the block, by default only those that the hole map lacks."""
        replies: list[Reply] = []
        for number in range(-(-len(self.data) // PACKET_BYTES)):
            arrived = self.hole_map[number // 8] >> (number % 8) & 1
            if ignore_hole_map or not arrived:
                part = self.data[number * PACKET_BYTES : (number + 1) * PACKET_BYTES]
                replies.append(Reply(ReplyKind.BURST, BURST_ID, PACKET.pack(number, part)))
        return replies


def hole_map_values(part: int) -> Callable[[Device], dict[str, Value]]:
    """Telemetry of one part of the hole map."""

    def hole_map(device: Device) -> dict[str, Value]:
        return {"map": device.files.get_hole_map(part)}

    return hole_map
