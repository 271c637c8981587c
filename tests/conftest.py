"""What holds for all tests: processes find the kernels that are compiled already, and garbage is collected rarely."""

from __future__ import annotations

import gc
import os
import sys

from starid.storage.cache import cache_dir

# the objects of thousands of collected tests are no garbage: to look through them again and again takes a fifth of the time
gc.set_threshold(100_000, 50, 20)

CACHE = "STARHIL_CACHE_DIR"
os.environ[CACHE] = str(cache_dir())  # by name: a test may set HOME or XDG_CACHE_HOME


def _check_environment(event: str, arguments: tuple) -> None:
    """Reject a process without the folder of the kernels: it would compile for a minute, on a fresh machine only."""
    if (
        event != "subprocess.Popen" or arguments[0] == "/sbin/ldconfig"
    ):  # with which ctypes looks for a library
        return
    if CACHE not in (os.environ if arguments[3] is None else arguments[3]):
        raise AssertionError(f"environment without {CACHE}; start from os.environ: {arguments[1]}")


sys.addaudithook(_check_environment)
