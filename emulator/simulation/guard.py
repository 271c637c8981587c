"""Calls whose exceptions are logged instead of ending the caller."""

from __future__ import annotations

import asyncio
import contextlib
import inspect
import logging
from collections.abc import Awaitable, Callable, Coroutine, Sequence
from contextlib import AsyncExitStack
from typing import Any, Final, ParamSpec

from starhil.emulator.errors import EmulatorError, one_line
from starhil.protocol.errors import ProtocolError

log: Final = logging.getLogger("starhil.internal")

Arguments = ParamSpec("Arguments")


def log_internal_error(what: str, error: Exception) -> None:
    """Log an unexpected error in one line, with its traceback at level debug."""
    log.error("%s: internal error: %s", what, one_line(error))
    log.debug("%s", what, exc_info=error)


def call_guarded(
    what: str, callback: Callable[Arguments, object], *args: Arguments.args, **kwargs: Arguments.kwargs
) -> None:
    """Call a function; an exception is logged as an internal error and not raised."""
    try:
        callback(*args, **kwargs)
    except Exception as error:  # noqa: BLE001 (whatever it is, the caller has more to do)
        log_internal_error(what, error)


def until_cancelled(
    serve: Callable[Arguments, Awaitable[None]],
) -> Callable[Arguments, Coroutine[Any, Any, None]]:
    """Return a handler of connections for a server of asyncio that ends when it is cancelled, as at the end of a run.

    asyncio would log the cancellation with a traceback.
    """

    async def serve_until_cancelled(*args: Arguments.args, **kwargs: Arguments.kwargs) -> None:
        with contextlib.suppress(asyncio.CancelledError):
            await serve(*args, **kwargs)

    return serve_until_cancelled


def log_loop_errors_once(loop: asyncio.AbstractEventLoop) -> None:
    """Log each error of an event loop once, in one line, with its traceback at level debug.

    Without free file descriptors, asyncio would log a traceback for every waiting connection, every second.
    """
    logged: set[str] = set()

    def log_once(_loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        error = context.get("exception")
        text = context["message"] + ("" if error is None else f": {one_line(error)}")
        if text not in logged:
            logged.add(text)
            log.error("event loop: %s", text)
            log.debug("event loop", exc_info=error)

    loop.set_exception_handler(log_once)


async def close_all(closers: Sequence[Callable[[], object]]) -> None:
    """Call, and await if needed, each closer in order; a failure is logged, and the others are called."""
    async with AsyncExitStack() as stack:
        for close in reversed(closers):
            stack.push_async_callback(_close_guarded, close)


async def _close_guarded(close: Callable[[], object]) -> None:
    try:
        closing = close()
        if inspect.isawaitable(closing):
            await closing
    except Exception as error:  # the others still need closing
        text = str(error) if isinstance(error, (EmulatorError, ProtocolError)) else one_line(error)
        log.error("closing: %s", text)  # noqa: TRY400 (one line; the traceback below)
        log.debug("closing", exc_info=True)
