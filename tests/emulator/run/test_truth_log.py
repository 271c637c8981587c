"""Which files a truth log takes, and what it leaves as it was."""

import os
import termios
from pathlib import Path

import pytest

from starhil.emulator.errors import EmulatorError
from starhil.emulator.run.truth_log import COLUMNS, TruthLog

HEAD = ",".join(COLUMNS) + "\r\n"


def test_a_nonempty_file_is_kept_unless_it_may_be_replaced(tmp_path):
    path = tmp_path / "truth.csv"
    path.write_text("of great worth")
    with pytest.raises(EmulatorError, match=r"exists and is not empty; .*--overwrite"):
        TruthLog(path)
    assert path.read_text() == "of great worth"
    TruthLog(path, overwrite=True).close()
    assert path.read_bytes().decode() == HEAD


def test_an_empty_file_is_taken(tmp_path):
    path = tmp_path / "truth.csv"
    path.touch()
    TruthLog(path).close()
    assert path.read_bytes().decode() == HEAD


@pytest.mark.parametrize("overwrite", [False, True])
def test_two_emulators_do_not_share_a_truth_log(tmp_path, overwrite):
    path = tmp_path / "truth.csv"
    first = TruthLog(path)
    with pytest.raises(EmulatorError, match="in use by another emulator"):
        TruthLog(path, overwrite=overwrite)
    assert path.read_bytes().decode() == HEAD
    first.close()
    TruthLog(path, overwrite=True).close()


def test_a_pipe_is_rejected_without_waiting_for_its_reader(tmp_path):
    path = tmp_path / "pipe"
    os.mkfifo(path)
    with pytest.raises(EmulatorError, match="cannot be written"):
        TruthLog(path)
    reader = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    with pytest.raises(EmulatorError, match="not a regular file"):
        TruthLog(path)
    os.close(reader)


def test_a_device_that_takes_nothing_is_rejected():
    with pytest.raises(EmulatorError, match="No space left"):
        TruthLog(Path("/dev/full"))
    TruthLog(Path("/dev/null")).close()


def test_a_device_that_would_make_the_writer_wait_is_rejected():
    leader, follower = os.openpty()
    termios.tcflow(follower, termios.TCOOFF)
    with pytest.raises(EmulatorError, match="temporarily unavailable"):
        TruthLog(Path(os.ttyname(follower)))
    os.close(leader)
    os.close(follower)
