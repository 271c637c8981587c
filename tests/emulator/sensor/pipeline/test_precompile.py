"""The first start after an installation compiles in two processes."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from starhil.emulator.sensor.pipeline import precompile, worker
from tests.waiting import wait_until

pytestmark = pytest.mark.process


def test_the_worker_starts_its_helper_before_its_first_kernel_is_in_the_cache(tmp_path: Path) -> None:
    """Otherwise the cache has a kernel, and the worker takes the work of the first start for done."""
    ours, theirs = socket.socketpair()
    command = [sys.executable, "-P", "-m", worker.__name__, str(theirs.fileno()), str(os.getpid())]
    environment = {**os.environ, "STARHIL_CACHE_DIR": str(tmp_path)}
    with ours, theirs, subprocess.Popen(command, pass_fds=[theirs.fileno()], env=environment) as process:
        try:
            wait_until(
                lambda: (
                    precompile.__name__ in _commands_of_children(process.pid) or any(tmp_path.rglob("*.nbc"))
                )
            )
            assert precompile.__name__ in _commands_of_children(process.pid)
        finally:
            process.kill()


def _commands_of_children(pid: int) -> str:
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return " ".join(Path(f"/proc/{child}/cmdline").read_text().replace("\0", " ") for child in children)
