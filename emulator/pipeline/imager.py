"""Where frames are made and solved, seen from the device: a process or a thread that takes requests in order.

The device never waits: it submits a request and is called back in the event loop. `settle` is for the stepped clock, which
goes on only when all that was asked for has come.
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
from typing import Any, Protocol, TypeAlias

from starhil.emulator.errors import EmulatorError
from starhil.emulator.guard import call_guarded, one_line
from starhil.emulator.pipeline.frames import (
    LENGTH,
    Failure,
    FrameRequest,
    FrameResult,
    ImageRequest,
    ImageResult,
    PipelineSetup,
    Warm,
)
from starhil.emulator.pipeline.worker_process import EXIT_GRACE_S, WorkerProcess

log = logging.getLogger("starhil.picture")

Asked: TypeAlias = FrameRequest | ImageRequest
Answer: TypeAlias = FrameResult | ImageResult | Failure
Done: TypeAlias = Callable[[Answer], None]


class Imager(Protocol):
    """What the device asks frames of."""

    @property
    def pending(self) -> int:
        """Requests that are not answered yet."""
        ...

    def submit(self, request: Asked, done: Done) -> None:
        """Ask for something; `done` is called once, in the event loop, in the order of the requests."""
        ...

    async def settle(self) -> None:
        """Wait until nothing is pending."""
        ...


class _Queue:
    """Callbacks that wait for their answers, in order, and the start that they need."""

    def __init__(self) -> None:
        self._waiting: deque[Done] = deque()
        self._idle = asyncio.Event()
        self._idle.set()
        self._warm: asyncio.Future[Warm] = asyncio.get_running_loop().create_future()
        self.on_failure: Callable[[str], None] | None = None
        """Called when the pipeline is lost after it was ready; a start that fails raises instead."""

    @property
    def pending(self) -> int:
        return len(self._waiting)

    async def settle(self) -> None:
        """Wait until nothing is pending."""
        await self._idle.wait()

    def _enqueue(self, done: Done) -> None:
        self._waiting.append(done)
        self._idle.clear()

    def _answer(self, answer: Answer) -> None:
        done = self._waiting.popleft()
        call_guarded("answer of the picture pipeline", done, answer)
        if not self._waiting:
            self._idle.set()

    def _ready(self, warm: Warm) -> None:
        if not self._warm.done():
            self._warm.set_result(warm)

    def _start_failed(self, text: str) -> None:
        if not self._warm.done():
            self._warm.set_exception(EmulatorError(text))

    def _lost(self, text: str) -> None:
        """Fail all that is pending, and report the loss to whoever waits for the start, or else to `on_failure`."""
        warm = self._warm
        was_ready = warm.done() and not warm.cancelled() and warm.exception() is None
        self._start_failed(text)
        while self._waiting:
            self._answer(Failure(text))
        if was_ready:
            log.error("%s", text)
            if self.on_failure is not None:
                call_guarded("loss of the picture pipeline", self.on_failure, text)

    def _forget_start(self) -> None:
        """Take note of a failed start that was reported already, so that it is not reported again at exit."""
        if self._warm.done() and not self._warm.cancelled():
            self._warm.exception()


class ProcessImager(_Queue):
    """A worker process of its own, reached over a socket pair.

    The emulator's process needs no numerics then, and its answers on the bus do not wait for the interpreter's lock.
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
        """Process identifier of the worker."""
        return self._worker.process.pid

    async def start(self) -> Warm:
        """Wait until the pipeline is ready.

        Raises
        ------
        EmulatorError
            It cannot be: the worker's own one-line reason.
        """
        self._warm = asyncio.get_running_loop().create_future()
        reader, self._writer = await asyncio.open_connection(sock=self._worker.socket)
        self._writer.write(_packed(self._setup))
        self._task = asyncio.create_task(self._read(reader))
        return await self._warm

    async def restart(self) -> Warm:
        """Start another worker in place of one that has ended, and wait until it is ready.

        Raises
        ------
        EmulatorError
            That one cannot be either.
        OSError
            The system starts no process.
        """
        self._disconnect()
        await asyncio.get_running_loop().run_in_executor(None, self._worker.end)
        self._worker = WorkerProcess()
        return await self.start()

    def submit(self, request: Asked, done: Done) -> None:
        """Send a request to the worker."""
        if not self._worker.running or self._writer is None:
            done(Failure("picture worker: not running"))
            return
        data = _packed(request)
        self._enqueue(done)
        self._writer.write(data)

    def _disconnect(self) -> None:
        """Close the connection: what is asked for until another worker is reached is refused."""
        if self._writer is not None:
            self._writer.close()
            self._writer = None

    async def _read(self, reader: asyncio.StreamReader) -> None:
        try:
            while True:
                (length,) = LENGTH.unpack(await reader.readexactly(LENGTH.size))
                message: Any = pickle.loads(await reader.readexactly(length))  # noqa: S301 (our own child process)
                self._take(message)
        except (asyncio.IncompleteReadError, ConnectionError):
            text = "picture worker: ended by itself; see the last lines of stderr"
        except Exception as error:  # noqa: BLE001 (no answer: nothing that follows can be trusted)
            text = f"picture worker: its answer cannot be read: {one_line(error)}"
        if not self._closing:
            self._disconnect()
            self._lost(text)

    def _take(self, message: Warm | Answer) -> None:
        if isinstance(message, Warm):
            self._ready(message)
        elif isinstance(message, Failure) and not self._warm.done():
            self._start_failed(message.text)
        else:
            self._answer(message)

    async def close(self) -> None:
        """End the worker and wait for it."""
        self._closing = True
        self._disconnect()
        if self._task is not None:
            self._task.cancel()
        await asyncio.get_running_loop().run_in_executor(None, self._worker.end)
        self._forget_start()


