"""A whole run for tests: a pipeline that renders no images, and a peer on the control channel."""

import asyncio
import json

from starhil.emulator.pipeline.imager import DirectImager
from starhil.emulator.pipeline.messages import PipelineReady

CAMERA = {"focal_px": [1220.0, 1220.0], "centre_px": [468.0, 468.0], "distortion": [0.0] * 5}


class FakeImager(DirectImager):
    """A pipeline that is ready at once."""

    on_failure = None

    async def start(self) -> PipelineReady:
        return PipelineReady(CAMERA, 5, 0.0)

    async def close(self) -> None:
        return


class Control:
    """A peer on the control channel."""

    def __init__(self, emulation) -> None:
        self.address = emulation.ready_words["control"]

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
