import errno
import json
import os
import resource
import subprocess
import sys
import textwrap

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from starhil.emulator.device.state_store import STATE_FILE, FileStore
from starhil.emulator.errors import EmulatorError

STATE = {"boot_count": 3, "parameters": {"exposure": 50, "analog_gain": 1.5, "serial_dialect": "a"}}


def test_state_comes_back(tmp_path):
    store = FileStore(tmp_path / "deep" / "state")
    assert store.load() == {}
    store.save(STATE)
    store.close()
    again = FileStore(tmp_path / "deep" / "state")
    assert again.load() == STATE
    assert not again.corrupt
    again.close()


def test_a_folder_serves_one_emulator_at_a_time(tmp_path):
    store = FileStore(tmp_path)
    with pytest.raises(EmulatorError, match="in use by another"):
        FileStore(tmp_path)
    store.close()
    FileStore(tmp_path).close()


def test_a_lock_that_fails_for_another_reason_is_not_reported_as_in_use(tmp_path, monkeypatch):
    def no_locks(*_):
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr("fcntl.flock", no_locks)
    with pytest.raises(EmulatorError, match=r"cannot be used \(No locks available\)"):
        FileStore(tmp_path)


def test_a_folder_that_cannot_be_created_is_rejected(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(EmulatorError, match="--state-dir"):
        FileStore(tmp_path / "file")


def test_the_lock_follows_no_link_that_others_have_put_there(tmp_path):
    folder, elsewhere = tmp_path / "state", tmp_path / "elsewhere"
    folder.mkdir()
    (folder / "lock").symlink_to(elsewhere)
    with pytest.raises(EmulatorError, match=r"state folder .*: cannot be used .*--state-dir"):
        FileStore(folder)
    assert not elsewhere.exists()


def test_a_corrupt_file_that_cannot_be_renamed_is_one_line(tmp_path, monkeypatch):
    store = FileStore(tmp_path)
    store.path.write_text("corrupt")

    def read_only(*_arguments):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr(type(store.path), "replace", read_only)
    with pytest.raises(EmulatorError, match=r"device.json: is corrupt, and cannot be renamed .*; remove it$"):
        store.load()
    store.close()


def damaged(data: bytes, kind: str) -> bytes:
    return {
        "truncated": data[: len(data) // 2],
        "empty": b"",
        "other": b'{"format": 1}',
        "list": b"[]",
        "changed": data.replace(b"50", b"51"),
        "binary": bytes(range(256)),
        "other format": data.replace(b'"format": 1', b'"format": 2'),
    }[kind]


@pytest.mark.parametrize("kind", ["truncated", "empty", "other", "list", "changed", "binary", "other format"])
def test_a_corrupt_file_gives_defaults_and_a_flag_and_is_set_aside(tmp_path, kind):
    store = FileStore(tmp_path)
    store.save(STATE)
    path = tmp_path / STATE_FILE
    bad = damaged(path.read_bytes(), kind)
    path.write_bytes(bad)
    assert store.load() == {}
    assert store.corrupt
    assert (tmp_path / (STATE_FILE + ".corrupt")).read_bytes() == bad
    store.save(STATE)
    assert store.load() == STATE
    store.close()


def test_every_corrupt_file_is_kept(tmp_path):
    """The second one replaced the first."""
    store = FileStore(tmp_path)
    for text in ("first", "second", "third"):
        store.path.write_text(text)
        assert store.load() == {}
    kept = [tmp_path / f"{STATE_FILE}.corrupt{number}" for number in ("", "-2", "-3")]
    assert [path.read_text() for path in kept] == ["first", "second", "third"]
    store.close()


@pytest.mark.long
@settings(max_examples=40, deadline=None, derandomize=True)
@given(junk=st.binary(max_size=300))
def test_no_content_of_the_file_is_a_crash(tmp_path_factory, junk):
    folder = tmp_path_factory.mktemp("state")
    store = FileStore(folder)
    (folder / STATE_FILE).write_bytes(junk)
    assert store.load() == {}
    assert store.corrupt
    store.close()


def test_a_failing_disk_leaves_the_old_state(tmp_path, monkeypatch):
    store = FileStore(tmp_path)
    store.save(STATE)

    def full(_fd):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(EmulatorError, match="No space left"):
        store.save({"boot_count": 4})
    monkeypatch.undo()
    assert store.load() == STATE
    store.close()


@pytest.mark.process
def test_a_killed_writer_leaves_a_complete_state(tmp_path):
    program = textwrap.dedent(
        """
        import sys
        from pathlib import Path
        from starhil.emulator.device.state_store import FileStore
        store = FileStore(Path(sys.argv[1]))
        n = 0
        while True:
            n += 1
            store.save({"boot_count": n, "parameters": {"x": "y" * 20000}})
            print(n, flush=True)
        """
    )
    for _ in range(5):
        process = subprocess.Popen(
            [sys.executable, "-c", program, str(tmp_path)], stdout=subprocess.PIPE, text=True
        )
        for _ in range(7):
            last = int(process.stdout.readline())
        process.kill()
        process.wait()
        process.stdout.close()
        store = FileStore(tmp_path)
        state = store.load()
        assert not store.corrupt
        assert state["boot_count"] >= last
        assert json.dumps(state)
        store.close()


def test_a_full_disk_leaves_the_state_before_it_and_nothing_half_written(tmp_path):
    store = FileStore(tmp_path)
    store.save({"boot_count": 1})
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, limits[1]))
    try:
        with pytest.raises(EmulatorError, match="the previous state is kept"):
            store.save({"boot_count": 2})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert store.load() == {"boot_count": 1}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["device.json", "lock"]
    store.close()
