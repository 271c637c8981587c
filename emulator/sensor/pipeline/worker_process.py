"""Start and end of the pipeline worker.

`starhil run` starts the worker before its own imports, so that both processes start up in parallel.
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import threading
import time
from contextlib import suppress
from typing import Final, TypeAlias

EXIT_GRACE_S: Final = 2.0


class WorkerThread:
    """A worker in a thread: takes less memory, but shares the interpreter lock with the links."""

    def __init__(self) -> None:
        from starhil.emulator.sensor.pipeline.worker import serve_in_thread

        self.socket, link = socket.socketpair()
        self._thread = threading.Thread(target=serve_in_thread, args=[link], name="pipeline", daemon=True)
        self._thread.start()

    def end(self) -> None:
        """Close the socket, which ends the thread, and wait."""
        self.socket.close()
        self._thread.join(EXIT_GRACE_S)


class WorkerProcess:
    """A pipeline worker process and the socket connected to it."""

    def __init__(self) -> None:
        self.started_ns = time.monotonic_ns()
        """Time at which it was started, on the monotonic wall clock, nanoseconds."""
        self.socket, inherited = socket.socketpair()
        command = [
            sys.executable,
            "-P",
            "-m",
            "starhil.emulator.sensor.pipeline.worker",
            str(inherited.fileno()),
            str(os.getpid()),
        ]
        # in a process group of its own, so that Ctrl-C does not reach it while it imports
        self.process = subprocess.Popen(  # noqa: S603
            command, pass_fds=[inherited.fileno()], stdin=subprocess.DEVNULL, process_group=0
        )
        inherited.close()

    def end(self, grace_s: float = EXIT_GRACE_S) -> None:
        """Close the socket, which ends the worker, and wait; kill it if it does not end in time."""
        self.socket.close()
        try:
            self.process.wait(grace_s)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


Worker: TypeAlias = WorkerProcess | WorkerThread

_ahead: Final[list[WorkerProcess]] = []


def start_ahead() -> None:
    """Start a worker for the run that this process is going to set up; if that fails, the run tries it again and reports it."""
    with suppress(OSError):
        _ahead.append(WorkerProcess())


def take_worker() -> WorkerProcess | None:
    """Return the worker started by `start_ahead`, once."""
    return _ahead.pop() if _ahead else None
