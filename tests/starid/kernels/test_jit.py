"""The cache of compiled kernels: kept while the sources are the same, renewed when a callee changes."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from starid.kernels.store import read_verified, source_stamp, write_verified
from starid.storage.cache import cached_files, remove

CALLER = """
from other_kernels.inner import FACTOR, scaled
from starid.kernels.jit import compiled


@compiled
def outer(x: float) -> float:
    return scaled(x) + FACTOR


print(outer(1.0), 1 - outer.store.compilations)
"""

INNER = """
from starid.kernels.jit import compiled

FACTOR = {factor}


@compiled
def scaled(x: float) -> float:
    return {slope} * x
"""


@pytest.fixture(autouse=True)
def cache_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("STARHIL_CACHE_DIR", str(tmp_path / "cache"))
    return tmp_path / "cache"


def write_package(folder: Path, *, slope: float = 2.0) -> None:
    package = folder / "other_kernels"
    package.mkdir(parents=True, exist_ok=True)
    (package / "__init__.py").write_text("")
    (package / "outer.py").write_text(CALLER)
    (package / "inner.py").write_text(INNER.format(factor=0.5, slope=slope))


def run(folder: Path) -> list[str]:
    """Result of the kernel in a new process, and how often its machine code was loaded."""
    done = subprocess.run(
        [
            sys.executable,
            "-B",
            "-c",
            "import other_kernels.outer",
        ],  # bytecode is compared by the second of its source
        cwd=folder,
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout.split()


def test_a_changed_callee_in_another_module_is_detected(tmp_path: Path) -> None:
    write_package(tmp_path)
    assert run(tmp_path) == ["2.5", "0"]
    assert run(tmp_path) == ["2.5", "1"], "the second process loads the machine code"
    write_package(tmp_path, slope=3.0)
    assert run(tmp_path) == ["3.5", "0"], "the old code is not run"


def test_copies_of_a_package_share_machine_code_while_their_sources_are_equal(tmp_path: Path) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    write_package(first)
    write_package(second)
    assert run(first) == ["2.5", "0"]
    assert run(second) == ["2.5", "1"], "compiled once for both"
    write_package(second, slope=3.0)
    assert run(second) == ["3.5", "0"], "other sources are compiled again"
    assert run(first) == ["2.5", "1"], "and leave the code of the first in place"
    assert run(second) == ["3.5", "1"]
    assert not list(tmp_path.glob("*/other_kernels/**/*.kernel")), "nothing is kept beside the sources"


def test_machine_code_is_cached_beside_the_sources_if_the_cache_folder_cannot_be_made(
    tmp_path: Path, cache_folder: Path
) -> None:
    cache_folder.write_text("a file in the way")
    write_package(tmp_path)
    assert run(tmp_path) == ["2.5", "0"]
    assert run(tmp_path) == ["2.5", "1"]


def test_kernels_run_if_machine_code_cannot_be_cached(tmp_path: Path, cache_folder: Path) -> None:
    cache_folder.write_text("a file in the way")
    write_package(tmp_path)
    (tmp_path / "other_kernels" / "__pycache__").write_text("a file in the way")
    assert run(tmp_path) == ["2.5", "0"]
    assert run(tmp_path) == ["2.5", "0"]


def test_the_least_recently_used_machine_code_is_evicted_beyond_the_limit(
    tmp_path: Path, cache_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STARHIL_CACHE_LIMIT_MB", "0")
    write_package(tmp_path)
    assert run(tmp_path) == ["2.5", "0"]
    (old,) = [each.path for each in cached_files()]
    write_package(tmp_path, slope=3.0)
    assert run(tmp_path) == ["3.5", "0"]
    assert [each.path for each in cached_files() if each.path == old] == []
    assert cached_files(), "the machine code of the last kernel stays"


def test_loaded_machine_code_counts_as_used(tmp_path: Path) -> None:
    write_package(tmp_path)
    run(tmp_path)
    for each in cached_files():
        os.utime(each.path, (1000, 1000))
    run(tmp_path)
    assert any(each.used_s > 1000 for each in cached_files())


def test_clearing_the_cache_removes_machine_code(tmp_path: Path) -> None:
    write_package(tmp_path)
    run(tmp_path)
    files = cached_files()
    assert all(each.size > 0 for each in files)
    assert files
    assert all(remove(each) for each in files)
    assert cached_files() == []
    assert run(tmp_path) == ["2.5", "0"]


def test_stamps_follow_imports_only() -> None:
    assert source_stamp("starid.camera.projection") == source_stamp("starid.camera.projection")
    assert source_stamp("starid.camera.projection") != source_stamp("starid.kernels.jit")


def truncated(data: bytes) -> bytes:
    return data[: len(data) // 2]


def emptied(_data: bytes) -> bytes:
    return b""


def zeroed(data: bytes) -> bytes:
    """As a file may be after a power failure: the right length, but no content."""
    return data[:-100] + bytes(100)


def test_damaged_machine_code_is_removed_and_compiled_again(tmp_path: Path, cache_folder: Path) -> None:
    write_package(tmp_path)
    assert run(tmp_path) == ["2.5", "0"]
    files = list(cache_folder.rglob("*.kernel"))
    assert len(files) == 1, "the kernel contains the one that it calls"
    for file in files:
        file.write_bytes(truncated(file.read_bytes()))
    assert run(tmp_path) == ["2.5", "0"], "compiled again"
    assert run(tmp_path) == ["2.5", "1"], "and kept"


@pytest.mark.parametrize("damage", [truncated, emptied, zeroed])
def test_a_damaged_cache_file_counts_as_missing_and_is_removed(tmp_path: Path, damage) -> None:
    path = tmp_path / "folder" / "code.kernel"
    assert read_verified(path) is None
    write_verified(path, b"code" * 100)
    assert read_verified(path) == b"code" * 100
    path.write_bytes(damage(path.read_bytes()))
    assert read_verified(path) is None
    assert not path.exists()
    write_verified(path, b"new")
    assert read_verified(path) == b"new"
