"""A whole run for tests: a pipeline that renders no images, and a peer on the control channel."""

import asyncio
import json
from collections.abc import Callable
from dataclasses import replace

from starhil.emulator.device.pending import PendingAnswer
from starhil.emulator.sensor.pipeline.client import PipelineReply, PipelineRequest, ReplyCallback
from starhil.emulator.sensor.pipeline.messages import FrameRequest, IndexRequest, PipelineReady
from starhil.emulator.simulation.signal import Signal
from starhil.protocol.messages import ErrorCode, Request
from tests.waiting import until

CAMERA = {
    "width": 937,
    "height": 937,
    "model": "pinhole",
    "focal_px": [1220.0, 1220.0],
    "centre_px": [468.0, 468.0],
    "distortion": [0.0] * 5,
}


class DirectImager:
    """Answers each request at once, in the call that submits it."""

    pending = 0

    def __init__(self, handle: Callable[[PipelineRequest], PipelineReply]) -> None:
        self._handle = handle

    def submit(self, request: PipelineRequest, done: ReplyCallback) -> None:
        """Do the request and call back."""
        done(self._handle(request))

    async def settle(self) -> None:
        """Nothing is ever pending."""


class FakeImager(DirectImager):
    """A pipeline that is ready at once, and makes previews while somebody looks."""

    def __init__(self, handle: Callable[[PipelineRequest], PipelineReply]) -> None:
        super().__init__(handle)
        self.watchers: set[object] = set()
        self.ended = Signal[str]("end of the pipeline")

    def submit(self, request: PipelineRequest, done: ReplyCallback) -> None:
        if self.watchers and isinstance(request, FrameRequest):
            request = replace(request, preview=True)
        super().submit(request, done)

    def prepare(self, request: IndexRequest) -> None:
        """There is no star index."""

    async def start(self) -> PipelineReady:
        return PipelineReady(CAMERA, 5, 0.0)

    async def close(self) -> None:
        return


class FirstHead:
    """The first head of a run, and the run with its truth, its clock and all fields of its ready line."""

    def __init__(self, run, fields=()) -> None:
        self.run = run
        self._fields = fields

    def __getattr__(self, name):
        run = self.run
        return next(getattr(part, name) for part in (run.heads[0], run, run.truth) if hasattr(part, name))

    @property
    def ready_fields(self):
        run = self.run
        truth = {"truth": run.truth.address} if run.truth.address else {}
        return {**truth, **run.heads[0].ready_fields, **dict(self._fields)}


def command(emulation, name, **values) -> ErrorCode | None:
    """Send a telecommand past the links; return its error code, or None while its outcome is open."""
    row = emulation.device.icd.telecommands[name]
    answer = emulation.requests.handle(Request.of(row.id, row.encode(values)))
    return None if isinstance(answer, PendingAnswer) else ErrorCode(answer[0].code)


def read(emulation, name) -> dict:
    """Read telemetry past the links, in physical units."""
    return emulation.device.icd.telemetry[name].decode(
        emulation.requests.telemetry(name, emulation.device.snapshot())
    )


class Control:
    """A peer on the control channel."""

    def __init__(self, emulation) -> None:
        self.address = emulation.ready_fields["control"]

    async def __aenter__(self):
        path = self.address.removeprefix("unix:")
        if path != self.address:
            self.reader, self.writer = await asyncio.open_unix_connection(path)
        else:
            self.reader, self.writer = await asyncio.open_connection(*self.address.rsplit(":", 1))
        return self

    async def __aexit__(self, *_exc):
        self.writer.close()

    async def raw(self, line: bytes) -> dict:
        self.writer.write(line + b"\n")
        return json.loads(await self.reader.readline())

    async def do(self, action, **values) -> dict:
        return await self.raw(json.dumps({"do": action, **values}).encode())


async def every_row_read(emulation):
    """Wait until console or recording, whose requests are not counted, has read every telemetry row."""
    read, telemetry = set(), emulation.requests.telemetry

    def note(name, snapshot, hits=()):
        read.add(name)
        return telemetry(name, snapshot, hits)

    emulation.requests.telemetry = note
    await until(lambda: len(read) >= len(emulation.device.icd.telemetry))
