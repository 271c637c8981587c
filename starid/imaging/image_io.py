"""Reading and writing of grey PNG, TIFF, JPEG and BMP images of 8 or 16 bits."""

from __future__ import annotations

import contextlib
import os
import threading
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from starid.arithmetic.arrays import GreyImage
from starid.arithmetic.matrices import product
from starid.errors import StaridError
from starid.storage.files import MEGABYTE, is_stream, read_bytes, write_atomically

IMAGE_LIMIT: Final = 1000 * MEGABYTE
"""Largest image file that is read, bytes: a 16-bit colour TIFF of the largest cameras has about 900 MB."""

PIXEL_LIMIT: Final = 200_000_000
"""Largest image that is processed, pixels: those of the largest cameras have 150 million; each takes some 30 bytes of memory."""

_PNG: Final = b"\x89PNG\r\n\x1a\n"
_PNG_SIZE: Final = (16, 20)
"""Where width and height of a PNG begin, of 4 bytes each."""
_JPEG: Final = b"\xff\xd8\xff"
_TIFFS: Final = (b"II*\x00", b"MM\x00*")
_BMP: Final = b"BM"
SUFFIXES: Final = (".png", ".tif", ".tiff", ".jpg", ".jpeg", ".bmp")
_FORMATS_OF_8_BITS: Final = {".jpg": "JPEG", ".jpeg": "JPEG", ".bmp": "BMP"}
_CHUNK_FRAME: Final = 12
_STDERR: Final = 2
_stderr_lock: Final = threading.Lock()
_GREY_WEIGHTS: Final = np.array([0.114, 0.587, 0.299])
"""Weights of blue, green and red in the luma of ITU-R BT.601."""


def read_image(path: str | Path, *, allow_colour: bool = False) -> GreyImage:
    """Read an 8- or 16-bit grey PNG, TIFF, JPEG or BMP.

    Parameters
    ----------
    path : path
        The file.
    allow_colour : bool
        Convert a colour image to grey (BT.601 luma, alpha dropped) instead of rejecting it.

    Returns
    -------
    ndarray (height, width) of uint8 or uint16
        Row 0 is the top.

    Raises
    ------
    StaridError
        The file is missing, truncated, in colour, or not such an image; or every pixel has the same value.
    """
    source = Path(path)
    try:
        content = read_bytes(source, IMAGE_LIMIT)
    except FileNotFoundError:
        raise StaridError(f"image {source}: no such file; give a PNG, TIFF, JPEG or BMP") from None
    except OSError as error:
        raise StaridError(
            f"image {source}: cannot be read ({error.strerror}); give a readable file"
        ) from None
    _check_whole(source, content)
    if content.startswith(_PNG):
        _check_size(source, *(int.from_bytes(content[at : at + 4], "big") for at in _PNG_SIZE))
    pixels = _decode(source, content)
    _check_size(source, *pixels.shape[1::-1])
    if pixels.ndim == 3:
        if not allow_colour:
            raise StaridError(
                f"image {source}: has {pixels.shape[2]} channels, but star sensor images are grey; "
                "convert it, allow colour (--allow-colour), or give its field of view (--fov)"
            )
        pixels = grey_of(pixels)
    if pixels.dtype not in (np.uint8, np.uint16):
        raise StaridError(f"image {source}: pixels must be integers of 8 or 16 bits, not {pixels.dtype}")
    low, high = int(pixels.min()), int(pixels.max())
    if low == high:
        appearance = {0: "all black", 256**pixels.dtype.itemsize - 1: "all white"}.get(
            low, "without any contrast"
        )
        raise StaridError(f"image {source}: {appearance}, every pixel is {low}; give an image with stars")
    return np.ascontiguousarray(pixels)


def grey_of(pixels: NDArray[Any]) -> NDArray[Any]:
    """Luma (h, w) of an image (h, w, 3 or 4) in BGR order, of the same type; alpha is dropped."""
    grey: NDArray[Any] = np.rint(product(pixels[:, :, :3], _GREY_WEIGHTS)).astype(pixels.dtype)
    return grey


def image_suffix(path: Path) -> str:
    """Return the suffix that selects the output format; .png for a device or pipe without one.

    Raises
    ------
    StaridError
        The suffix is not supported, or the path is a folder.
    """
    if path.is_dir():
        raise StaridError(f"image {path}: is a folder; name a file in it")
    suffix = path.suffix.lower() or (".png" if is_stream(path) else "")
    if suffix not in SUFFIXES:
        raise StaridError(f"image {path}: suffix must be one of {', '.join(SUFFIXES)}, not {suffix!r}")
    return suffix


