"""What a reader of files that a user names takes, and what it rejects without waiting."""

import os
import re
import socket
import stat
import time

import pytest

from starhil.emulator.control.scenario import load_scenario
from starhil.emulator.device.state_store import STATE_FILE, FileStore
from starhil.emulator.errors import EmulatorError
from starhil.emulator.profile import load_profile
from starhil.emulator.truth.file import read_truth_file
from starhil.hil_tests.conformance.case_file import text_cases
from starhil.hil_tests.errors import BenchError
from starhil.hil_tests.rig.truth_log import TruthLogReader
from starhil.hil_tests.session.script import load_script
from starhil.protocol.canopen.storage import FileStorage
from starhil.protocol.errors import ProtocolError
from starhil.protocol.files.user_file import (
    TomlError,
    UnsuitableFileError,
    parse_toml,
    read_user_file,
    read_user_text,
)
from starhil.protocol.unit import load_unit
from starid.camera.file import load_camera
from starid.errors import StaridError
from starid.storage.files import read_bytes

READERS = {
    "truth file": read_truth_file,
    "truth of a session": lambda path: TruthLogReader(path).at(0.0),
    "profile": lambda path: load_profile(str(path)),
    "scenario": lambda path: load_scenario(str(path)),
    "session script": lambda path: load_script(path, load_unit()),
    "interface definition": load_unit,
    "CANopen storage": lambda path: FileStorage(path).load("communication"),
}


TOML_READERS = {
    **{name: READERS[name] for name in ("profile", "scenario", "session script", "interface definition")},
    "file of cases": lambda path: text_cases(path, "serial", {}),
    "camera": load_camera,
}

UNUSABLE = {
    "decimal digits": ("b = 1\na = " + "9" * 5000, r"does not fit 64 bits \(at line 2\)|too many digits"),
    "hexadecimal digits": ("a = 0x" + "F" * 5000, "a: a whole number does not fit 64 bits"),
    "65 bits": ("[t]\na = 18446744073709551616", "a: a whole number does not fit 64 bits"),
    "minus 65 bits": ("a = [-9223372036854775809]", "a: a whole number does not fit 64 bits"),
    "NUL": ('a = "x\\u0000"', "a: has the character NUL"),
    "lists": ("a = " + "[" * 5000, "nested too deeply"),
    "dotted keys": (".".join("a" * 5000) + " = 1", "nested too deeply"),
}


@pytest.mark.parametrize("name", UNUSABLE)
def test_toml_has_only_values_that_something_can_use(name):
    text, reason = UNUSABLE[name]
    with pytest.raises(TomlError, match=reason.partition("|")[0]):
        parse_toml(text)


@pytest.mark.parametrize("part", ["a", '"a b"', "'c'"])
@pytest.mark.parametrize("line", ["{} = 1", "[{}]", "[[{}]]", "x = [1, {{ y = 2, {} = 1 }}]"])
def test_keys_of_very_many_parts_are_rejected_in_a_time_that_grows_with_their_length(line, part):
    text = "# line\n" + line.format(" . ".join([part] * 100_000))
    begin_s = time.process_time()
    with pytest.raises(TomlError, match=r"nested too deeply \(at line 2\)"):
        parse_toml(text)
    assert time.process_time() - begin_s < 1.0  # Python alone takes 100 s


def test_text_with_many_points_is_no_deep_key():
    points = ".".join("a" * 100)
    assert parse_toml(f"# {points}\na = '{points}' # {points}\nb = ['{points}', \"{points}\"]")["a"] == points


def test_whole_numbers_of_64_bits_and_deep_tables_are_read():
    numbers = {"a": 2**64 - 1, "b": -(2**63)}
    assert parse_toml(f"a = {numbers['a']}\nb = {numbers['b']}") == numbers
    assert parse_toml(".".join("a" * 60) + " = 1")["a"]["a"]["a"]


@pytest.mark.parametrize("reader", TOML_READERS)
@pytest.mark.parametrize("name", ["decimal digits", "lists", "dotted keys"])
def test_every_reader_of_toml_rejects_the_rest_in_one_line(tmp_path, reader, name):
    path = tmp_path / "file.toml"
    path.write_text(UNUSABLE[name][0], "utf-8")
    with pytest.raises((EmulatorError, BenchError, ProtocolError, StaridError)) as refusal:
        TOML_READERS[reader](path)
    assert str(path) in str(refusal.value)
    assert "\n" not in str(refusal.value)
    if reader != "camera":  # which needs no more than its table
        assert re.search(UNUSABLE[name][1], str(refusal.value))


@pytest.mark.parametrize("value", ["9" * 5000, "0x" + "F" * 5000, '"x\\u0000"', "[" * 5000])
def test_a_setting_that_is_not_toml_is_text(value):
    with pytest.raises(EmulatorError, match="seed: must be a whole number") as refusal:
        load_profile("demo", [f"run.seed={value}"])
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("reader", [lambda path: read_user_file(path), lambda path: read_bytes(path, 9)])
def test_a_file_that_has_nothing_yet_is_rejected_without_waiting(tmp_path, monkeypatch, reader):
    """Such files are in /proc: here a pipe is taken for one."""
    path = tmp_path / "kmsg"
    os.mkfifo(path)
    monkeypatch.setattr(stat, "S_ISREG", lambda _mode: True)
    descriptor = os.open(path, os.O_RDWR)
    try:
        with pytest.raises(OSError, match="Resource temporarily unavailable"):
            reader(path)
    finally:
        os.close(descriptor)


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
