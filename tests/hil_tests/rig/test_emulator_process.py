"""The wait for an emulator's ready line: as long as kernels are being compiled, and no longer."""

import queue

import pytest

from starhil.hil_tests.errors import EmulatorProcessError
from starhil.hil_tests.rig import emulator_process
from starhil.hil_tests.rig.emulator_process import EmulatorProcess

pytestmark = pytest.mark.long

WITHIN_S = 2.0


class Lines:
    """Lines of an emulator, each some time after the one before, on a clock that nobody waits for."""

    def __init__(self, *lines):
        self.lines = list(lines)
        self.now_s = 0.0

    def get(self, timeout):
        after_s, _ = self.lines[0]
        self.now_s += min(after_s, timeout)
        if after_s > timeout:
            raise queue.Empty
        return self.lines.pop(0)[1]


@pytest.fixture
def start(monkeypatch):
    """Wait for an emulator that reports the numbers of compiled kernels, 1.2 s apart, and is then ready."""

    def start(*counts):
        lines = [(1.2, f"starting: 5 s, {count} kernels compiled") for count in counts]
        process = EmulatorProcess(["starhil"], ready_within_s=WITHIN_S)
        process._lines = Lines(*lines, (1.2, "ready seed=1"))
        monkeypatch.setattr(emulator_process.time, "monotonic", lambda: process._lines.now_s)
        return process._wait_for_ready()

    return start


def test_a_start_that_compiles_kernels_may_take_longer(start):
    assert start(1, 2, 3) == {"seed": "1"}


def test_a_start_that_only_lasts_is_given_up(start):
    with pytest.raises(EmulatorProcessError, match="not ready within 2 s"):
        start(1, 1, 1, 1)
