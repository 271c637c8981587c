"""Grey images as PNG files."""

from __future__ import annotations

from pathlib import Path

from starhil.hil_tests.errors import BenchError
from starid.files import write_atomically


def write_png(path: Path, pixels: bytes, width: int, height: int) -> None:
    """Write a grey image atomically.

    `pixels` has 8 bits per pixel, row by row from the top.

    Raises BenchError: the number of bytes does not match the size.
    """
    import cv2
    import numpy as np

    if width < 1 or height < 1 or len(pixels) != width * height:
        raise BenchError(f"an image of {width}x{height} needs {width * height} bytes, not {len(pixels)}")
    _, data = cv2.imencode(".png", np.frombuffer(pixels, np.uint8).reshape(height, width))
    write_atomically(path, lambda part: part.write_bytes(data.tobytes()))
