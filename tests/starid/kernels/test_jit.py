"""Kernels: compiled by what numba publishes, cached while the sources are the same, never run from a damaged file."""

from __future__ import annotations

import ast
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import starid
from starid.arithmetic.arrays import Array
from starid.kernels import kernel_cache
from starid.kernels.jit import compiled, compiled_ieee, inner, inner_checked
from starid.storage.cache import cached_files, remove
from tests.waiting import PATIENCE_S

pytestmark = [pytest.mark.long, pytest.mark.lowest("numba")]

CALLER = """
from other_kernels.inner import FACTOR, scaled
from starid.kernels.jit import compiled


@compiled
def outer(x: float) -> float:
    return scaled(x) + FACTOR


print(outer(1.0), sum(outer.stats.cache_hits.values()))
"""

INNER = """
from starid.kernels.jit import inner

FACTOR = 0.5


@inner
def scaled(x: float) -> float:
    return {slope} * x
"""

RUN = """
import sys
from starid.kernels import kernel_cache
kernel_cache.PACKAGES = ("other_kernels",)
import other_kernels.outer
"""


CACHE = "STARHIL_CACHE_DIR"


@pytest.fixture(autouse=True)
def cache_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv(CACHE, str(tmp_path / "cache"))
    return tmp_path / "cache"


def write_package(folder: Path, *, slope: float = 2.0) -> Path:
    """Write a package with kernels; a file that would not change stays, since numba 0.60 knows it by its time."""
    package = folder / "other_kernels"
    package.mkdir(parents=True, exist_ok=True)
    for name, text in (("__init__", ""), ("outer", CALLER), ("inner", INNER.format(slope=slope))):
        path = package / f"{name}.py"
        if not path.exists() or path.read_text() != text:
            path.write_text(text)
    return folder


def process(folder: Path, umask: int = -1) -> subprocess.Popen[str]:
    """Start a process that calls the kernel; without bytecode, which is compared by the second of its source."""
    command = [sys.executable, "-B", "-c", RUN]
    environment = {**os.environ, "PYTHONPATH": str(folder)}
    return subprocess.Popen(
        command, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        umask=umask,
    )  # fmt: skip


def result(process: subprocess.Popen[str]) -> list[str]:
    """Result of the kernel in a process, and how often its machine code was loaded."""
    out, errors = process.communicate(timeout=PATIENCE_S)
    assert not errors, errors
    return out.split()


def run(folder: Path, umask: int = -1) -> list[str]:
    """The same in a new process."""
    return result(process(folder, umask))


def machine_code(cache_folder: Path) -> list[Path]:
    return [path for path in cache_folder.rglob("*") if path.suffix in (".nbi", ".nbc")]


