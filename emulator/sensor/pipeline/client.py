"""The device's access to the image pipeline: a process or thread that handles requests in order.

The device does not wait: it submits a request and is called back in the event loop. The stepped clock uses
`settle` to wait for all pending results before it advances.
"""

from __future__ import annotations

import asyncio
import logging
import pickle
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Protocol, TypeAlias

from starhil.emulator.errors import EmulatorError, one_line
from starhil.emulator.sensor.pipeline.messages import (
    LENGTH,
    Failure,
    FrameRequest,
    FrameResult,
    ImageRequest,
    ImageResult,
    IndexReady,
    IndexRequest,
    JpgRequest,
    JpgResult,
    PipelineEnded,
    PipelineReady,
    PipelineSetup,
    with_length,
)
from starhil.emulator.sensor.pipeline.worker_process import Worker
from starhil.emulator.simulation.guard import call_guarded
from starhil.emulator.simulation.signal import Signal

log = logging.getLogger("starhil.pipeline")

PipelineRequest: TypeAlias = FrameRequest | ImageRequest | JpgRequest
PipelineReply: TypeAlias = FrameResult | ImageResult | JpgResult | IndexReady | Failure
ReplyCallback: TypeAlias = Callable[[PipelineReply], None]


class PipelineClient(Protocol):
    """Interface of the image pipeline for the device."""

    @property
    def pending(self) -> int:
        """Number of requests without a result."""

    def submit(self, request: PipelineRequest, done: ReplyCallback) -> None:
        """Queue a request; `done` is called once, in the event loop, in the order of the requests."""

    async def settle(self) -> None:
        """Wait until no requests are pending."""


class WorkerClient:
    """The pipeline in a worker, a process or a thread, connected by a socket pair.

    Numerics do not run in the emulator's process, so that its replies on the bus never wait for the interpreter lock,
    unless a thread was chosen.
    """

    def __init__(self, setup: PipelineSetup, worker: Worker) -> None:
        self.worker = worker
        self.ended = Signal[str]("end of the image pipeline")
        """The pipeline has ended after it was ready, and why; a failed start raises instead."""
        self.watchers: set[object] = set()
        """Viewers of the frames; frames come with a preview unless this is empty."""
        self._setup = setup
        self._waiting: deque[ReplyCallback] = deque()
        self._idle = asyncio.Event()
        self._idle.set()
        self._started: asyncio.Future[PipelineReady] = asyncio.get_running_loop().create_future()
        self._writer: asyncio.StreamWriter | None = None
        self._task: asyncio.Task[None] | None = None
        self._closing = False

    @property
    def pending(self) -> int:
        """Number of requests without a result."""
        return len(self._waiting)

    async def settle(self) -> None:
        """Wait until no requests are pending."""
        await self._idle.wait()

    async def start(self) -> PipelineReady:
        """Wait until the pipeline is ready; raise EmulatorError with the reason if it fails, in one line."""
        self._started = asyncio.get_running_loop().create_future()
        reader, self._writer = await asyncio.open_connection(sock=self.worker.socket)
        self._writer.write(with_length(self._setup))
        self._task = asyncio.create_task(self._read_messages(reader))
        return await self._started

    async def restart(self) -> PipelineReady:
        """Start another worker after one has ended, and wait until it is ready.

        EmulatorError if the start failed, OSError if the process could not be created.
        """
        self._disconnect()
        await asyncio.get_running_loop().run_in_executor(None, self.worker.end)
        self.worker = type(self.worker)()
        return await self.start()

    def submit(self, request: PipelineRequest, done: ReplyCallback) -> None:
        """Send a request to the worker, for a preview too if anything shows the images."""
        if self._writer is None:
            done(PipelineEnded("pipeline worker: not running"))
            return
        if self.watchers and isinstance(request, FrameRequest):
            request = replace(request, preview=True)
        self._send(self._writer, request, done)

    def prepare(self, request: IndexRequest) -> None:
        """Let the requests after this one wait for a star index; why it cannot be built, the next frame reports."""
        if self._writer is not None:
            self._send(self._writer, request, lambda _reply: None)

    def _send(
        self, writer: asyncio.StreamWriter, request: PipelineRequest | IndexRequest, done: ReplyCallback
    ) -> None:
        data = with_length(request)
        self._waiting.append(done)
        self._idle.clear()
        writer.write(data)

    def _disconnect(self) -> None:
        """Close the connection; requests fail until another worker is connected."""
        if self._writer is not None:
            self._writer.close()
            self._writer = None

    async def _read_messages(self, reader: asyncio.StreamReader) -> None:
        try:
            while True:
                (length,) = LENGTH.unpack(await reader.readexactly(LENGTH.size))
                message: Any = pickle.loads(await reader.readexactly(length))  # noqa: S301 (from our child process)
                if isinstance(message, str):
                    text = message
                    break
                self._handle_message(message)
        except (asyncio.IncompleteReadError, ConnectionError):
            text = "pipeline worker: ended unexpectedly; see the last lines of stderr"
        except Exception as error:  # noqa: BLE001 (nothing that follows in the stream can be trusted)
            text = f"pipeline worker: its reply cannot be read: {one_line(error)}"
        if not self._closing:
            self._disconnect()
            self._pipeline_ended(text)

    def _handle_message(self, message: PipelineReady | PipelineReply) -> None:
        if isinstance(message, PipelineReady):
            if not self._started.done():
                self._started.set_result(message)
        elif isinstance(message, Failure) and not self._started.done():
            self._start_failed(message.text)
        else:
            self._deliver_reply(message)

    def _deliver_reply(self, reply: PipelineReply) -> None:
        done = self._waiting.popleft()
        call_guarded("result of the image pipeline", done, reply)
        if not self._waiting:
            self._idle.set()

    def _start_failed(self, text: str) -> None:
        if not self._started.done():
            self._started.set_exception(EmulatorError(text))

    def _pipeline_ended(self, text: str) -> None:
        """Let all pending requests fail, and report the end to the caller of `start` or by the signal `ended`."""
        started = self._started
        was_ready = started.done() and not started.cancelled() and started.exception() is None
        self._start_failed(text)
        while self._waiting:
            self._deliver_reply(PipelineEnded(text))
        if was_ready:
            log.error("%s", text)
            self.ended.emit(text)

    async def close(self) -> None:
        self._closing = True
        self._disconnect()
        if self._task is not None:
            self._task.cancel()
        await asyncio.get_running_loop().run_in_executor(None, self.worker.end)
        self._waiting.clear()
        self._idle.set()
        if self._started.done() and not self._started.cancelled():
            self._started.exception()  # asyncio would report a failed start again at exit
