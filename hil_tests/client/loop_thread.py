"""An event loop in a separate thread, for synchronous calls into asyncio code."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Coroutine
from concurrent.futures import Future
from typing import Any, TypeVar

from starhil.hil_tests.errors import HIDDEN_BEHIND_ONE_LINE
from starhil.protocol.errors import OneLineError

__tracebackhide__ = HIDDEN_BEHIND_ONE_LINE

T = TypeVar("T")


class LoopThread:
    """Runs coroutines in an event loop in a daemon thread, until `close`."""

    def __init__(self, name: str) -> None:
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name=name, daemon=True)
        self._thread.start()

    def run(self, coroutine: Coroutine[Any, Any, T]) -> T:
        """Run a coroutine in the loop; return its result or raise its exception."""
        future: Future[T] = asyncio.run_coroutine_threadsafe(coroutine, self._loop)
        try:
            return future.result()
        except KeyboardInterrupt:
            future.cancel()
            raise
        except OneLineError as error:
            raise error.with_traceback(None) from error.__cause__  # its frames are those of the loop

    @property
    def alive(self) -> bool:
        """Whether the thread is running."""
        return self._thread.is_alive()

    def close(self) -> None:
        """End the loop and the thread; may be called twice."""
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._loop.stop)
            self._thread.join()
            self._loop.close()
