"""Processes that a run starts end with it, also if it was killed before they could ask the kernel for that."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from starhil.emulator.sensor.pipeline import precompile, worker
from starhil.emulator.truth import reading_process
from tests.waiting import PATIENCE_S

pytestmark = pytest.mark.process


@pytest.mark.parametrize(
    ("module", "arguments"),
    [
        (precompile, ()),
        (worker, ("SOCKET",)),
        (reading_process, ("truth", "/dev/stdin")),
    ],
)
def test_a_process_whose_parent_was_killed_before_its_first_line_ends(
    module: object, arguments: tuple[str, ...], tmp_path: Path
) -> None:
    """It compiled kernels for a minute that nobody waited for."""
    ours, theirs = socket.socketpair()
    with ours, theirs:
        words = [str(theirs.fileno()) if each == "SOCKET" else each for each in arguments]
        ended_parent = 1 if os.getppid() != 1 else 2
        command = [sys.executable, "-P", "-m", module.__name__, *words, str(ended_parent)]
        done = subprocess.run(
            command, pass_fds=[theirs.fileno()], stdin=theirs, capture_output=True, timeout=PATIENCE_S, check=False,
            env={**os.environ, "STARHIL_CACHE_DIR": str(tmp_path)},
        )  # fmt: skip
    assert (done.returncode, done.stderr) == (-signal.SIGKILL, b"")