def write_image(path: str | Path, image: GreyImage) -> None:
    """Write a grey or colour image atomically.

    Parameters
    ----------
    path : path
        Its suffix selects the format: .png, .tif, .tiff, .bmp (8 bit only), .jpg or .jpeg (8 bit only, lossy); a
        device or pipe without one gets a PNG.
    image : ndarray (height, width) or (height, width, 3) of uint8 or uint16
        Colour in BGR order.

    Raises
    ------
    StaridError
        The suffix is not supported, or the file cannot be written.
    """
    import cv2

    target = Path(path)
    suffix = image_suffix(target)
    if image.dtype == np.uint16 and suffix in _FORMATS_OF_8_BITS:
        raise StaridError(
            f"image {target}: {_FORMATS_OF_8_BITS[suffix]} holds 8 bits per pixel, this image has 16; "
            "write a PNG or TIFF"
        )
    done, packed = cv2.imencode(suffix, image)
    if not done:
        raise StaridError(
            f"image {target}: shape {image.shape} of {image.dtype} cannot be written as {suffix}"
        )
    try:
        write_atomically(target, lambda part: part.write_bytes(packed.tobytes()))
    except OSError as error:
        raise StaridError(
            f"image {target}: cannot be written ({error.strerror}); choose another path"
        ) from None


def _check_whole(source: Path, content: bytes) -> None:
    """Reject files that are not PNG, TIFF, JPEG or BMP, and truncated PNG and JPEG files."""
    if content.startswith(_PNG):
        whole = _png_is_whole(content)
    elif content.startswith(_JPEG):
        whole = content.rfind(b"\xff\xd9") > content.rfind(b"\xff\xda")
    elif content.startswith((*_TIFFS, _BMP)):
        whole = True
    else:
        what = "is empty" if not content else "is not a PNG, TIFF, JPEG or BMP"
        raise StaridError(f"image {source}: {what}; give a grey image of 8 or 16 bits")
    if not whole:
        raise _truncated(source)


def _check_size(source: Path, width: int, height: int) -> None:
    """Reject an image that would take the memory of the machine."""
    if width * height > PIXEL_LIMIT:
        raise StaridError(
            f"image {source}: {width} × {height} pixels are more than {PIXEL_LIMIT // 1_000_000} million; crop it, or reduce its size"
        )


def _truncated(source: Path) -> StaridError:
    return StaridError(f"image {source}: truncated or damaged; write or download the file again")


def _png_is_whole(content: bytes) -> bool:
    """Whether every chunk of a PNG has a correct checksum and the end chunk is present."""
    at = len(_PNG)
    while at + _CHUNK_FRAME <= len(content):
        size = int.from_bytes(content[at : at + 4], "big")
        end = at + _CHUNK_FRAME + size
        if end > len(content):
            return False
        body = content[at + 4 : end - 4]
        if zlib.crc32(body) != int.from_bytes(content[end - 4 : end], "big"):
            return False
        if body[:4] == b"IEND":
            return True
        at = end
    return False


@contextlib.contextmanager
def _without_stderr() -> Iterator[None]:
    """Discard what is written to stderr: libpng reports errors and warnings there, and OpenCV cannot turn that off.

    This includes other threads, for the few milliseconds that it takes to decode an image.
    """
    with _stderr_lock, contextlib.ExitStack() as stack:
        try:
            kept = os.dup(_STDERR)
        except OSError:  # there is no stderr
            yield
            return
        stack.callback(os.close, kept)
        nowhere = os.open(os.devnull, os.O_WRONLY)
        stack.callback(os.close, nowhere)
        os.dup2(nowhere, _STDERR)
        stack.callback(os.dup2, kept, _STDERR)
        yield


def _decode(source: Path, content: bytes) -> NDArray[Any]:
    """Decode the pixels (height, width) or (height, width, channels) as stored."""
    import cv2

    log: Any = getattr(cv2.utils, "logging", cv2)  # moved in OpenCV 5
    level = log.getLogLevel()
    log.setLogLevel(0)
    try:
        with _without_stderr() if content.startswith(_PNG) else contextlib.nullcontext():
            pixels = cv2.imdecode(np.frombuffer(content, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        remedy = (
            "crop it, or reduce its size" if "MAX_IMAGE_PIXELS" in str(error.err) else "convert it to PNG"
        )
        raise StaridError(f"image {source}: cannot be decoded ({error.err}); {remedy}") from None
    finally:
        log.setLogLevel(level)
    if pixels is None or pixels.size == 0:
        if content.startswith(_BMP):
            raise StaridError(
                f"image {source}: truncated, damaged or a BMP of an unsupported kind; convert it to PNG"
            )
        raise _truncated(source)
    return np.asarray(pixels)
