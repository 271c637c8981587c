"""What holds for all tests: a process that a test starts finds the kernels that are compiled already."""

from __future__ import annotations

import os
import sys

from starid.storage.cache import cache_dir

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
