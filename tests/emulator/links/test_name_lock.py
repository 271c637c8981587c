"""A symlink belongs to one emulator at a time."""

import errno
import os
import signal
import socket
import subprocess
import sys

import pytest

from starhil.emulator.errors import EmulatorError
from starhil.emulator.links.name_lock import lock_symlink


def test_a_locked_path_is_rejected_in_every_spelling_and_free_again_afterwards(tmp_path):
    path = tmp_path / "tty"
    (tmp_path / "folder").mkdir()
    with lock_symlink(path):
        for spelling in (path, tmp_path / "folder" / ".." / "tty"):
            with pytest.raises(EmulatorError, match=f"in use by another emulator, process {os.getpid()};"):
                lock_symlink(spelling)
        lock_symlink(tmp_path / "another").close()
    lock_symlink(path).close()


def test_a_stale_symlink_can_be_locked_and_a_foreign_one_cannot(tmp_path):
    stale, foreign = tmp_path / "stale", tmp_path / "foreign"
    stale.symlink_to("/dev/pts/99999")
    lock_symlink(stale).close()
    foreign.symlink_to("/etc/hostname")
    with pytest.raises(EmulatorError, match="points to /etc/hostname"):
        lock_symlink(foreign)


def test_a_lock_ends_with_its_process_even_when_killed(tmp_path):
    path = tmp_path / "tty"
    program = (
        "import sys, time; from pathlib import Path; from starhil.emulator.links.name_lock import lock_symlink;"
        "lock = lock_symlink(Path(sys.argv[1])); print('locked', flush=True); time.sleep(60)"
    )
    with subprocess.Popen(
        [sys.executable, "-c", program, str(path)], stdout=subprocess.PIPE, text=True
    ) as holder:
        assert holder.stdout.readline() == "locked\n"
        with pytest.raises(EmulatorError, match=f"process {holder.pid};"):
            lock_symlink(path)
        holder.send_signal(signal.SIGKILL)
    lock_symlink(path).close()


def test_a_lock_that_cannot_be_made_is_not_reported_as_in_use(tmp_path, monkeypatch):
    class NoBuffers(socket.socket):
        def bind(self, _address):
            raise OSError(errno.ENOBUFS, os.strerror(errno.ENOBUFS))

    monkeypatch.setattr(socket, "socket", NoBuffers)
    with pytest.raises(EmulatorError) as error:
        lock_symlink(tmp_path / "tty")
    assert (
        str(error.value)
        == f"symlink {tmp_path / 'tty'}: cannot be locked (No buffer space available); choose another name"
    )
