"""Images for download: capture, storage and transfer.

Stored images are files; a new one replaces the oldest. A download keeps the image that it has opened.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Final

from starhil.emulator.device.cycle import FrameCycle
from starhil.emulator.device.pending import PendingAnswer
from starhil.emulator.device.signals import Signals
from starhil.emulator.device.stored_images import ImageState, StoredImage
from starhil.emulator.sensor.pipeline.client import PipelineClient, PipelineReply
from starhil.emulator.sensor.pipeline.messages import IMAGE_EDGES, ImageRequest, ImageResult
from starhil.emulator.simulation.clock import DeviceTime
from starhil.emulator.simulation.scheduler import Scheduler
from starhil.protocol.icd.conventions import NANOSECONDS

STORE_S: Final = 0.1
"""Modelled time to store an image, seconds."""

MAX_FILES: Final = 16
"""Number of images that are kept."""


class ImageStore:
    """Captures images, stores them and serves one for download."""

    def __init__(
        self,
        scheduler: Scheduler,
        imager: PipelineClient,
        cycle: FrameCycle,
        time: DeviceTime,
        signals: Signals,
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
        self.state = ImageState()
        """The present state; each change makes a new one."""

    def _change(self, **changes: Any) -> None:
        self.state = replace(self.state, **changes)

    def load_chunk(self, number: int) -> None:
        """Load a chunk of the open image."""
        self._change(chunk_number=number)

    def erase(self, number: int) -> bool:
        """Erase a stored image; return False if it does not exist."""
        kept = tuple(image for image in self.state.files if image.number != number)
        existed = len(kept) < len(self.state.files)
        self._change(files=kept)
        return existed

    def erase_all(self) -> None:
        """Erase all stored images."""
        self._change(files=())

    def save(self, edge: int) -> None:
        """Capture and store the next exposure; in standby, take one."""
        self._change(percent=0, status="waiting_sensor")

        def fetch() -> None:
            self._change(percent=50, status="waiting_frame")
            self._fetch_image(edge, store)

        def store(answer: ImageResult | None) -> None:
            if answer is None:
                self._change(busy=False, percent=0, status="storage_error")
                return
            self._store(answer)
            self._change(busy=False, percent=100, status="ok")

        self._capture(fetch)

    def capture_full(self) -> PendingAnswer[ImageResult | None]:
        """Capture the next exposure in full size without storing it; the result is None on failure."""
        captured = PendingAnswer[ImageResult | None]()

        def finish(answer: ImageResult | None) -> None:
            self._change(busy=False)
            captured.end(answer)

        self._capture(lambda: self._fetch_image(0, finish))
        return captured

    def _capture(self, then: Callable[[], None]) -> None:
        """Call `then` when the next exposure has been sent to the pipeline; in standby, take one."""
        self._change(busy=True)
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
        self.erase(number)
        stored = StoredImage(answer.width, answer.pixels, answer.frame, number, self._time.unix_ns())
        self._change(files=(*self.state.files, stored)[-MAX_FILES:])

    def open_stored(self, edge: int) -> bool:
        """Open the stored image for download, reduced to `edge`; return False if it is too small."""
        stored = self.state.stored
        if stored is None or edge > stored.edge:
            return False
        self._change(download=stored.binned(edge), chunk_number=0)
        return True

    def open_last(self, edge: int) -> PendingAnswer[bool]:
        """Open the last exposure for download; the result is whether there was one."""
        opened = PendingAnswer[bool]()
        self._change(busy=True, download=None)

        def take(answer: ImageResult | None) -> None:
            image = None if answer is None else StoredImage(answer.width, answer.pixels, answer.frame, 0)
            self._change(busy=False, download=image, chunk_number=0)
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


def edge_of(size_name: str) -> int:
    """Return the edge in pixels of a size named in the interface definition, such as `size_512`."""
    edge = int(size_name.removeprefix("size_"))
    if edge not in IMAGE_EDGES:
        raise ValueError(f"{size_name} is not an image size")
    return edge
