"""A child process that ends with its parent, however that ends."""

from __future__ import annotations

import ctypes
import os
import signal
from typing import Final

PR_SET_PDEATHSIG: Final = 1


def end_with_parent(parent: int | None = None, number: int = signal.SIGKILL) -> None:
    """Let the kernel send this process a signal when the thread that started it has ended.

    Parameters
    ----------
    parent
        Process that must be the parent still: one that has ended before this call sends nothing any more, so the signal is
        raised here.
    number
        The signal.

    Raises
    ------
    OSError
        The kernel refuses.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(PR_SET_PDEATHSIG, int(number)) != 0:
        error = ctypes.get_errno()
        raise OSError(error, f"prctl: {os.strerror(error)}")
    if parent is not None and os.getppid() != parent:
        signal.raise_signal(number)