def test_the_key_follows_what_modules_with_kernels_import(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.syspath_prepend(write_package(tmp_path))
    monkeypatch.setattr(kernel_cache, "PACKAGES", ("other_kernels",))
    key = kernel_cache.kernels_key()
    (tmp_path / "other_kernels" / "unrelated.py").write_text("X = 1\n")
    assert kernel_cache.kernels_key() == key
    (tmp_path / "other_kernels" / "inner.py").write_text(INNER.format(slope=4.0))
    assert kernel_cache.kernels_key() != key


def test_installations_elsewhere_and_other_processors_have_folders_of_their_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Progress counted the kernels of another checkout: all were compiled before the first was."""
    monkeypatch.setattr(kernel_cache, "PACKAGES", ("other_kernels",))
    keys = []
    for name in ("here", "there"):
        with monkeypatch.context() as context:
            context.syspath_prepend(write_package(tmp_path / name))
            keys.append(kernel_cache.kernels_key())
            context.setenv("NUMBA_CPU_NAME", "generic")
            keys.append(kernel_cache.kernels_key())
    assert len(set(keys)) == 4


def test_the_key_covers_every_module_with_kernels() -> None:
    key = set(kernel_cache.modules_with_kernels())
    holders = {path for path in sources() if b"from starid.kernels.jit import" in path.read_bytes()}
    assert len(holders) > 50
    assert {path.stem for path in holders} <= {name.rpartition(".")[2] for name in key}


def damage(path: Path, change: Callable[[bytes], bytes]) -> None:
    """Change the content of a file, not its time."""
    written_s = path.stat().st_mtime
    path.write_bytes(change(path.read_bytes()))
    os.utime(path, (written_s, written_s))


def truncated(data: bytes) -> bytes:
    return data[: len(data) // 2]


def emptied(_data: bytes) -> bytes:
    return b""


def zeroed(data: bytes) -> bytes:
    """As a file may be after a power failure: the right length, but no content."""
    return data[: len(data) // 2] + bytes(len(data) - len(data) // 2)


@pytest.mark.parametrize("change", [truncated, emptied, zeroed])
def test_a_damaged_file_is_removed(cache_folder: Path, change: Callable[[bytes], bytes]) -> None:
    folder = cache_folder / "kernels" / "0123456789abcdef"
    good, bad = folder / "package" / "good.nbc", folder / "package" / "bad.nbc"
    good.parent.mkdir(parents=True)
    for path in (good, bad):
        path.write_bytes(b"code" * 100)
    kernel_cache.record_checksums(folder)
    damage(bad, change)
    kernel_cache.remove_damaged(folder)
    assert (good.exists(), bad.exists()) == (True, False)


@pytest.fixture(scope="module")
def processes(tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    """What processes have printed, and what they have left of a cache that others may enter, as in the image of a container.

    Two start together on an empty cache. Of the others, of umask 0, the first has other sources. What the two have left was
    long unused before the second, and is damaged before the third.
    """
    folder = write_package(tmp_path_factory.mktemp("processes"))
    cache = folder / "cache"
    cache.mkdir()
    cache.chmod(0o755)
    with pytest.MonkeyPatch.context() as context:
        context.setenv(CACHE, str(cache))
        together = [result(each) for each in [process(folder, umask=0o022) for _ in range(2)]]
        printed = []
        reached = reached_by_others(cache)
        files = machine_code(cache)
        write_package(folder, slope=3.0)
        printed.append(run(folder, umask=0))
        write_package(folder)
        for each in cached_files():
            os.utime(each.path, (1000, 1000))
        printed.append(run(folder, umask=0))
        used_s = [each.used_s for each in cached_files()]
        whole = {file: file.read_bytes() for file in files}
        damages = {".nbi": truncated, ".nbc": zeroed}
        assert {path.suffix for path in files} == set(damages)
        for file in files:
            damage(file, damages[file.suffix])
        printed.append(run(folder, umask=0))
    return SimpleNamespace(
        cache=cache, together=together, printed=printed, used_s=used_s, reached_before=reached, whole=whole
    )


def test_a_changed_callee_in_another_module_is_detected(processes: SimpleNamespace) -> None:
    changed, former, _ = processes.printed
    assert changed == ["3.5", "0"], "the old code is not run"
    assert former == ["2.5", "1"], "that of the former sources is still there, and loaded"


def test_a_kernel_whose_machine_code_is_damaged_is_compiled_again_and_kept(
    processes: SimpleNamespace,
) -> None:
    assert processes.printed[-1] == ["2.5", "0"]
    files = set(processes.whole)
    for folder in {file.parent.parent for file in files}:
        kernel_cache.remove_damaged(folder)
    assert {
        file for file in files if file.exists() and len(file.read_bytes()) == len(processes.whole[file])
    } == files


def test_loaded_machine_code_counts_as_used(processes: SimpleNamespace) -> None:
    assert [used_s > 1000 for used_s in sorted(processes.used_s)] == [False, True]


def test_a_file_that_a_running_process_has_replaced_is_kept(cache_folder: Path) -> None:
    folder = cache_folder / "kernels" / "0123456789abcdef"
    path = folder / "package" / "kernel.nbi"
    path.parent.mkdir(parents=True)
    path.write_bytes(b"one signature")
    kernel_cache.record_checksums(folder)
    path.write_bytes(b"two signatures")
    later_s = time.time() + 1.0
    os.utime(path, (later_s, later_s))
    kernel_cache.remove_damaged(folder)
    assert path.exists()


def test_files_without_a_checksum_are_kept_while_their_process_may_run(cache_folder: Path) -> None:
    folder = cache_folder / "kernels" / "0123456789abcdef"
    new, old = folder / "package" / "new.nbc", folder / "package" / "old.nbc"
    new.parent.mkdir(parents=True)
    for path in (new, old):
        path.write_bytes(b"code")
    os.utime(old, (time.time() - 7200.0,) * 2)
    kernel_cache.remove_damaged(folder)
    assert (new.exists(), old.exists()) == (True, False)


def test_what_a_process_replaces_while_another_one_records_is_kept(
    cache_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of processes that started together, the last one to write had read the file before: all was compiled again."""
    folder = cache_folder / "kernels" / "0123456789abcdef"
    path = folder / "package" / "kernel.nbc"
    path.parent.mkdir(parents=True)
    path.write_bytes(b"code of the first")
    read, others = kernel_cache._checksum, []

    def replace() -> None:
        path.write_bytes(b"code of the second")
        kernel_cache.record_checksums(folder)

    def checksum(file: Path) -> int:
        content = read(file)
        if not others:
            others.append(threading.Thread(target=replace))
            others[0].start()
            others[0].join(1.0)
        return content

    monkeypatch.setattr(kernel_cache, "_checksum", checksum)
    kernel_cache.record_checksums(folder)
    others[0].join()
    kernel_cache.remove_damaged(folder)
    assert path.exists()


@pytest.mark.parametrize("text", ["", "{", "[1]", '{"package/gone.nbc": 1}'])
def test_a_damaged_list_of_checksums_is_written_again(cache_folder: Path, text: str) -> None:
    folder = cache_folder / "kernels" / "0123456789abcdef"
    path = folder / "package" / "new.nbc"
    path.parent.mkdir(parents=True)
    (folder / "checksums.json").write_text(text)
    os.utime(folder / "checksums.json", (1000, 1000))
    path.write_bytes(b"code")
    kernel_cache.remove_damaged(folder)
    kernel_cache.record_checksums(folder)
    assert list(json.loads((folder / "checksums.json").read_text())) == ["package/new.nbc"]


def test_processes_that_start_together_on_an_empty_cache_all_get_the_result(
    processes: SimpleNamespace,
) -> None:
    assert [value for value, _ in processes.together] == ["2.5", "2.5"]
    assert ["2.5", "0"] in processes.together, "one of them compiles"


def test_nothing_is_cached_on_a_disk_without_room_unless_all_is_cached_already(
    cache_folder: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """The start of a run ended with a traceback of numba, which could not write."""
    monkeypatch.setattr(kernel_cache, "kernels_key", lambda: "0123456789abcdef")
    monkeypatch.setattr(kernel_cache.atexit, "register", lambda *_arguments: None)
    monkeypatch.setenv("NUMBA_CACHE_DIR", "unchanged")
    monkeypatch.setattr(kernel_cache.shutil, "disk_usage", lambda _path: SimpleNamespace(free=1_000_000))
    assert not kernel_cache.use_kernel_cache()
    assert "no room on the disk for kernels" in caplog.text
    folder = cache_folder / "kernels" / "0123456789abcdef"
    folder.mkdir(parents=True)
    (folder / "checksums.json").write_text("{}")
    assert kernel_cache.use_kernel_cache()


def test_kernels_are_in_a_folder_of_the_process_where_the_cache_cannot_be_written_and_a_line_says_so(
    cache_folder: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    cache_folder.write_text("a file in the way")
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")
    monkeypatch.setattr("numba.config.CACHE_DIR", "")
    assert kernel_cache.use_kernel_cache()
    (record,) = caplog.records
    assert record.getMessage().startswith(
        f"{cache_folder}: kernels cannot be cached, so that each process compiles them; set STARHIL_CACHE_DIR"
    )
    folder = Path(os.environ["NUMBA_CACHE_DIR"])
    assert folder.is_dir()
    assert os.access(folder, os.W_OK | os.X_OK)


def reached_by_others(cache_folder: Path) -> list[Path]:
    """What others may enter or read, of the folder and what is in it."""
    found = [cache_folder] if cache_folder.stat().st_mode & 0o055 else []
    for folder in found:
        found += [each for each in folder.iterdir() if each.stat().st_mode & 0o055] if folder.is_dir() else []
    return found


@pytest.mark.skipif(sys.platform == "win32", reason="no umask there")
def test_others_cannot_change_kernels_whatever_the_umask(processes: SimpleNamespace) -> None:
    """In a folder made with mode 755, the kernels of a process with umask 0 could be replaced by anybody."""
    assert len(processes.reached_before) > 3
    assert machine_code(processes.cache)
    assert not [path for path in reached_by_others(processes.cache) if path.stat().st_mode & 0o022]


def test_a_cache_that_can_only_be_read_is_used(
    tmp_path: Path, cache_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = cache_folder / "kernels" / kernel_cache.kernels_key()
    (folder / "package").mkdir(parents=True)
    (folder / "package" / "kernel.nbc").write_bytes(b"code")
    monkeypatch.setattr("starid.kernels.kernel_cache.os.access", lambda *_arguments: False)
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")
    monkeypatch.setattr("numba.config.CACHE_DIR", "")
    assert kernel_cache.use_kernel_cache()
    copy = Path(os.environ["NUMBA_CACHE_DIR"])
    assert copy != folder
    assert (copy / "package" / "kernel.nbc").read_bytes() == b"code"
    assert copy.stat().st_mode & 0o777 == 0o700


def test_a_cache_that_can_be_neither_written_nor_copied_is_one_line(
    cache_folder: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """The line had the name and the reason of every kernel."""
    (cache_folder / "kernels" / kernel_cache.kernels_key()).mkdir(parents=True)
    monkeypatch.setattr("starid.kernels.kernel_cache.os.access", lambda *_arguments: False)

    def full(*_arguments: object, **_options: object) -> None:
        raise kernel_cache.shutil.Error([("a.nbc", "copy", "no space"), ("b.nbc", "copy", "no space")])

    monkeypatch.setattr(kernel_cache.shutil, "copytree", full)
    assert not kernel_cache.use_kernel_cache()
    assert [each.getMessage() for each in caplog.records] == [
        "kernels cannot be cached (no space): each process compiles them"
    ]


def folders_of_kernels(cache_folder: Path, *names: str) -> list[Path]:
    """Make folders of machine code."""
    folders = [cache_folder / "kernels" / name for name in names]
    for folder in folders:
        (folder / "package").mkdir(parents=True)
        (folder / "package" / "kernel.nbc").write_bytes(b"code")
        (folder / "package" / "kernel.nbi").write_bytes(b"index")
    return folders


def test_the_machine_code_of_former_sources_is_evicted_beyond_the_limit(
    cache_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    old, new = folders_of_kernels(cache_folder, "0123456789abcdef", "fedcba9876543210")
    kernel_cache.record_checksums(new)
    assert {each.path for each in cached_files()} == {old, new}
    monkeypatch.setenv("STARHIL_CACHE_LIMIT_MB", "0")
    (new / "package" / "kernel.nbc").write_bytes(b"another signature")
    kernel_cache.record_checksums(new)
    assert [each.path for each in cached_files()] == [new]


def test_clearing_the_cache_removes_machine_code(cache_folder: Path) -> None:
    folders_of_kernels(cache_folder, "0123456789abcdef")
    files = cached_files()
    assert all(each.size > 0 for each in files)
    assert files
    assert all(remove(each) for each in files)
    assert cached_files() == []
    assert machine_code(cache_folder) == []


@inner_checked
def checked_inverse(value: float) -> float:
    return 1.0 / value


@compiled_ieee
def inverse(value: float) -> float:
    return checked_inverse(value)


@inner
def ieee_inverse(value: float) -> float:
    return 1.0 / value


@compiled
def unbounded(values: Array) -> float:
    return ieee_inverse(values[0])


def test_only_a_checked_function_raises_for_division_by_zero() -> None:
    assert inverse(4.0) == 0.25
    with pytest.raises(ZeroDivisionError):
        inverse(0.0)
    assert unbounded(np.zeros(1)) == np.inf


def sources() -> Iterator[Path]:
    home = Path(starid.__file__).parent
    yield from home.rglob("*.py")
    for name in ("emulator", "protocol", "hil_tests"):
        yield from (home.parent / "starhil" / name).rglob("*.py")


def test_only_what_numba_publishes_is_used_and_sums_are_never_reordered() -> None:
    """numba is imported in one module, for `njit` and `register_jitable` with documented options; no name with an underscore, no fastmath."""
    documented = {"nogil", "cache", "error_model", "inline"}
    users = []
    for path in sources():
        source = path.read_bytes()
        if not any(word in source for word in (b"numba", b"llvmlite", b"fastmath")):
            continue
        tree = ast.parse(source)
        for node in ast.walk(tree):
            match node:
                case ast.Import(names=names):
                    modules = [each.name for each in names]
                case ast.ImportFrom(module=str(module)):
                    modules = [module]
                case ast.Constant(value=str(text)) if text.startswith(("numba.", "llvmlite.")):
                    modules = [text]
                case ast.keyword(arg="fastmath"):
                    raise AssertionError(f"{path}: fastmath reorders sums")
                case _:
                    continue
            if any(each.partition(".")[0] in ("numba", "llvmlite") for each in modules):
                users.append((path.name, ast.unparse(node)))
    assert users == [
        ("jit.py", "from numba import njit"),
        ("jit.py", "from numba.extending import register_jitable"),
    ]
    tree = ast.parse((Path(starid.__file__).parent / "kernels" / "jit.py").read_bytes())
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
    options = {word.arg for call in calls if ast.unparse(call.func) == "njit" for word in call.keywords}
    assert options == documented
