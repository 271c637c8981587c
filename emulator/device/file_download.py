"""Files for download: their list, loading in blocks, bursts of numbered packets, and the hole map of received packets.

The files are the stored images as `bmp`, and an `index` with 12 bytes per image: `<type u8, counter u8, edge u16,
size u32, frame u32>`. The layout of the index is not public; this one is our own choice.
"""

from __future__ import annotations

import datetime as dt
import struct
from collections import deque
from collections.abc import Callable
from typing import Final, NamedTuple

from starhil.emulator.clock import NANOSECONDS
from starhil.emulator.device.images import ImageStore
from starhil.protocol.image_transfer import (
    MAX_BLOCK,
    MAX_PACKETS,
    HoleMap,
    burst_packet,
    file_checksum,
    packet_count,
    parse_burst_packet,
)
from starhil.protocol.messages import BURST_ID, Reply, ReplyKind

BMP_TYPE: Final = 4
INDEX_ENTRY: Final = struct.Struct("<BBHII")

LOOKUP_S: Final = 0.02
"""Modelled time until the information of the next file is valid, seconds."""
ERASE_S: Final = 0.1
"""Modelled time to erase files, seconds."""


class FileInfo(NamedTuple):
    """Information of a file; zeros at the end of the list."""

    type: int = 0
    counter: int = 0
    size: int = 0
    time: int = 0
    """Date and time of the file, in MS-DOS format."""
    checksum: int = 0


class FileDownload:
    """The list of files, the loaded block, and the map of its packets that have arrived."""

    def __init__(self, images: ImageStore, now_ns: Callable[[], int]) -> None:
        self._images = images
        self._now_ns = now_ns
        self.clear()

    def clear(self) -> None:
        """Discard the block and the hole map, and begin the list again."""
        self._load(b"")
        self.parameter_error = False
        self._position = self._valid_ns = self._erased_ns = 0
        self.formatting = False

    # --- the list ---

    def rewind(self) -> None:
        """Go to the first file."""
        self._go_to(0)

    def advance(self) -> None:
        """Go to the next file."""
        self._go_to(self._position + 1)

    def _go_to(self, position: int) -> None:
        self._position = min(position, len(self._images.files))
        self._valid_ns = self._now_ns() + round(LOOKUP_S * NANOSECONDS)

    @property
    def updating(self) -> bool:
        """Whether the information is still being looked up."""
        return self._now_ns() < self._valid_ns

    @property
    def info(self) -> FileInfo:
        """Information of the file at the current position."""
        images = tuple(self._images.files.values())[self._position :]
        if self.updating or not images:
            return FileInfo()
        image = images[0]
        return FileInfo(BMP_TYPE, image.number, image.file_size, msdos_time(image.unix_ns), image.file_crc)

    def erase(self, file_type: str, counter: int) -> bool:
        """Erase a file; return False if it does not exist."""
        return file_type == "bmp" and self._images.files.pop(counter, None) is not None

    def erase_all(self, *, formatting: bool) -> None:
        """Erase all files, which takes `ERASE_S`."""
        self._images.files.clear()
        self._erased_ns = self._now_ns() + round(ERASE_S * NANOSECONDS)
        self.formatting = formatting

    @property
    def erasing(self) -> bool:
        """Whether all files are being erased."""
        return self._now_ns() < self._erased_ns

    # --- a block ---

    @property
    def ready(self) -> bool:
        """Whether a block is loaded."""
        return bool(self.data)

    @property
    def checksum(self) -> int:
        """Checksum of the block; 0 if none is loaded."""
        return file_checksum(self.data)

    def load(self, file_type: str, counter: int, offset: int, length: int) -> bool:
        """Load a block of a file, at most up to its end; return False if there is no such file or byte.

        A length of 1024 is that of a whole block in packets.
        """
        wanted = MAX_BLOCK if length == MAX_PACKETS else length
        self._load(self._file(file_type, counter)[offset : offset + wanted])
        self.parameter_error = not self.ready
        return self.ready

    def _load(self, data: bytes) -> None:
        self.data = data
        self.arrived = HoleMap()
        self._waiting: deque[int] = deque((0,))
        """Numbers of the packets that `packet` still has to report."""

    def _file(self, file_type: str, counter: int) -> bytes:
        if file_type == "index":
            return b"".join(
                INDEX_ENTRY.pack(BMP_TYPE, image.number, image.edge, image.file_size, image.frame)
                for image in self._images.files.values()
            )
        image = self._images.files.get(counter) if counter else self._images.stored
        return image.bmp() if image is not None and file_type == "bmp" else b""

    def burst(self, *, ignore_hole_map: bool) -> list[Reply]:
        """Return the packets of the block, by default only those missing in the hole map."""
        count = packet_count(len(self.data))
        numbers = list(range(count) if ignore_hole_map else self.arrived.missing(count))
        self._waiting = deque(numbers) or self._waiting
        return [Reply(ReplyKind.BURST, BURST_ID, burst_packet(self.data, number)) for number in numbers]

    @property
    def packet(self) -> tuple[int, bytes]:
        """Number and data of the current packet of the last burst, for an OBC that reads one at a time."""
        return parse_burst_packet(burst_packet(self.data, self._waiting[0]))

    def next_packet(self) -> None:
        """Go to the next packet of the last burst; the last one stays."""
        if len(self._waiting) > 1:
            self._waiting.popleft()


def msdos_time(unix_ns: int) -> int:
    """Return a UTC time in the MS-DOS format, in steps of 2 s; the nearest limit if it is not in 1980 to 2107."""
    first, last = dt.datetime(1980, 1, 1, tzinfo=dt.UTC), dt.datetime(2107, 12, 31, 23, 59, 58, tzinfo=dt.UTC)
    seconds = min(max(unix_ns // NANOSECONDS, int(first.timestamp())), int(last.timestamp()))
    time = dt.datetime.fromtimestamp(seconds, dt.UTC)
    date = (time.year - 1980) << 9 | time.month << 5 | time.day
    return date << 16 | time.hour << 11 | time.minute << 5 | time.second // 2
