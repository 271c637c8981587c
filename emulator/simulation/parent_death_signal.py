"""Ends a child process when its parent ends, for whatever reason."""

from __future__ import annotations

import ctypes
import os
import signal
from typing import Final

PR_SET_PDEATHSIG: Final = 1


def end_with_parent(parent: int) -> None:
    """Have the kernel kill this process when the thread that started it ends.

    If that ended before this call, so that `parent` is not the parent any more, it is killed here. OSError if
    `prctl` failed.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(PR_SET_PDEATHSIG, int(signal.SIGKILL)) != 0:
        error = ctypes.get_errno()
        raise OSError(error, f"prctl: {os.strerror(error)}")
    if os.getppid() != parent:
        signal.raise_signal(signal.SIGKILL)
