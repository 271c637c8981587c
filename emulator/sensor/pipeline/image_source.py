"""Images from a folder of photographs, a camera or a video, instead of rendered ones."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np
import numpy.typing as npt

from starhil.emulator.errors import EmulatorError, explained
from starid.camera import Camera
from starid.imaging.dark_frame import dark_excess, without_dark
from starid.imaging.image_io import SUFFIXES, grey_of, read_image

_MIN_BITS: Final = 8

Counts = npt.NDArray[Any]


class ImageSource(Protocol):
    """A source of images."""

    def image(self, index: int) -> Counts:
        """Return the image (h, w) of an exposure, uint8 or uint16."""
        ...


class FolderImages:
    """The images in a folder in the order of their names, one for each exposure."""

    def __init__(self, folder: Path, *, repeat: bool) -> None:
        remedy = "name a folder with PNG, TIFF, JPEG or BMP images"
        with explained(f"images.folder: {folder} cannot be read", remedy):
            self._files = sorted(
                file for file in folder.iterdir() if file.is_file() and file.suffix.lower() in SUFFIXES
            )
        self._folder = folder
        self._repeat = repeat
        if not self._files:
            raise EmulatorError(f"images.folder: {folder} contains no PNG, TIFF, JPEG or BMP")

    def image(self, index: int) -> Counts:
        """Return the image of an exposure; colour is converted to grey."""
        if index >= len(self._files) and not self._repeat:
            raise EmulatorError(
                f"images.folder: the {len(self._files)} images in {self._folder} have been used; "
                "set images.repeat = true to repeat them"
            )
        return read_image(self._files[index % len(self._files)], allow_colour=True)


class CapturedImages:
    """Images from a camera or a video, captured by OpenCV."""

    def __init__(self, capture: str) -> None:
        import cv2

        self._name = capture
        self._capture = cv2.VideoCapture(int(capture) if capture.isdecimal() else capture)
        if not self._capture.isOpened():
            raise EmulatorError(
                f"images.capture: {capture} cannot be opened; give the number of a camera (0 is the first) or a video file"
            )

    def image(self, index: int) -> Counts:  # noqa: ARG002 (a camera has only its next image)
        """Return the next image; colour is converted to grey."""
        taken, pixels = self._capture.read()
        if not taken:
            raise EmulatorError(f"images.capture: {self._name} delivers no more images")
        return np.ascontiguousarray(grey_of(pixels) if pixels.ndim == 3 else pixels)


class CheckedImages:
    """Images whose size is checked and from which a dark frame is subtracted."""

    def __init__(self, source: ImageSource, camera: Camera, dark: Path | None) -> None:
        self._source = source
        self._camera = camera
        self._excess = None if dark is None else dark_excess(read_image(dark, allow_colour=True))

    def image(self, index: int) -> Counts:
        image = self._source.image(index)
        height, width = image.shape
        if (width, height) != (self._camera.width, self._camera.height):
            raise EmulatorError(
                f"images: {width}×{height} pixels, the camera of the profile has {self._camera.width}×"
                f"{self._camera.height}; set [camera] to the camera that takes them (starid calibrate writes it)"
            )
        return image if self._excess is None else without_dark(image, self._excess)


def open_images(settings: Mapping[str, Any], camera: Camera) -> ImageSource | None:
    """Open the images named in `[images]` of a profile; None if there are none."""
    folder, capture, dark = (str(settings.get(key, "")) for key in ("folder", "capture", "dark"))
    source: ImageSource
    if folder:
        source = FolderImages(Path(folder), repeat=bool(settings.get("repeat", True)))
    elif capture:
        source = CapturedImages(capture)
    else:
        return None
    return CheckedImages(source, camera, Path(dark) if dark else None)


def used_bits(image: Counts) -> int:
    """Return the number of bits that an image uses, at least 8."""
    return max(int(image.max(initial=0)).bit_length(), _MIN_BITS)
