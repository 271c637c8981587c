"""Reading and writing images of counts: PNG, TIFF and JPEG, one channel of 8 or 16 bits."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import Final

import cv2
import numpy as np
import numpy.typing as npt

from starid.errors import StaridError

READABLE: Final = (".png", ".tif", ".tiff", ".jpg", ".jpeg", ".pgm", ".bmp")
_WRITABLE_8: Final = (".png", ".tif", ".tiff", ".jpg", ".jpeg", ".pgm", ".bmp")
_WRITABLE_16: Final = (".png", ".tif", ".tiff", ".pgm")
_MOST_BYTES: Final = 1 << 30


def read_image(path: str | Path) -> npt.NDArray[np.uint8] | npt.NDArray[np.uint16]:
    """Read a grey image.

    Parameters
    ----------
    path : str or Path
        PNG, TIFF, JPEG, PGM or BMP file. Three equal channels are taken for the grey that they are.

    Returns
    -------
    ndarray (h, w), uint8 or uint16

    Raises
    ------
    StaridError
        The file is missing, unreadable, no image, in colour, or of other than 8 or 16 bits.
    """
    source = Path(path)
    try:
        size = source.stat().st_size
        if size > _MOST_BYTES:
            raise StaridError(f"{source}: {size} bytes is more than an image of counts can have")
        data = np.fromfile(source, dtype=np.uint8)
    except OSError as error:
        raise StaridError(f"{source}: cannot read the image: {error.strerror or error}") from None
    try:
        image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
    except cv2.error:
        image = None
    if image is None:
        raise StaridError(f"{source}: not an image that can be read; give a PNG, TIFF or JPEG file")
    if image.ndim == 3:
        colours = image[:, :, : min(image.shape[2], 3)]
        if not np.all(colours == colours[:, :, :1]):
            raise StaridError(f"{source}: image is in colour; convert it to grey (one channel) first")
        image = np.ascontiguousarray(colours[:, :, 0])
    if image.dtype == np.uint8:
        return image.astype(np.uint8, copy=False)
    if image.dtype != np.uint16:
        raise StaridError(f"{source}: image has values of type {image.dtype}; 8 or 16 bits unsigned needed")
    return image.astype(np.uint16, copy=False)


def write_image(path: str | Path, image: npt.NDArray[np.uint8] | npt.NDArray[np.uint16]) -> None:
    """Write an image of counts, whole or not at all.

    Parameters
    ----------
    path : str or Path
        The suffix chooses the format; 16 bits need PNG, TIFF or PGM.
    image : ndarray (h, w) or (h, w, 3), uint8 or uint16
        Grey, or blue-green-red.

    Raises
    ------
    StaridError
        The suffix is unknown, or the file cannot be written.
    """
    target = Path(path)
    known = _WRITABLE_8 if image.dtype == np.uint8 else _WRITABLE_16
    suffix = target.suffix.lower()
    if suffix not in known:
        bits = 8 * image.dtype.itemsize
        raise StaridError(
            f"{target}: cannot write {bits}-bit images as {suffix or 'a file without suffix'!r}; use .png"
        )
    encoded, data = cv2.imencode(suffix, image)
    if not encoded:
        raise StaridError(f"{target}: the image cannot be encoded as {suffix}")
    try:
        handle, temporary = tempfile.mkstemp(dir=target.parent, prefix=f".{target.name}.")
        try:
            with os.fdopen(handle, "wb") as stream:
                stream.write(data.tobytes())
            Path(temporary).chmod(0o666 & ~_umask())
            Path(temporary).replace(target)
        except BaseException:
            Path(temporary).unlink(missing_ok=True)
            raise
    except OSError as error:
        raise StaridError(f"{target}: cannot write the image: {error.strerror or error}") from None


def _umask() -> int:
    """Return the process's file mode mask."""
    mask = os.umask(0o022)
    os.umask(mask)
    return mask
