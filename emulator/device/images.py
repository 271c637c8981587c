"""Images for download: capture, storage and transfer.

Stored images are files, of which the oldest gives way to a new one. A download keeps the image that it opened.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from starhil.emulator.clock import NANOSECONDS, DeviceTime
from starhil.emulator.device.cycle import FrameCycle
from starhil.emulator.device.pending import PendingAnswer
from starhil.emulator.device.scheduler import Scheduler
from starhil.emulator.device.signals import Signals
from starhil.emulator.pipeline.binning import mean_over_squares
from starhil.emulator.pipeline.imager import Imager, PipelineReply
from starhil.emulator.pipeline.messages import IMAGE_EDGES, ImageRequest, ImageResult
from starhil.protocol.image_transfer import FRAME_SIZE, file_checksum

STORE_S: Final = 0.1
"""Modelled time to store an image, seconds."""

MAX_FILES: Final = 16
"""Number of images that are kept."""

PALETTE: Final = b"".join(bytes((n, n, n, 0)) for n in range(256))
BMP_HEAD: Final = struct.Struct("<2sIHHIIiiHHIIiiII")


@dataclass(frozen=True)
class StoredImage:
    """A square 8-bit image, which is also a file."""

    edge: int
    pixels: bytes
    """Edge in pixels, and the pixels row by row from the top."""
    frame: int
    number: int
    """Number of the image since start-up, from 1 to 255 and again from 1; the counter of its file."""
    unix_ns: int = 0
    """Time on the device's clock when it was stored."""

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
        return file_checksum(self.bmp())

    def bmp(self) -> bytes:
        """Return the image as a grey BMP file."""
        offset = BMP_HEAD.size + len(PALETTE)
        planes, bits, compression, per_metre, colours = 1, 8, 0, 2835, 256
        layout = (planes, bits, compression, len(self.pixels), per_metre, per_metre, colours, 0)
        head = BMP_HEAD.pack(b"BM", self.file_size, 0, 0, offset, 40, self.edge, -self.edge, *layout)
        return head + PALETTE + self.pixels


class ImageStore:
    """Captures images, stores them and serves one for download."""

    def __init__(
        self, scheduler: Scheduler, imager: Imager, cycle: FrameCycle, time: DeviceTime, signals: Signals
    ) -> None:
        self._scheduler = scheduler
        self._imager = imager
        self._cycle = cycle
        self._time = time
        self._now_ns = time.clock.now_ns
        self._generation = 0
        signals.exposed.connect(self._exposed)
        self.clear()

    def clear(self) -> None:
        """Discard everything, because the device restarts."""
        self._generation += 1
        self._count = 0
        self._at_exposure: Callable[[], None] | None = None
        """Called once, when the next exposure has been sent to the pipeline."""
        self.files: dict[int, StoredImage] = {}
        """The stored images by number, oldest first."""
        self.percent = 0
        self.status = "ok"
        self.busy = False
        self.download: StoredImage | None = None
        self.frame = 0

    @property
    def stored(self) -> StoredImage | None:
        """The newest stored image, or None."""
        return next(reversed(self.files.values()), None)

    def save(self, edge: int) -> None:
        """Capture and store the next exposure; in standby, take one."""
        self.percent = 0
        self.status = "waiting_sensor"

        def fetch() -> None:
            self.percent, self.status = 50, "waiting_frame"
            self._fetch_image(edge, store)

        def store(answer: ImageResult | None) -> None:
            self.busy = False
            if answer is None:
                self.percent, self.status = 0, "storage_error"
                return
            self._store(answer)
            self.percent, self.status = 100, "ok"

        self._capture(fetch)

    def capture_full(self) -> PendingAnswer[ImageResult | None]:
        """Capture the next exposure in full size without storing it; the result is None on failure."""
        captured = PendingAnswer[ImageResult | None]()

        def finish(answer: ImageResult | None) -> None:
            self.busy = False
            captured.end(answer)

        self._capture(lambda: self._fetch_image(0, finish))
        return captured

    def _capture(self, then: Callable[[], None]) -> None:
        """Call `then` when the next exposure has been sent to the pipeline; in standby, take one."""
        self.busy = True
        if self._cycle.running:
            self._at_exposure = then
            return
        start_ns, exposure_ns = self._now_ns(), round(self._cycle.exposure_s * NANOSECONDS)
        generation = self._generation

        def expose(_due_ns: int) -> None:
            if generation == self._generation:
                self._imager.submit(
                    self._cycle.single_frame(start_ns + exposure_ns // 2), lambda _answer: None
                )
                then()

        self._scheduler.at(start_ns + exposure_ns, expose)

    def cycle_stopped(self) -> None:
        """Take an exposure for a pending capture, because the cycle takes no more."""
        then, self._at_exposure = self._at_exposure, None
        if then is not None:
            self._capture(then)

    def _exposed(self, _index: int) -> None:
        then, self._at_exposure = self._at_exposure, None
        if then is not None:
            then()

    def _store(self, answer: ImageResult) -> None:
        """Store an image as the newest file; the oldest one is deleted if there are too many."""
        number = self._count = self._count % 255 + 1
        self.files.pop(number, None)
        self.files[number] = StoredImage(
            answer.width, answer.pixels, answer.frame, number, self._time.unix_ns()
        )
        if len(self.files) > MAX_FILES:
            del self.files[next(iter(self.files))]

    def open_stored(self, edge: int) -> bool:
        """Open the stored image for download, reduced to `edge`; return False if it is too small."""
        if self.stored is None or edge > self.stored.edge:
            return False
        self.download = self.stored.binned(edge)
        self.frame = 0
        return True

    def open_last(self, edge: int) -> PendingAnswer[bool]:
        """Open the last exposure for download; the result is whether there was one."""
        opened = PendingAnswer[bool]()
        self.busy = True
        self.download = None

        def take(answer: ImageResult | None) -> None:
            self.busy = False
            self.frame = 0
            self.download = (
                None if answer is None else StoredImage(answer.width, answer.pixels, answer.frame, 0)
            )
            opened.end(answer is not None)

        self._fetch_image(edge, take)
        return opened

    def _fetch_image(self, edge: int, take: Callable[[ImageResult | None], None]) -> None:
        """Fetch an image from the pipeline; call `take` after `STORE_S` with it, or with None on failure."""
        generation = self._generation
        answered = PendingAnswer[PipelineReply]()

        def finish(answer: PipelineReply) -> None:
            if generation == self._generation:
                take(answer if isinstance(answer, ImageResult) and answer.frame >= 0 else None)

        self._imager.submit(ImageRequest(edge), answered.end)
        due_ns = self._now_ns() + round(STORE_S * NANOSECONDS)
        self._scheduler.at(due_ns, lambda _due_ns: answered.when_done(finish))

    @property
    def frames(self) -> int:
        """Number of image frames of the open download; 0 if none is open."""
        return 0 if self.download is None else len(self.download.pixels) // FRAME_SIZE

    def frame_bytes(self) -> bytes:
        """Return the loaded image frame of the open download."""
        if self.download is None:
            return bytes(FRAME_SIZE)
        start = self.frame * FRAME_SIZE
        return self.download.pixels[start : start + FRAME_SIZE]


def edge_of(size_name: str) -> int:
    """Return the edge in pixels of a size named in the interface definition, such as `size_512`."""
    edge = int(size_name.removeprefix("size_"))
    if edge not in IMAGE_EDGES:
        raise ValueError(f"{size_name} is not an image size")
    return edge
