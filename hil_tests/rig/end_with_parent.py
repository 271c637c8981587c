"""Run a command to which the kernel sends SIGTERM when the process that started it ends.

    python -m starhil.hil_tests.rig.end_with_parent PARENT COMMAND [ARGUMENT…]

PARENT is the process ID of the parent. The setting survives `exec`, so COMMAND needs no support for it. Linux
only.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from typing import Final

PR_SET_PDEATHSIG: Final = 1


def exec_with_death_signal(parent: int, command: list[str]) -> None:
    """Replace this process by a command that receives SIGTERM when `parent` ends.

    Raises OSError: the kernel rejects the request, or the command cannot be executed.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(PR_SET_PDEATHSIG, int(signal.SIGTERM)) != 0:
        error = ctypes.get_errno()
        raise OSError(error, f"prctl: {os.strerror(error)}")
    if os.getppid() != parent:  # the parent ended before prctl, so no signal will come
        signal.raise_signal(signal.SIGTERM)
    os.execv(command[0], command)  # noqa: S606 -- the command line of the bench, without a shell


if __name__ == "__main__":
    try:
        exec_with_death_signal(int(sys.argv[1]), sys.argv[2:])
    except OSError as failure:
        sys.exit(f"{sys.argv[2]}: cannot be started: {failure.strerror}")
