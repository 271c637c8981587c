"""The folder in which numba caches the machine code of kernels.

It is in the cache folder (`starid.storage.cache`), one for each state of the sources: numba notices that the file of a kernel has
changed, but not that a function or constant which the kernel takes from another file has. Numba keeps the kernels of files at
other paths and for other processors apart, so each has a folder of its own, in which all files are its kernels. Installations
at the same path with equal sources share it. Numba does not check what it loads, so each file's checksum is kept beside it; a damaged file
is removed, and its kernel compiled again.
"""

from __future__ import annotations

import atexit
import hashlib
import importlib.metadata
import importlib.util
import json
import logging
import os
import re
import shutil
import sys
import time
import zlib
from pathlib import Path
from typing import Final

from starid.storage.cache import (
    CACHED_MODE,
    KERNEL_SUFFIX,
    cache_dir,
    evict,
    kernel_folder,
    make_kernel_folder,
    mark_used,
)
from starid.storage.files import write_atomically
from starid.storage.temporary_folder import locked, make_temporary_folder
from starid.storage.working_folder import check_working_folder

_log = logging.getLogger(__name__)

PACKAGES: Final = ("starid", "starhil/emulator/sensor")
"""Packages of which modules hold kernels."""

_VERSIONS: Final = ("numba", "numpy")
_PROCESSOR: Final = ("NUMBA_CPU_NAME", "NUMBA_CPU_FEATURES")
"""Environment variables that name the processor to compile for; by default this one."""
_CHECKSUMS: Final = "checksums.json"
_PATIENCE_S: Final = 5.0
"""Longest time for which a process waits until another one has recorded its checksums, seconds."""
_ROOM_BYTES: Final = 40_000_000
"""Free space with which kernels are cached: they take 15 MB, and are written beside the old ones."""
_PRIVATE: Final = 0o700
_UNFINISHED_S: Final = 3600.0
"""Time after which a file without a checksum was left by a process that did not end properly, seconds."""

_HOLDS_KERNELS: Final = b"from starid.kernels.jit import"
_IMPORT: Final = re.compile(rb"^(?:from|import)[ \t]+([\w.]+)(?:[ \t]+import[ \t]+(.+))?", re.MULTILINE)


def use_kernel_cache() -> bool:
    """Let numba, which is imported later, cache kernels, and return whether it can.

    Where the folder in the cache cannot be written, a copy of it in the temporary folder is used, which is removed at the
    end of the process; if that leaves kernels to be compiled, a warning is logged.
    """
    check_working_folder()
    key = kernels_key()
    folder = kernel_folder(key)
    try:
        if folder is not None and not _has_room(folder) and not (folder / _CHECKSUMS).exists():
            _log.warning("%s: no room on the disk for kernels, so that each process compiles them", folder)
            return False
        if folder is None or (folder.exists() and not os.access(folder, os.W_OK | os.X_OK)):
            folder = _temporary_copy(folder or cache_dir() / key)
        else:
            make_kernel_folder(folder)
            mark_used(folder)
            atexit.register(record_checksums, folder, time.time())
        remove_damaged(folder)
    except OSError as error:
        why = error.args[0][0][-1] if isinstance(error, shutil.Error) else error  # of the first of all files
        _log.warning("kernels cannot be cached (%s): each process compiles them", why)
        return False
    os.environ["NUMBA_CACHE_DIR"] = str(folder)
    if "numba" in sys.modules:  # which has read its environment already
        sys.modules["numba"].config.CACHE_DIR = str(folder)
    return True


def _has_room(folder: Path) -> bool:
    """Return whether the disk of a folder, which need not exist, has room for all kernels: numba fails where it has not."""
    nearest = next(each for each in (folder, *folder.parents) if each.exists())
    return shutil.disk_usage(nearest).free >= _ROOM_BYTES


def nothing_compiled() -> bool:
    """Return whether the folder in the cache has no kernel yet, so that processes can share the work of the first start."""
    folder = Path(os.environ.get("NUMBA_CACHE_DIR", ""))
    return folder.parent == cache_dir() / "kernels" and not any(folder.glob(f"*/*{KERNEL_SUFFIX}"))


def _temporary_copy(folder: Path) -> Path:
    """Copy a folder of kernels to one that is removed at the end of the process."""
    copy = make_temporary_folder("starhil-kernels-")
    if folder.is_dir():
        shutil.copytree(folder, copy, dirs_exist_ok=True)
        copy.chmod(_PRIVATE)  # others may have entered the original
    else:
        _log.warning(
            "%s: kernels cannot be cached, so that each process compiles them; set STARHIL_CACHE_DIR to a folder that "
            "can be written",
            cache_dir(),
        )
    return copy