class ThreadImager(_Queue):
    """A worker thread: less memory than a process, but Python's lock is shared with the links."""

    def __init__(self, setup: PipelineSetup) -> None:
        super().__init__()
        self._setup = setup
        self._loop = asyncio.get_running_loop()
        self._requests: queue.SimpleQueue[Asked | None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        """The thread; None before the start and after a loss."""

    async def start(self) -> Warm:
        """Wait until the pipeline is ready.

        Raises
        ------
        EmulatorError
            It cannot be; one line.
        """
        self._warm = self._loop.create_future()
        self._requests = queue.SimpleQueue()
        self._thread = threading.Thread(
            target=self._work, args=(self._requests,), name="picture", daemon=True
        )
        self._thread.start()
        return await self._warm

    async def restart(self) -> Warm:
        """Start another thread in place of one that has ended, and wait until it is ready.

        Raises
        ------
        EmulatorError
            That one cannot be either.
        """
        return await self.start()

    def submit(self, request: Asked, done: Done) -> None:
        """Hand a request to the thread."""
        if self._thread is None:
            done(Failure("picture thread: not running"))
            return
        self._enqueue(done)
        self._requests.put(request)

    def _lost(self, text: str) -> None:
        self._thread = None
        super()._lost(text)

    def _work(self, requests: queue.SimpleQueue[Asked | None]) -> None:
        try:
            self._serve(requests)
        except BaseException as error:  # noqa: BLE001 (whatever ends the thread, its requests are failed)
            self._in_loop(self._lost, f"picture thread: ended: {one_line(error)}")

    def _serve(self, requests: queue.SimpleQueue[Asked | None]) -> None:
        from starhil.emulator.pipeline.pipeline import make_picture

        made = make_picture(self._setup)
        if isinstance(made, Failure):
            self._in_loop(self._start_failed, made.text)
            return
        picture, warm = made
        self._in_loop(self._ready, warm)
        while (request := requests.get()) is not None:
            self._in_loop(self._answer, picture.handle(request))

    def _in_loop(self, callback: Callable[..., None], *args: object) -> None:
        with contextlib.suppress(RuntimeError):  # the loop may have ended while a frame was being made
            self._loop.call_soon_threadsafe(callback, *args)

    async def close(self) -> None:
        """End the thread and wait for it."""
        self._requests.put(None)
        if self._thread is not None:
            await self._loop.run_in_executor(None, self._thread.join, EXIT_GRACE_S)
        self._forget_start()


def _packed(message: object) -> bytes:
    data = pickle.dumps(message, protocol=pickle.HIGHEST_PROTOCOL)
    return LENGTH.pack(len(data)) + data
