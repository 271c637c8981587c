"""The device's access to the image pipeline: a process or thread that handles requests in order.

The device does not wait: it submits a request and is called back in the event loop. The stepped clock uses
`settle` to wait for all pending results before it advances.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import pickle
import queue
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Protocol, TypeAlias

from starhil.emulator.errors import EmulatorError
from starhil.emulator.guard import call_guarded, one_line
from starhil.emulator.pipeline.messages import (
    LENGTH,
    Failure,
    FrameRequest,
    FrameResult,
    ImageRequest,
    ImageResult,
    PipelineReady,
    PipelineSetup,
)
from starhil.emulator.pipeline.worker_process import EXIT_GRACE_S, WorkerProcess
from starhil.emulator.signals import Signal

log = logging.getLogger("starhil.pipeline")

PipelineRequest: TypeAlias = FrameRequest | ImageRequest
PipelineReply: TypeAlias = FrameResult | ImageResult | Failure
ReplyCallback: TypeAlias = Callable[[PipelineReply], None]


class Imager(Protocol):
    """Interface of the image pipeline for the device."""

    @property
    def pending(self) -> int:
        """Number of requests without a result."""
        ...

    def submit(self, request: PipelineRequest, done: ReplyCallback) -> None:
        """Queue a request; `done` is called once, in the event loop, in the order of the requests."""
        ...

    async def settle(self) -> None:
        """Wait until no requests are pending."""
        ...


class PipelineImager(Imager, Protocol):
    """An image pipeline that can be started, and started again after an unexpected end."""

    ended: Signal[str]
    """The pipeline has ended after it was ready, and why; a failed start raises instead."""
    watchers: set[object]
    """Viewers of the frames; frames come with a preview unless this is empty."""

    async def start(self) -> PipelineReady:
        """Wait until the pipeline is ready; raise EmulatorError with the reason if it fails, in one line."""
        ...

    async def restart(self) -> PipelineReady:
        """Start the pipeline again after it has ended, and wait until it is ready."""
        ...

    async def close(self) -> None:
        """End the pipeline and wait for it."""
        ...


class _RequestQueue:
    """Callbacks of pending requests, in order, and the future that reports the start of the pipeline."""

    def __init__(self) -> None:
        self._waiting: deque[ReplyCallback] = deque()
        self._idle = asyncio.Event()
        self._idle.set()
        self._started: asyncio.Future[PipelineReady] = asyncio.get_running_loop().create_future()
        self.ended = Signal[str]("end of the image pipeline")
        """The pipeline has ended after it was ready, and why; a failed start raises instead."""
        self.watchers: set[object] = set()
        """Viewers of the frames; frames come with a preview unless this is empty."""

    @property
    def pending(self) -> int:
        return len(self._waiting)

    async def settle(self) -> None:
        """Wait until no requests are pending."""
        await self._idle.wait()

    def _with_preview(self, request: PipelineRequest) -> PipelineRequest:
        """Return the request, with a preview if anything shows the images."""
        if self.watchers and isinstance(request, FrameRequest):
            return replace(request, preview=True)
        return request

    def _add_pending(self, done: ReplyCallback) -> None:
        self._waiting.append(done)
        self._idle.clear()

    def _deliver_reply(self, reply: PipelineReply) -> None:
        done = self._waiting.popleft()
        call_guarded("result of the image pipeline", done, reply)
        if not self._waiting:
            self._idle.set()

    def _start_succeeded(self, ready: PipelineReady) -> None:
        if not self._started.done():
            self._started.set_result(ready)

    def _start_failed(self, text: str) -> None:
        if not self._started.done():
            self._started.set_exception(EmulatorError(text))

    def _pipeline_ended(self, text: str) -> None:
        """Let all pending requests fail, and report the end to the caller of `start` or by the signal `ended`."""
        started = self._started
        was_ready = started.done() and not started.cancelled() and started.exception() is None
        self._start_failed(text)
        while self._waiting:
            self._deliver_reply(Failure(text))
        if was_ready:
            log.error("%s", text)
            self.ended.emit(text)

    def _mark_start_failure_retrieved(self) -> None:
        """Prevent asyncio from reporting a failed start again at exit."""
        if self._started.done() and not self._started.cancelled():
            self._started.exception()


class ProcessImager(_RequestQueue):
    """The pipeline in a separate worker process, connected by a socket pair.

    Numerics do not run in the emulator's process, so that its replies on the bus never wait for the
    interpreter lock.
    """

    def __init__(self, setup: PipelineSetup, worker: WorkerProcess) -> None:
        super().__init__()
        self._setup = setup
        self._worker = worker
        self._writer: asyncio.StreamWriter | None = None
        self._task: asyncio.Task[None] | None = None
        self._closing = False

    @property
    def pid(self) -> int:
        """Process ID of the worker."""
        return self._worker.process.pid

    async def start(self) -> PipelineReady:
        """Wait until the pipeline is ready."""
        self._started = asyncio.get_running_loop().create_future()
        reader, self._writer = await asyncio.open_connection(sock=self._worker.socket)
        self._writer.write(_with_length(self._setup))
        self._task = asyncio.create_task(self._read_messages(reader))
        return await self._started

    async def restart(self) -> PipelineReady:
        """Start another worker after one has ended, and wait until it is ready.

        EmulatorError if the start failed, OSError if the process could not be created.
        """
        self._disconnect()
        await asyncio.get_running_loop().run_in_executor(None, self._worker.end)
        self._worker = WorkerProcess()
        return await self.start()

    def submit(self, request: PipelineRequest, done: ReplyCallback) -> None:
        """Send a request to the worker."""
        if not self._worker.running or self._writer is None:
            done(Failure("pipeline worker: not running"))
            return
        data = _with_length(self._with_preview(request))
        self._add_pending(done)
        self._writer.write(data)

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
            self._start_succeeded(message)
        elif isinstance(message, Failure) and not self._started.done():
            self._start_failed(message.text)
        else:
            self._deliver_reply(message)

    async def close(self) -> None:
        """End the worker and wait for it."""
        self._closing = True
        self._disconnect()
        if self._task is not None:
            self._task.cancel()
        await asyncio.get_running_loop().run_in_executor(None, self._worker.end)
        self._mark_start_failure_retrieved()


class ThreadImager(_RequestQueue):
    """The pipeline in a thread: takes less memory, but shares the interpreter lock with the links."""

    def __init__(self, setup: PipelineSetup) -> None:
        super().__init__()
        self._setup = setup
        self._loop = asyncio.get_running_loop()
        self._requests: queue.SimpleQueue[PipelineRequest | None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        """Queue of requests; None before the start and after an unexpected end."""

    async def start(self) -> PipelineReady:
        """Wait until the pipeline is ready."""
        self._started = self._loop.create_future()
        self._requests = queue.SimpleQueue()
        self._thread = threading.Thread(
            target=self._run_thread, args=(self._requests,), name="pipeline", daemon=True
        )
        self._thread.start()
        return await self._started

    async def restart(self) -> PipelineReady:
        """Start another thread after one has ended, and wait until it is ready."""
        return await self.start()

    def submit(self, request: PipelineRequest, done: ReplyCallback) -> None:
        """Pass a request to the thread."""
        if self._thread is None:
            done(Failure("pipeline thread: not running"))
            return
        self._add_pending(done)
        self._requests.put(self._with_preview(request))

    def _pipeline_ended(self, text: str) -> None:
        self._thread = None
        super()._pipeline_ended(text)

    def _run_thread(self, requests: queue.SimpleQueue[PipelineRequest | None]) -> None:
        try:
            self._serve_requests(requests)
        except BaseException as error:  # noqa: BLE001 (its pending requests must fail)
            self._in_loop(self._pipeline_ended, f"pipeline thread: ended: {one_line(error)}")

    def _serve_requests(self, requests: queue.SimpleQueue[PipelineRequest | None]) -> None:
        from starhil.emulator.pipeline.pipeline import make_pipeline

        made = make_pipeline(self._setup)
        if isinstance(made, Failure):
            self._in_loop(self._start_failed, made.text)
            return
        pipeline, ready = made
        self._in_loop(self._start_succeeded, ready)
        while (request := requests.get()) is not None:
            self._in_loop(self._deliver_reply, pipeline.handle(request))

    def _in_loop(self, callback: Callable[..., None], *args: object) -> None:
        with contextlib.suppress(RuntimeError):  # the loop may have closed while a frame was being rendered
            self._loop.call_soon_threadsafe(callback, *args)

    async def close(self) -> None:
        """End the thread and wait for it."""
        self._requests.put(None)
        if self._thread is not None:
            await self._loop.run_in_executor(None, self._thread.join, EXIT_GRACE_S)
        self._mark_start_failure_retrieved()


def _with_length(message: object) -> bytes:
    data = pickle.dumps(message, protocol=pickle.HIGHEST_PROTOCOL)
    return LENGTH.pack(len(data)) + data
