"""Download of files in blocks: loading, bursts of numbered packets, and the hole map of received packets.

The files are the stored image as `bmp`, and an `index` with 12 bytes per file: `<type u8, counter u8, edge u16,
size u32, frame u32>`. The layout of the index is not public; this one is our own choice.
"""

from __future__ import annotations

import struct
from typing import Final

from starhil.emulator.device.images import ImageStore
from starhil.protocol.image_transfer import HoleMap, block_checksum, burst_packet, packet_count
from starhil.protocol.messages import BURST_ID, Reply, ReplyKind

BMP_TYPE: Final = 4
INDEX_ENTRY: Final = struct.Struct("<BBHII")


class FileDownload:
    """The loaded block, and the map of its packets that have arrived."""

    def __init__(self, images: ImageStore) -> None:
        self._images = images
        self.clear()

    def clear(self) -> None:
        """Discard the block and the hole map."""
        self.data = b""
        self.ready = False
        self.parameter_error = False
        self.arrived = HoleMap()

    @property
    def checksum(self) -> int:
        """Checksum of the block; 0 if none is loaded."""
        return block_checksum(self.data) if self.ready else 0

    def load(self, file_type: str, counter: int, offset: int, length: int) -> bool:
        """Load a block of a file; return False, with an empty block, if the file or range does not exist."""
        file = self._file(file_type, counter)
        self.clear()
        self.ready = file is not None and length > 0 and offset + length <= len(file)
        self.parameter_error = not self.ready
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

    def burst(self, *, ignore_hole_map: bool) -> list[Reply]:
        """Return the packets of the block, by default only those missing in the hole map."""
        count = packet_count(len(self.data))
        numbers = range(count) if ignore_hole_map else self.arrived.missing(count)
        return [Reply(ReplyKind.BURST, BURST_ID, burst_packet(self.data, number)) for number in numbers]
