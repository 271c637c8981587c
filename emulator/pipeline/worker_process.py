"""The picture worker's process as the emulator holds it: started before anything else is imported, so that both start at once."""

from __future__ import annotations

import socket
import subprocess
import sys
from typing import Final

EXIT_GRACE_S: Final = 2.0


class WorkerProcess:
    """A started worker and the socket that leads to it."""

    def __init__(self) -> None:
        self.socket, theirs = socket.socketpair()
        command = [sys.executable, "-m", "starhil.emulator.pipeline.worker", str(theirs.fileno())]
        self.process = subprocess.Popen(command, pass_fds=[theirs.fileno()], stdin=subprocess.DEVNULL)  # noqa: S603
        theirs.close()

    @property
    def running(self) -> bool:
        """Whether the process lives."""
        return self.process.poll() is None

    def end(self) -> None:
        """Close the socket, on which the worker ends, and wait for it; one that does not is killed."""
        self.socket.close()
        try:
            self.process.wait(EXIT_GRACE_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


_ahead: Final[list[WorkerProcess]] = []


def start_ahead() -> None:
    """Start the worker of the run that this process is about to assemble, before anything else is imported."""
    _ahead.append(WorkerProcess())


def take_worker() -> WorkerProcess:
    """Return the worker that was started ahead, or a new one."""
    return _ahead.pop() if _ahead else WorkerProcess()
