"""Threads beside the event loop, for computations of any length that a run must not wait for."""

from __future__ import annotations

import asyncio
import sys
import threading
from collections.abc import Callable, Coroutine
from concurrent.futures import Executor, Future
from typing import Any, Final, ParamSpec, TypeVar, TypeVarTuple

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")
Each = TypeVarTuple("Each")

SWITCH_S: Final = 0.0002
"""Time for which a thread may keep the interpreter while another waits for it, seconds. The event loop waits for it several
times in an exchange; Python's default is 0.005."""


class _AbandonedThreads(Executor):
    """One thread for each call, which the end of the process does not wait for; those of asyncio's own executor it does."""

    def submit(
        self, function: Callable[Arguments, Result], /, *args: Arguments.args, **kwargs: Arguments.kwargs
    ) -> Future[Result]:
        future: Future[Result] = Future()

        def run() -> None:
            if not future.set_running_or_notify_cancel():
                return
            try:
                result = function(*args, **kwargs)
            except BaseException as error:  # noqa: BLE001 (it belongs to whoever waits)
                future.set_exception(error)
            else:
                future.set_result(result)

        threading.Thread(target=run, daemon=True).start()
        return future


_THREADS: Final = _AbandonedThreads()

_CALL: Final = threading.local()
"""Of a thread of `in_thread`: `over`, an event that is set when nobody waits for its call any more."""


async def in_thread(
    function: Callable[Arguments, Result], *args: Arguments.args, **kwargs: Arguments.kwargs
) -> Result:
    """Call a function without effects, which is abandoned if the run ends or the caller is cancelled first."""
    over = threading.Event()

    def call() -> Result:
        _CALL.over = over
        return function(*args, **kwargs)

    try:
        return await asyncio.get_running_loop().run_in_executor(_THREADS, call)
    finally:
        over.set()


def is_abandoned() -> bool:
    """Return whether this thread runs a call of `in_thread` for which nobody waits any more."""
    over: threading.Event | None = getattr(_CALL, "over", None)
    return over is not None and over.is_set()


def call_within(limit_s: float, function: Callable[[], Result]) -> Result:
    """Call a function that may never return, as on a network folder without a server; TimeoutError if it takes too long."""
    return _THREADS.submit(function).result(limit_s)


class _Loop(asyncio.SelectorEventLoop):
    """An event loop whose slow calls are abandoned at its end: name servers and drivers may never answer."""

    def run_in_executor(
        self, executor: Executor | None, func: Callable[[*Each], Result], *args: *Each
    ) -> asyncio.Future[Result]:
        """Call a function in a thread, by default in one that nobody waits for."""
        return super().run_in_executor(_THREADS if executor is None else executor, func, *args)


def run_loop(main: Coroutine[Any, Any, Result]) -> Result:
    """Run a coroutine, as `asyncio.run` does, and end when it has ended."""
    with asyncio.Runner(loop_factory=_Loop) as runner:
        return runner.run(main)


def share_interpreter() -> None:
    """Let the event loop have the interpreter soon while threads compute."""
    sys.setswitchinterval(SWITCH_S)
