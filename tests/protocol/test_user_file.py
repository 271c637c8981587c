"""What a reader of files that a user names takes, and what it rejects without waiting."""

import os
import socket

import pytest

from starhil.emulator.control.scenario import load_scenario
from starhil.emulator.device.state_store import STATE_FILE, FileStore
from starhil.emulator.errors import EmulatorError
from starhil.emulator.profile import load_profile
from starhil.emulator.truth.file import read_truth_file
from starhil.hil_tests.errors import BenchError
from starhil.hil_tests.script import load_script
from starhil.hil_tests.truth_log import TruthLogReader
from starhil.protocol.canopen.storage import FileStorage
from starhil.protocol.errors import ProtocolError
from starhil.protocol.icd import load_unit
from starhil.protocol.user_file import UnsuitableFileError, read_user_file, read_user_text

READERS = {
    "truth file": read_truth_file,
    "truth of a session": lambda path: TruthLogReader(path).at(0.0),
    "profile": lambda path: load_profile(str(path)),
    "scenario": lambda path: load_scenario(str(path)),
    "session script": lambda path: load_script(path, load_unit()),
    "interface definition": load_unit,
    "CANopen storage": lambda path: FileStorage(path).load("communication"),
}


def test_a_file_is_read_completely_or_rejected_above_the_limit(tmp_path):
    path = tmp_path / "a"
    path.write_bytes(b"12\xc3\xa4")
    assert read_user_file(path, 4) == b"12\xc3\xa4"
    assert read_user_text(path) == "12ä"
    path.write_bytes(b"\xef\xbb\xbf12")
    assert read_user_text(path) == "12"
    path.write_bytes(b"1234")
    with pytest.raises(UnsuitableFileError) as refusal:
        read_user_file(path, 3)
    assert refusal.value.strerror == "larger than 3e-06 MB"


def test_a_file_that_is_not_regular_is_rejected_without_waiting(tmp_path):
    os.mkfifo(tmp_path / "fifo")
    with socket.socket(socket.AF_UNIX) as there:
        there.bind(str(tmp_path / "socket"))
        for path in (tmp_path / "fifo", "/dev/zero", "/dev/tty", tmp_path, tmp_path / "socket"):
            with pytest.raises(OSError, match=r"not a regular file|directory|No such device"):
                read_user_file(path)


@pytest.mark.parametrize("name", READERS)
def test_every_reader_rejects_a_pipe_in_one_line_without_waiting(tmp_path, name):
    path = tmp_path / "pipe.toml"
    os.mkfifo(path)
    with pytest.raises((EmulatorError, BenchError, ProtocolError)) as refusal:
        READERS[name](path)
    assert str(path) in str(refusal.value)
    assert "not a regular file" in str(refusal.value)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("make", [os.mkfifo, lambda path: path.write_bytes(bytes(2_000_000))])
def test_a_state_that_is_a_pipe_or_too_large_is_set_aside(tmp_path, make):
    make(tmp_path / STATE_FILE)
    store = FileStore(tmp_path)
    assert store.load() == {}
    assert store.corrupt
    assert (tmp_path / (STATE_FILE + ".corrupt")).exists()
    store.save({"boot_count": 1})
    assert store.load() == {"boot_count": 1}
    store.close()
