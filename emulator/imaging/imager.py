"""Where frames are made and solved, seen from the device: a process or a thread that takes requests in order.

The device never waits: it submits a request and is called back in the event loop. `settle` is for the stepped clock, which
goes on only when all that was asked for has come.
"""

from __future__ import annotations

import asyncio
import pickle
import queue
import threading
from collections import deque
from collections.abc import Callable
from typing import Any, Protocol, TypeAlias

from emulator.errors import EmulatorError
from emulator.imaging.frames import (
    LENGTH,
    Failure,
    FrameRequest,
    FrameResult,
    ImageRequest,
    ImageResult,
    PipelineSetup,
    Warm,
)
from emulator.imaging.worker_process import EXIT_GRACE_S, WorkerProcess

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


class DirectImager:
    """Does each request where it is asked for: for tests, and for runs without an event loop."""

    pending = 0

    def __init__(self, handle: Callable[[Asked], Answer]) -> None:
        self._handle = handle

    def submit(self, request: Asked, done: Done) -> None:
        """Do the request and call back."""
        done(self._handle(request))

    async def settle(self) -> None:
        """Nothing is ever pending."""


class _Queue:
    """Callbacks that wait for their answers, in order."""

    def __init__(self) -> None:
        self._waiting: deque[Done] = deque()
        self._idle = asyncio.Event()
        self._idle.set()
        self.on_failure: Callable[[str], None] | None = None
        """Called when the worker is lost."""

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
        try:
            done(answer)
        finally:
            if not self._waiting:
                self._idle.set()

    def _fail_all(self, text: str) -> None:
        while self._waiting:
            self._answer(Failure(text, fatal=True))
        if self.on_failure is not None:
            self.on_failure(text)


class ProcessImager(_Queue):
    """A worker process of one's own, reached over a socket pair.

    The emulator's process needs no numerics then, and its answers on the bus do not wait for the interpreter's lock.
    """

    def __init__(self, setup: PipelineSetup, worker: WorkerProcess) -> None:
        super().__init__()
        self._setup = setup
        self._worker = worker
        self._warm: asyncio.Future[Warm] = asyncio.get_running_loop().create_future()
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
        self._write(self._setup)
        self._task = asyncio.create_task(self._read(reader))
        return await self._warm

    async def restart(self) -> Warm:
        """Start another worker in place of one that has ended, and wait until it is ready.

        Raises
        ------
        EmulatorError
            That one cannot be either.
        """
        if self._writer is not None:
            self._writer.close()
            self._writer = None  # what is asked for until the other one is reached is refused
        self._worker.end()
        self._worker = WorkerProcess()
        return await self.start()

    def submit(self, request: Asked, done: Done) -> None:
        """Send a request to the worker."""
        if not self._worker.running or self._writer is None:
            done(Failure("picture worker: not running", fatal=True))
            return
        self._enqueue(done)
        self._write(request)

    def _write(self, message: object) -> None:
        data = pickle.dumps(message, protocol=pickle.HIGHEST_PROTOCOL)
        if self._writer is not None:
            self._writer.write(LENGTH.pack(len(data)) + data)

    async def _read(self, reader: asyncio.StreamReader) -> None:
        try:
            while True:
                (length,) = LENGTH.unpack(await reader.readexactly(LENGTH.size))
                message: Any = pickle.loads(await reader.readexactly(length))  # noqa: S301 (our own child process)
                self._take(message)
        except (asyncio.IncompleteReadError, ConnectionError):
            if self._closing:
                return
            text = "picture worker: ended by itself; see its last words on stderr"
            if not self._warm.done():
                self._warm.set_exception(EmulatorError(text))
            self._fail_all(text)

    def _take(self, message: Warm | Answer) -> None:
        if isinstance(message, Warm):
            self._warm.set_result(message)
        elif isinstance(message, Failure) and not self._warm.done():
            self._warm.set_exception(EmulatorError(message.text))
        else:
            self._answer(message)

    async def close(self) -> None:
        """End the worker and wait for it."""
        self._closing = True
        if self._writer is not None:
            self._writer.close()
        if self._task is not None:
            self._task.cancel()
        await asyncio.get_running_loop().run_in_executor(None, self._worker.end)
        if self._warm.done() and not self._warm.cancelled():
            self._warm.exception()  # so that a failure already told is not told again at exit


class ThreadImager(_Queue):
    """A worker thread: less memory than a process, but Python's lock is shared with the links."""

    def __init__(self, setup: PipelineSetup) -> None:
        super().__init__()
        self._setup = setup
        self._loop = asyncio.get_running_loop()
        self._requests: queue.SimpleQueue[Asked | None] = queue.SimpleQueue()
        self._warm: asyncio.Future[Warm] = self._loop.create_future()
        self._thread = threading.Thread(target=self._work, name="picture", daemon=True)

    async def start(self) -> Warm:
        """Wait until the pipeline is ready."""
        self._thread.start()
        return await self._warm

    def submit(self, request: Asked, done: Done) -> None:
        """Hand a request to the thread."""
        self._enqueue(done)
        self._requests.put(request)

    def _work(self) -> None:
        from emulator.imaging.picture import make_picture

        made = make_picture(self._setup)
        if isinstance(made, Failure):
            self._loop.call_soon_threadsafe(self._warm.set_exception, EmulatorError(made.text))
            return
        picture, warm = made
        self._loop.call_soon_threadsafe(self._warm.set_result, warm)
        while (request := self._requests.get()) is not None:
            self._loop.call_soon_threadsafe(self._answer, picture.handle(request))

    async def restart(self) -> Warm:
        """Refuse: a thread does not end by itself.

        Raises
        ------
        EmulatorError
            Always.
        """
        raise EmulatorError("picture thread: cannot be started again; start the emulator anew")

    async def close(self) -> None:
        """End the thread and wait for it."""
        self._requests.put(None)
        if self._thread.is_alive():
            await self._loop.run_in_executor(None, self._thread.join, EXIT_GRACE_S)
