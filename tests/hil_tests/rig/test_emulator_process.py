"""The wait for an emulator's ready line: as long as kernels are being compiled, and no longer."""

import pytest

from starhil.hil_tests.errors import EmulatorProcessError
from starhil.hil_tests.rig.emulator_process import EmulatorProcess

WITHIN_S = 2.0


def start(*counts):
    """Start a program that reports the numbers of compiled kernels, 1.2 s apart, and is then ready."""
    lines = "".join(f"echo 'starting: 5 s, {count} kernels compiled' >&2; sleep 1.2; " for count in counts)
    return EmulatorProcess(["sh", "-c", f"{lines} echo ready seed=1; exec sleep 60"], ready_within_s=WITHIN_S)


def test_a_start_that_compiles_kernels_may_take_longer():
    process = start(1, 2, 3).start()
    assert process.ready == {"seed": "1"}
    process.kill()


def test_a_start_that_only_lasts_is_given_up():
    with pytest.raises(EmulatorProcessError, match="not ready within 2 s"):
        start(1, 1, 1, 1).start()
