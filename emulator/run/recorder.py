"""The tape of a run: all inputs of the device with their times, and all its output.

An entry is an input that causes the model to compute: data on a link, an event that is due, a reply of the pipeline,
a message of a feed, a command on the control channel, the end of a write, or the end and restart of the pipeline. The
clock stops while an entry is processed, so that a run on the real clock can be repeated exactly on the stepped clock.

A recording is a folder: `run.json` (profile and version), `events.jsonl` (entries and output, one JSON object per
line, in order, the last one `end`), `truth.csv` (truth log), and other files that the run needs: `scenario.json`, `state/`.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, TypeVar

from starhil.emulator.device.device import Background
from starhil.emulator.errors import EmulatorError
from starhil.emulator.run.tape import End, LinkItem, PipelineAnswer, Stored, TimedEntry
from starhil.emulator.run.wiring import Wiring
from starhil.emulator.sensor.pipeline.client import (
    PipelineClient,
    PipelineReply,
    PipelineRequest,
    ReplyCallback,
)
from starhil.emulator.sensor.pipeline.messages import PipelineEnded
from starhil.emulator.simulation.clock import LatchedClock
from starhil.emulator.simulation.output_file import Output, OutputFile
from starhil.protocol.can.frame import CanFrame
from starhil.protocol.transports.base import Transport
from starhil.protocol.transports.paced import SerialTransport

Item = TypeVar("Item", bytes, CanFrame)
Done = Callable[[EmulatorError | None], None]

RUN_FILE: Final = "run.json"
EVENTS_FILE: Final = "events.jsonl"
TRUTH_FILE: Final = "truth.csv"
SCENARIO_FILE: Final = "scenario.json"
STATE_FOLDER: Final = "state"


class Recorder(Wiring):
    """Writes the tape of a run, which `inner` connects to the world."""

    records = repeatable = True

    def __init__(self, folder: Path, inner: Wiring) -> None:
        self._latched = None if (running := inner.clock.running).stepped else LatchedClock(running)
        super().__init__(self._latched or inner.clock)
        self._inner = inner
        self.folder = folder
        self.file: OutputFile | None = None
        self.output = Output(f"recording {folder}")
        self._held: list[Callable[[], None]] | None = []
        """Entries that arrived while the links were being opened, which takes no time on the tape; None
        afterwards."""

    def open(self) -> OutputFile:
        """Create the tape in the folder, which must exist."""
        self.file = OutputFile("recording", self.folder / EVENTS_FILE, output=self.output)
        return self.file

    def begin(self) -> None:
        """Process the entries that arrived while the links were being opened."""
        held, self._held = self._held or [], None
        for entry in held:
            entry()

    def when_open(self, entry: Callable[[], None]) -> None:
        """Process an entry now, or once everything is open."""
        if self._held is None:
            entry()
        else:
            self._held.append(entry)

    def latch(self) -> None:
        """Let the clock show the present time."""
        if self._latched is not None:
            self._latched.latch()

    def enter(self, entry: type[TimedEntry], **values: Any) -> None:
        """Set the clock to the current time, and write an entry with these values."""
        self.latch()
        self.write(entry, **values)

    def write(self, entry: type[TimedEntry], **values: Any) -> None:
        if self.file is not None:
            ns = self.clock.now_ns()
            self.file.append(lambda: entry(ns=ns, **values).line())

    def serial(self, name: str, make: Callable[[], SerialTransport]) -> SerialTransport:
        """Return the transport of a link that carries bytes, whose items are recorded."""
        return _RecordedSerial(self._inner.serial(name, make), name, self)

    def can(self, name: str, make: Callable[[], Transport[CanFrame]]) -> Transport[CanFrame]:
        """Return the transport of a CAN link, whose items are recorded."""
        return _RecordedTransport(self._inner.can(name, make), name, self)

    def imager(self, inner: PipelineClient) -> PipelineClient:
        """Return a pipeline whose replies are recorded as entries."""
        return _RecordedPipeline(self._inner.imager(inner), self)

    def background(self, inner: Background) -> Background:
        """Return a function whose writes end with an entry, unless they end at once (stepped clock)."""
        inner = self._inner.background(inner)
        if self._latched is None:
            return inner

        def background(work: Callable[[], None], done: Done) -> None:
            def ended(error: EmulatorError | None) -> None:
                def entry() -> None:
                    self.enter(Stored)
                    done(error)

                self.when_open(entry)

            inner(work, ended)

        return background

    def end(self) -> None:
        """Write the last entry, without which the tape is truncated."""
        self.write(End)

    def discard(self) -> None:
        """Remove the folder, whose content this run has made, because the run was rejected."""
        shutil.rmtree(self.folder, ignore_errors=True)


class _RecordedTransport(Transport[Item]):
    """A transport whose input and output are recorded."""

    def __init__(self, inner: Transport[Item], name: str, recorder: Recorder) -> None:
        super().__init__(inner.description, inner.statistics)
        self._inner: Transport[Item] = inner
        self._name = name
        self._recorder = recorder

    async def _open(self) -> None:
        await self._inner.start(self._received, self._on_error)
        self.description = self._inner.description

    def _received(self, item: Item) -> None:
        def entry() -> None:
            self._recorder.enter(LinkItem, do="in", link=self._name, data=LinkItem.data_of(item))
            self._receive(item)

        self._recorder.when_open(entry)

    def publish(self) -> None:
        self._inner.publish()

    def send(self, item: Item) -> bool:
        self._recorder.write(LinkItem, do="out", link=self._name, data=LinkItem.data_of(item))
        return self._inner.send(item)

    async def drain(self) -> None:
        await self._inner.drain()

    async def close(self) -> None:
        await self._inner.close()


class _RecordedSerial(_RecordedTransport[bytes], SerialTransport):
    """A serial line whose bytes are recorded."""

    def __init__(self, inner: SerialTransport, name: str, recorder: Recorder) -> None:
        super().__init__(inner, name, recorder)
        self._port = inner

    def set_baud(self, baud: int) -> None:
        self._port.set_baud(baud)


class _RecordedPipeline:
    """A pipeline whose replies are recorded as entries."""

    def __init__(self, inner: PipelineClient, recorder: Recorder) -> None:
        self._inner = inner
        self._recorder = recorder

    @property
    def pending(self) -> int:
        return self._inner.pending

    def submit(self, request: PipelineRequest, done: ReplyCallback) -> None:
        def arrived(reply: PipelineReply) -> None:
            self._recorder.enter(
                PipelineAnswer, ended=reply.text if isinstance(reply, PipelineEnded) else None
            )
            done(reply)

        self._inner.submit(request, arrived)

    async def settle(self) -> None:
        await self._inner.settle()
