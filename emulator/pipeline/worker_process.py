"""Start and end of the pipeline worker process.

`starhil run` starts the worker before its own imports, so that both processes start up in parallel.
"""

from __future__ import annotations

import socket
import subprocess
import sys
import time
from typing import Final

EXIT_GRACE_S: Final = 2.0


class WorkerProcess:
    """A pipeline worker process and the socket connected to it."""

    def __init__(self) -> None:
        self.started_ns = time.monotonic_ns()
        """Time at which it was started, on the monotonic wall clock, nanoseconds."""
        self.socket, inherited = socket.socketpair()
        command = [sys.executable, "-m", "starhil.emulator.pipeline.worker", str(inherited.fileno())]
        # in a process group of its own, so that Ctrl-C does not reach it while it imports
        self.process = subprocess.Popen(  # noqa: S603
            command, pass_fds=[inherited.fileno()], stdin=subprocess.DEVNULL, process_group=0
        )
        inherited.close()

    @property
    def running(self) -> bool:
        """Whether the process is still running."""
        return self.process.poll() is None

    def end(self) -> None:
        """Close the socket, which ends the worker, and wait; kill it if it does not end."""
        self.socket.close()
        try:
            self.process.wait(EXIT_GRACE_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


_ahead: Final[list[WorkerProcess]] = []


def start_ahead() -> None:
    """Start a worker for the run that this process is going to set up."""
    _ahead.append(WorkerProcess())


def take_worker() -> WorkerProcess:
    """Return the worker started by `start_ahead`, or a new one."""
    return _ahead.pop() if _ahead else WorkerProcess()
