"""Folders for the life of a process: removed at its end, or by the next process if it was killed."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest

from starid.storage import temporary_folder
from starid.storage.temporary_folder import make_temporary_folder
from tests.users import HAS_OTHERS, OTHER_USER
from tests.waiting import PATIENCE_S

PREFIX = "starhil-test-"
MAKES_ONE = f"""
import sys
from starid.storage.temporary_folder import make_temporary_folder
print(make_temporary_folder({PREFIX!r}), flush=True)
sys.stdin.read()
"""


@pytest.fixture
def base(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    return tmp_path


def age(folder: Path) -> None:
    then = time.time() - 2 * temporary_folder._NEW_S
    os.utime(folder, (then, then))


def process_with_a_folder() -> tuple[subprocess.Popen[str], Path]:
    process = subprocess.Popen(
        [sys.executable, "-c", MAKES_ONE], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    return process, Path(process.stdout.readline().strip())


@pytest.mark.parametrize("killed", [False, True])
def test_a_folder_is_removed_when_its_process_has_ended_however_it_ends(base: Path, killed: bool) -> None:
    """Each worker that was killed left 15 MB of kernels behind."""
    process, folder = process_with_a_folder()
    (folder / "kernel").write_text("code")
    age(folder)
    own = make_temporary_folder(PREFIX)
    assert folder.is_dir()  # its process runs
    if killed:
        process.kill()
    process.communicate(timeout=PATIENCE_S)
    if killed:
        assert folder.is_dir()
        make_temporary_folder(PREFIX)
    assert not folder.exists()
    assert own.is_dir()


def test_what_is_new_or_no_folder_of_the_user_stays(base: Path) -> None:
    new, other, link, target = (base / f"{PREFIX}{name}" for name in ("new", "other", "link", "x-target"))
    new.mkdir()
    target.mkdir()
    (target / "kept").write_text("")
    link.symlink_to(target.rename(base / "target"))
    (base / "target" / "more").mkdir()
    if HAS_OTHERS:
        other.mkdir()
        os.chown(other, OTHER_USER, OTHER_USER)
        age(other)
    make_temporary_folder(PREFIX)
    assert new.is_dir()
    assert (base / "target" / "kept").exists()
    assert not HAS_OTHERS or other.is_dir()
