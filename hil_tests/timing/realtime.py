"""Real-time priority for processes, for use on a busy machine."""

from __future__ import annotations

import os

from starhil.hil_tests.errors import BenchError

PRIORITY = 1


def set_realtime_priority(process: int = 0) -> None:
    """Give a process (0: this one) real-time priority, which its later children do not inherit.

    Raises BenchError: the system does not permit it.
    """
    policy = os.SCHED_RR | os.SCHED_RESET_ON_FORK
    try:
        os.sched_setscheduler(process, policy, os.sched_param(PRIORITY))
    except OSError as error:
        raise BenchError(
            f"real-time priority: {error.strerror}; run it as root or with CAP_SYS_NICE, or omit --realtime"
        ) from None