def remove_damaged(folder: Path) -> None:
    """Remove the files of a folder of kernels that differ from their checksums, or were left without one.

    A file that is newer than the checksums, but not old, belongs to a process that runs and will record it.
    """
    checksums, recorded_s = _read_checksums(folder)
    running_s = max(recorded_s, time.time() - _UNFINISHED_S)
    for path, name in _files(folder):
        try:
            if path.stat().st_mtime > running_s or checksums.get(name) == _checksum(path):
                continue
            _log.info("%s: damaged, or left by a process that was ended: removed; compiled again", path)
            path.unlink(missing_ok=True)
        except FileNotFoundError:  # another process has replaced it
            continue


def record_checksums(folder: Path, since_s: float = 0.0) -> None:
    """Write the checksums of the files that were written since a Unix time, then keep the cache within its limit.

    One process at a time does so: another one may have replaced a file since this one has read it.
    """
    with locked(folder, _PATIENCE_S):
        checksums, _ = _read_checksums(folder)
        current = {}
        for path, name in _files(folder):
            try:
                known = name in checksums and path.stat().st_mtime < since_s
                current[name] = checksums[name] if known else _checksum(path)
            except FileNotFoundError:  # another process has replaced it
                continue
        if current == checksums:
            return
        try:
            write_atomically(
                folder / _CHECKSUMS, lambda part: part.write_text(json.dumps(current)), mode=CACHED_MODE
            )
        except OSError as error:
            _log.warning("%s: cannot be written (%s): kernels are compiled again", folder, error.strerror)
    evict(keep=folder)


def _files(folder: Path) -> list[tuple[Path, str]]:
    """Return the files of numba in a folder of kernels, each with its name in the list of checksums."""
    return [(path, path.relative_to(folder).as_posix()) for path in folder.glob("*/*.nb[ic]")]


def _checksum(path: Path) -> int:
    return zlib.crc32(path.read_bytes())


def _read_checksums(folder: Path) -> tuple[dict[str, int], float]:
    """Return the checksums of files by name, and the Unix time of their record; none if there is none, or it is damaged."""
    path = folder / _CHECKSUMS
    try:
        checksums = json.loads(path.read_bytes())
        if isinstance(checksums, dict):
            return checksums, path.stat().st_mtime
    except (OSError, ValueError):
        pass
    return {}, 0.0


def kernels_key() -> str:
    """Return 16 hexadecimal digits for the modules with kernels, all that they import, where they are, numba and the processor."""
    digest = hashlib.sha256()
    for name in _VERSIONS:
        digest.update(f"{name} {importlib.metadata.version(name)}\n".encode())
    for name in _PROCESSOR:
        digest.update(f"{name} {os.environ.get(name, '')}\n".encode())
    for _, home in _homes():
        digest.update(os.fsencode(home) + b"\n")
    for module, source in sorted(modules_with_kernels().items()):
        digest.update(module.encode() + b"\0" + source + b"\0")
    return digest.hexdigest()[:16]


def modules_with_kernels() -> dict[str, bytes]:
    """Return the sources of the modules with kernels and of those that they import, directly or not, by name."""
    sources, waiting = {}, []
    for name, home in _homes():
        top, _, rest = name.partition("/")
        for path in (home / rest).rglob("*.py"):
            module = ".".join((top, *path.relative_to(home).with_suffix("").parts)).removesuffix(".__init__")
            sources[module] = path.read_bytes()
            if _HOLDS_KERNELS in sources[module]:
                waiting.append(module)
    needed: dict[str, bytes] = {}
    while waiting:
        module = waiting.pop()
        if module in needed or module not in sources:
            continue
        needed[module] = sources[module]
        for package, members in _IMPORT.findall(sources[module]):
            waiting.append(package.decode())
            waiting += [f"{package.decode()}.{member}" for member in re.findall(r"\w+", members.decode())]
    return needed


def _homes() -> list[tuple[str, Path]]:
    """Return each of `PACKAGES` with the folder of its top package."""
    specs = [(name, importlib.util.find_spec(name.partition("/")[0])) for name in PACKAGES]
    return [
        (name, Path(home))
        for name, spec in specs
        for home in (spec.submodule_search_locations if spec else None) or ()
    ]
