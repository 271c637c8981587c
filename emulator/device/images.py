"""Images for download: capture, storage, compression and transfer.

Stored images are files, and so are those compressed from them; a new one replaces the oldest. A download keeps the
image that it has opened.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Final

from starhil.emulator.device.cycle import FrameCycle
from starhil.emulator.device.pending import PendingAnswer
from starhil.emulator.device.signals import Signals
from starhil.emulator.device.stored_images import Conversion, ImageState, JpgFile, StoredFile, StoredImage
from starhil.emulator.sensor.pipeline.client import PipelineClient, PipelineReply, PipelineRequest
from starhil.emulator.sensor.pipeline.messages import (
    IMAGE_EDGES,
    ImageRequest,
    ImageResult,
    JpgRequest,
    JpgResult,
)
from starhil.emulator.simulation.clock import DeviceTime
from starhil.emulator.simulation.scheduler import Scheduler
from starhil.protocol.icd.conventions import NANOSECONDS

STORE_S: Final = 0.1
"""Modelled time to store an image, seconds."""

CONVERT_S: Final = 0.5
"""Modelled time to compress an image, seconds."""

MAX_FILES: Final = 16
"""Number of files that are kept."""


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
        self._counts = dict.fromkeys((StoredImage.kind, JpgFile.kind), 0)
        self._at_exposure: Callable[[], None] | None = None
        """Called once, when the next exposure has been sent to the pipeline."""
        self.state = ImageState()
        """The present state; each change makes a new one."""

    def _change(self, **changes: Any) -> None:
        self.state = replace(self.state, **changes)

    def load_chunk(self, number: int) -> None:
        self._change(chunk_number=number)

    def file(self, kind: str, number: int) -> StoredFile | None:
        """Return a file by its kind and its number within it; None if there is none."""
        return next((file for file in self.state.files if (file.kind, file.number) == (kind, number)), None)

    def erase(self, kind: str, number: int) -> bool:
        """Erase a file; return False if it does not exist."""
        found = self.file(kind, number)
        self._change(files=tuple(file for file in self.state.files if file is not found))
        return found is not None

    def erase_all(self) -> None:
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

    def convert(self, number: int, quality: int) -> None:
        """Compress a stored image, and store it as a file; `quality` 100 loses least, 1 most."""
        source = self.file(StoredImage.kind, number)
        if not isinstance(source, StoredImage):
            self._change(conversion=Conversion(result="load_error"))
            return
        self._change(conversion=Conversion(result="busy"))

        def store(answer: PipelineReply) -> None:
            if not isinstance(answer, JpgResult):
                self._change(conversion=Conversion(result="load_error"))
                return
            made = self._next_number(JpgFile.kind)
            self._add(JpgFile(answer.data, source.edge, source.frame, made, self._time.unix_ns()))
            self._change(conversion=Conversion(100, "success", made))

        self._ask(JpgRequest(source.edge, source.pixels, quality), CONVERT_S, store)

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
        number = self._next_number(StoredImage.kind)
        self._add(StoredImage(answer.width, answer.pixels, answer.frame, number, self._time.unix_ns()))

    def _next_number(self, kind: str) -> int:
        """Return the number of the next file of a kind, from 1 to 255 and again from 1."""
        number = self._counts[kind] = self._counts[kind] % 255 + 1
        return number

    def _add(self, file: StoredFile) -> None:
        """Store the newest file, in the place of one with its number; delete the oldest if there are too many."""
        self.erase(file.kind, file.number)
        self._change(files=(*self.state.files, file)[-MAX_FILES:])

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
        self._ask(
            ImageRequest(edge),
            STORE_S,
            lambda answer: take(answer if isinstance(answer, ImageResult) and answer.frame >= 0 else None),
        )

    def _ask(self, request: PipelineRequest, after_s: float, take: Callable[[PipelineReply], None]) -> None:
        """Ask the pipeline; call `take` with its answer, not before a time, and never after a restart of the device."""
        generation = self._generation
        answered = PendingAnswer[PipelineReply]()

        def finish(answer: PipelineReply) -> None:
            if generation == self._generation:
                take(answer)

        self._imager.submit(request, answered.end)
        due_ns = self._now_ns() + round(after_s * NANOSECONDS)
        self._scheduler.at(due_ns, lambda _due_ns: answered.when_done(finish))


def edge_of(size_name: str) -> int:
    """Return the edge in pixels of a size named in the interface definition, such as `size_512`."""
    edge = int(size_name.removeprefix("size_"))
    if edge not in IMAGE_EDGES:
        raise ValueError(f"{size_name} is not an image size")
    return edge
