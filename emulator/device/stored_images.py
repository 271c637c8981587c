"""Stored images, and the states of their capture and download, as records that do not change."""

from __future__ import annotations

import datetime as dt
import struct
from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar, Final, TypeAlias

import numpy as np

from starhil.emulator.sensor.pipeline.binning import mean_over_squares
from starhil.protocol.icd.conventions import NANOSECONDS
from starhil.protocol.image_transfer import FRAME_SIZE, HoleMap, file_checksum

JPG_TYPE: Final = 3
BMP_TYPE: Final = 4
PALETTE: Final = b"".join(bytes((n, n, n, 0)) for n in range(256))
BMP_HEAD: Final = struct.Struct("<2sIHHIIiiHHIIiiII")


@dataclass(frozen=True)
class StoredImage:
    """A square 8-bit image, which is also a file."""

    edge: int
    pixels: bytes
    """Edge in pixels, and the pixels row by row from the top."""
    frame: int
    """Number of the exposure."""
    number: int
    """Number of the image since start-up, from 1 to 255 and again from 1; the counter of its file."""
    unix_ns: int = 0
    """Time on the device's clock when it was stored."""

    kind: ClassVar[str] = "bmp"
    """Kind of the file as named in the interface definition."""
    type: ClassVar[int] = BMP_TYPE
    """Number of the kind of the file."""

    def binned(self, edge: int) -> StoredImage:
        """Return the image reduced to `edge` by averaging squares of pixels."""
        if edge == self.edge:
            return self
        image = np.frombuffer(self.pixels, dtype=np.uint8).reshape(self.edge, self.edge)
        small = mean_over_squares(image, self.edge // edge)
        return StoredImage(edge, small.tobytes(), self.frame, self.number, self.unix_ns)

    @property
    def file_size(self) -> int:
        """Size of the file, bytes."""
        return BMP_HEAD.size + len(PALETTE) + len(self.pixels)

    @cached_property
    def file_crc(self) -> int:
        """Checksum of the file."""
        return file_checksum(self.content())

    def content(self) -> bytes:
        """Return the image as a grey BMP file."""
        offset = BMP_HEAD.size + len(PALETTE)
        planes, bits, compression, per_metre, colours = 1, 8, 0, 2835, 256
        layout = (planes, bits, compression, len(self.pixels), per_metre, per_metre, colours, 0)
        head = BMP_HEAD.pack(b"BM", self.file_size, 0, 0, offset, 40, self.edge, -self.edge, *layout)
        return head + PALETTE + self.pixels


@dataclass(frozen=True)
class JpgFile:
    """A stored image that has been compressed."""

    data: bytes
    edge: int
    frame: int
    """Edge in pixels, and number of the exposure."""
    number: int
    """Number of the file among those of its kind since start-up, as that of an image."""
    unix_ns: int
    """Time on the device's clock when it was stored."""

    kind: ClassVar[str] = "jpg"
    """Kind of the file as named in the interface definition."""
    type: ClassVar[int] = JPG_TYPE
    """Number of the kind of the file."""

    @property
    def file_size(self) -> int:
        return len(self.data)

    @cached_property
    def file_crc(self) -> int:
        return file_checksum(self.data)

    def content(self) -> bytes:
        return self.data


StoredFile: TypeAlias = StoredImage | JpgFile


@dataclass(frozen=True)
class Conversion:
    """The last conversion of an image to JPG."""

    percent: int = 0
    result: str = "nothing"
    """As named in the interface definition."""
    number: int = 0
    """Number of the new file; 0 if there is none."""


@dataclass(frozen=True)
class ImageState:
    """Capture, storage and download of images at one moment."""

    files: tuple[StoredFile, ...] = ()
    """The stored files, oldest first."""
    percent: int = 0
    status: str = "ok"
    """Progress of save_image, and its state as named in the interface definition."""
    busy: bool = False
    """Whether an image is being captured or opened."""
    conversion: Conversion = Conversion()
    """Progress and result of convert_image."""
    download: StoredImage | None = None
    """The image that is open for download in chunks."""
    chunk_number: int = 0
    """Number of the loaded chunk of the open image."""

    @property
    def stored(self) -> StoredImage | None:
        """The newest stored image, or None."""
        return next((file for file in reversed(self.files) if isinstance(file, StoredImage)), None)

    @property
    def chunks(self) -> int:
        """Number of chunks of the open image; 0 if none is open."""
        return 0 if self.download is None else len(self.download.pixels) // FRAME_SIZE

    @property
    def chunk(self) -> bytes:
        """The loaded chunk of the open image; zeros if none is open."""
        if self.download is None:
            return bytes(FRAME_SIZE)
        start = self.chunk_number * FRAME_SIZE
        return self.download.pixels[start : start + FRAME_SIZE]


@dataclass(frozen=True)
class FileState:
    """The position in the list of files, the loaded block and the map of its packets at one moment."""

    position: int = 0
    """Number of files before the current one."""
    looked_up_ns: int = 0
    """Simulation time at which the current file has been looked up."""
    erased_ns: int = 0
    """Simulation time at which the last erasure of all files is complete."""
    formatting: bool = False
    """Whether that erasure is by format_card."""
    parameter_error: bool = False
    """Whether the requested file or range does not exist."""
    block: bytes = b""
    """The loaded block; empty if there is none."""
    packets: tuple[int, ...] = (0,)
    """Numbers of the packets of the last burst that an OBC which reads one at a time has still to read."""
    arrived: HoleMap = field(default_factory=HoleMap)
    """The packets of the block that have arrived."""


def msdos_time(unix_ns: int) -> int:
    """Return a UTC time in the MS-DOS format, in steps of 2 s; the nearest limit if it is not in 1980 to 2107."""
    first, last = dt.datetime(1980, 1, 1, tzinfo=dt.UTC), dt.datetime(2107, 12, 31, 23, 59, 58, tzinfo=dt.UTC)
    seconds = min(max(unix_ns // NANOSECONDS, int(first.timestamp())), int(last.timestamp()))
    time = dt.datetime.fromtimestamp(seconds, dt.UTC)
    date = (time.year - 1980) << 9 | time.month << 5 | time.day
    return date << 16 | time.hour << 11 | time.minute << 5 | time.second // 2
