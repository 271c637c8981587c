"""A symlink belongs to one emulator at a time."""

import os
import signal
import subprocess
import sys

import pytest

from starhil.emulator.errors import EmulatorError
from starhil.emulator.symlink_lock import claim_symlink


def test_a_claimed_path_is_refused_by_every_spelling_and_free_again_after(tmp_path):
    path = tmp_path / "tty"
    (tmp_path / "folder").mkdir()
    with claim_symlink(path):
        for spelling in (path, tmp_path / "folder" / ".." / "tty"):
            with pytest.raises(EmulatorError, match=f"in use by another emulator, process {os.getpid()};"):
                claim_symlink(spelling)
        claim_symlink(tmp_path / "another").close()
    claim_symlink(path).close()


def test_a_stale_symlink_may_be_claimed_and_one_of_somebody_else_not(tmp_path):
    stale, foreign = tmp_path / "stale", tmp_path / "foreign"
    stale.symlink_to("/dev/pts/99999")
    claim_symlink(stale).close()
    foreign.symlink_to("/etc/hostname")
    with pytest.raises(EmulatorError, match="leads to /etc/hostname"):
        claim_symlink(foreign)


def test_a_claim_ends_with_its_process_however_that_ends(tmp_path):
    path = tmp_path / "tty"
    program = (
        "import sys, time; from pathlib import Path; from starhil.emulator.symlink_lock import claim_symlink;"
        "claim = claim_symlink(Path(sys.argv[1])); print('claimed', flush=True); time.sleep(60)"
    )
    with subprocess.Popen(
        [sys.executable, "-c", program, str(path)], stdout=subprocess.PIPE, text=True
    ) as holder:
        assert holder.stdout.readline() == "claimed\n"
        with pytest.raises(EmulatorError, match=f"process {holder.pid};"):
            claim_symlink(path)
        holder.send_signal(signal.SIGKILL)
    claim_symlink(path).close()
