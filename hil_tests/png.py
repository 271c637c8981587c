"""Grey pictures as PNG files, with the standard library alone."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Final

from starhil.hil_tests.errors import BenchError
from starhil.hil_tests.results import write_whole

_SIGNATURE: Final = b"\x89PNG\r\n\x1a\n"
_GREY: Final = 0


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def encode_png(pixels: bytes, width: int, height: int) -> bytes:
    """Encode a grey picture of 8 bits a pixel, rows from the top, as a PNG file (RFC 2083).

    Parameters
    ----------
    pixels : bytes
        `width * height` bytes, row by row.
    width, height : int
        Size in pixels.

    Raises
    ------
    BenchError
        The number of bytes does not fit the size.
    """
    if width < 1 or height < 1 or len(pixels) != width * height:
        raise BenchError(f"a picture of {width}x{height} needs {width * height} bytes, {len(pixels)} given")
    header = struct.pack(">IIBBBBB", width, height, 8, _GREY, 0, 0, 0)
    rows = b"".join(b"\0" + pixels[row * width : (row + 1) * width] for row in range(height))
    return (
        _SIGNATURE + _chunk(b"IHDR", header) + _chunk(b"IDAT", zlib.compress(rows, 6)) + _chunk(b"IEND", b"")
    )


def write_png(path: Path, pixels: bytes, width: int, height: int) -> None:
    """Write a grey picture of 8 bits a pixel to `path`, whole or not at all."""
    data = encode_png(pixels, width, height)
    write_whole(path, data)
