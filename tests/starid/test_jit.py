"""The cache of compiled kernels: kept while the sources are the same, renewed when a callee changes."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from starid.jit import VerifiedCacheFile, source_stamp

CALLER = """
from other_kernels.inner import FACTOR, scaled
from starid.jit import compiled


@compiled
def outer(x: float) -> float:
    return scaled(x) + FACTOR


print(outer(1.0), sum(outer.stats.cache_hits.values()))
"""

INNER = """
from starid.jit import compiled

FACTOR = {factor}


@compiled
def scaled(x: float) -> float:
    return {slope} * x
"""


def run(folder: Path) -> list[str]:
    done = subprocess.run(
        [sys.executable, "-c", "import other_kernels.outer"],
        cwd=folder,
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout.split()


def test_a_changed_callee_in_another_module_is_noticed(tmp_path: Path) -> None:
    package = tmp_path / "other_kernels"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "outer.py").write_text(CALLER)
    (package / "inner.py").write_text(INNER.format(factor=0.5, slope=2.0))
    assert run(tmp_path) == ["2.5", "0"]
    assert run(tmp_path) == ["2.5", "1"], "the second process loads the machine code"
    (package / "inner.py").write_text(INNER.format(factor=0.5, slope=3.0))
    assert run(tmp_path) == ["3.5", "0"], "the old code is not run"


def test_stamps_follow_imports_only() -> None:
    assert source_stamp("starid.projection") == source_stamp("starid.projection")
    assert source_stamp("starid.projection") != source_stamp("starid.jit")


def truncated(data: bytes) -> bytes:
    return data[: len(data) // 2]


def emptied(_data: bytes) -> bytes:
    return b""


def zeroed(data: bytes) -> bytes:
    """As a file system may leave a file after a power failure: its length, without its content."""
    return data[:-100] + bytes(100)


def test_damaged_machine_code_is_removed_and_compiled_again(tmp_path: Path) -> None:
    package = tmp_path / "other_kernels"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "outer.py").write_text(CALLER)
    (package / "inner.py").write_text(INNER.format(factor=0.5, slope=2.0))
    assert run(tmp_path) == ["2.5", "0"]
    for suffix in ("nbc", "nbi"):
        files = list(package.rglob(f"*.{suffix}"))
        assert files
        for file in files:
            file.write_bytes(truncated(file.read_bytes()))
        assert run(tmp_path) == ["2.5", "0"], "compiled again"
    assert run(tmp_path) == ["2.5", "1"], "and kept"


@pytest.mark.parametrize("damage", [truncated, emptied, zeroed])
@pytest.mark.parametrize("suffix", ["nbi", "nbc"])
def test_a_damaged_cache_file_counts_as_missing_and_is_removed(tmp_path: Path, suffix: str, damage) -> None:
    file = VerifiedCacheFile(str(tmp_path), "kernel", "stamp")
    file.save("key", b"code" * 100)
    assert file.load("key") == b"code" * 100
    (path,) = tmp_path.glob(f"*.{suffix}")
    path.write_bytes(damage(path.read_bytes()))
    assert file.load("key") is None
    assert not path.exists()
    file.save("key", b"new")
    assert file.load("key") == b"new"


def test_machine_code_that_cannot_be_written_is_compiled_each_time(tmp_path: Path, monkeypatch) -> None:
    def full(*_arguments: object) -> None:
        raise OSError(28, "No space left on device")

    file = VerifiedCacheFile(str(tmp_path), "kernel", "stamp")
    monkeypatch.setattr(file, "_write", full)
    file.save("key", "code")
    assert file.load("key") is None
