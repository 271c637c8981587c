"""Signals that end a command which serves in an event loop."""

from __future__ import annotations

import asyncio
import contextlib
import signal
import socket
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Final

ENDING: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@contextlib.contextmanager
def ended_by_signals(end: Callable[[], object]) -> Iterator[None]:
    """Call `end` in the running event loop at SIGINT, SIGTERM and, unless it is ignored already (`nohup`), SIGHUP.

    From the end of the block they are ignored until the process has ended. Those of `add_signal_handler` have their
    default effect as soon as the event loop is closed, and one that came then would decide the exit status.
    """
    loop = asyncio.get_running_loop()
    numbers = [
        number
        for number in ENDING
        if number is not signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN
    ]  # a shell script starts what it puts in the background with SIGINT ignored
    received, arriving = socket.socketpair()

    def wake() -> None:
        received.recv(4096)
        end()

    with received, arriving:
        arriving.settimeout(0)
        loop.add_reader(received, wake)
        signal.set_wakeup_fd(arriving.fileno(), warn_on_full_buffer=False)
        for number in numbers:
            signal.signal(number, _only_wake)
        try:
            yield
        finally:
            for number in numbers:
                signal.signal(number, signal.SIG_IGN)
            signal.set_wakeup_fd(-1)
            loop.remove_reader(received)


def _only_wake(_number: int, _frame: FrameType | None) -> None:
    """Let the signal have no effect but the byte that wakes the event loop."""
