"""The cache on disk: its folder, its size limit, and cached tables of arrays."""

from __future__ import annotations

import contextlib
import logging
import math
import os
import re
import shutil
import stat
import sys
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from starid.storage.files import write_atomically
from starid.storage.temporary_folder import make_temporary_folder

_log = logging.getLogger(__name__)

Tables = dict[str, NDArray[np.generic]]

LIMIT_VARIABLE: Final = "STARHIL_CACHE_LIMIT_MB"
DEFAULT_LIMIT_MB: Final = 500.0
BYTES_PER_MB: Final = 1_000_000
_PRIVATE: Final = 0o700
_READABLE: Final = 0o755
CACHED_MODE: Final = 0o644
"""Mode of a cached file: nobody else may write to it, whatever the umask."""
_KERNELS: Final = "kernels"
KERNEL_SUFFIX: Final = ".nbc"
_OWN_NAME: Final = re.compile(
    rf"(?:hipparcos|stars|index|features)-[0-9a-f]{{16}}\.(?:npz|bin)|{_KERNELS}/[0-9a-f]{{16}}"
)
"""Paths that the cache owns, relative to its folder; nothing else in the folder is ever removed."""


def cache_dir() -> Path:
    """Return the folder for cached files, which exists unless it cannot be made.

    ``STARHIL_CACHE_DIR`` if set, else ``starhil`` under ``XDG_CACHE_HOME``, else under the platform's cache
    folder, else (without a home folder) a folder of the user under the temporary folder. Compiled kernels run as
    they are read, so a folder to which others can write is not used (`insecurity`): a warning is logged, and the
    folder under the temporary folder is used instead, or if that is not secure either, one of this process alone.
    """
    for folder in _folders():
        with contextlib.suppress(OSError, ValueError):
            folder.mkdir(_PRIVATE, parents=True, exist_ok=True)
        problem = insecurity(folder)
        if not problem:
            return folder
        _warn_not_used(folder, problem)
    return _folder_of_process()


def _folders() -> Iterator[Path]:
    """Yield the folders that may be used, the first choice first.

    The temporary folder is only looked for if the first is none: where no disk has room, there is no temporary folder.
    """
    chosen = _chosen_folder()
    if chosen is not None:
        yield chosen
    with contextlib.suppress(FileNotFoundError):
        yield Path(tempfile.gettempdir()) / f"starhil-cache-{_user()}"


def _chosen_folder() -> Path | None:
    """Return the folder that the environment names; None for a user without a home folder."""
    own = os.environ.get("STARHIL_CACHE_DIR")
    if own:
        return Path(own)
    xdg = os.environ.get("XDG_CACHE_HOME")
    if xdg and Path(xdg).is_absolute():
        return Path(xdg) / "starhil"
    local = os.environ.get("LOCALAPPDATA")
    if sys.platform == "win32" and local:
        return Path(local) / "starhil" / "cache"
    try:
        home = Path.home()
    except RuntimeError:
        return None
    return home / ("Library/Caches" if sys.platform == "darwin" else ".cache") / "starhil"


def _user() -> int:
    """Return the number of the user; 0 on Windows, where the temporary folder is the user's own."""
    return 0 if sys.platform == "win32" else os.geteuid()


def insecurity(folder: Path) -> str:
    """Return why others could put files into a folder, as text; empty if only its user and root can.

    The folder must belong to the user or to root, and so must what leads to it, links included. Nobody else may
    write there, except to a folder above it in which only owners can rename files (sticky, as ``/tmp``). Write
    permission of a group is accepted for the private group of the user: of the same name, without other members.
    A read-only cache of root in the image of a container is secure.
    """
    if sys.platform == "win32":
        return ""
    try:
        path = folder.absolute()
        resolved = path.resolve()
    except (
        OSError,
        ValueError,
        RuntimeError,
    ):  # no valid name, or a loop of links: nothing can be read there
        return ""
    for each in dict.fromkeys((path, resolved, *path.parents, *resolved.parents)):
        problem = _insecurity_of(each, may_be_sticky=each not in (path, resolved))
        if problem:
            return problem
    return ""


def _insecurity_of(path: Path, *, may_be_sticky: bool = False) -> str:
    """Return why others could change a file or folder, whatever is above it; empty if they cannot."""
    try:
        status = path.lstat()
    except (OSError, ValueError):  # not made yet, or another process has removed it
        return ""
    if status.st_uid not in (_user(), 0):
        return f"{path} belongs to user {status.st_uid}"
    if stat.S_ISLNK(status.st_mode) or (may_be_sticky and status.st_mode & stat.S_ISVTX):
        return ""
    return f"others may write to {path}" if _writers(status.st_mode, status.st_gid) else ""


def _is_private_group(group: int) -> bool:
    """Return whether a group has the name of the user, and no other members.

    Not group 0, to which every user of a container may belong.
    """
    import grp
    import pwd

    try:
        name, members = pwd.getpwuid(_user()).pw_name, grp.getgrgid(group)
    except KeyError:
        return False
    return group != 0 and members.gr_name == name and set(members.gr_mem) <= {name}


@cache
def _warn_not_used(folder: Path, problem: str) -> None:
    """Warn, once per folder and reason, that a cache folder is not secure."""
    _log.warning(
        "cache folder %s is not used: %s; set STARHIL_CACHE_DIR to a folder that only you can write to",
        folder,
        problem,
    )


@cache
def _folder_of_process() -> Path:
    """Make a folder for this process alone, which is removed at its end."""
    return make_temporary_folder("starhil-process-")


def kernel_folder(key: str) -> Path | None:
    """Return the folder for the machine code of a key (16 hexadecimal digits); None where it cannot be made.

    The folder need not exist yet.
    """
    folder = cache_dir() / _KERNELS / key
    problem = insecurity(folder) or next(filter(None, map(_insecurity_of, _shared_content(folder))), "")
    if problem:
        _warn_not_used(folder, problem)
        return _folder_of_process() / _KERNELS / key
    if folder.is_dir():
        return folder
    nearest = next(parent for parent in folder.parents if os.access(parent, os.F_OK))
    return folder if nearest.is_dir() and os.access(nearest, os.W_OK | os.X_OK) else None


def make_kernel_folder(folder: Path) -> None:
    """Make a folder for machine code, unless it exists; numba makes what is in it.

    If the umask lets others write to new files, as in some containers, nobody else may enter the folder.

    Raises
    ------
    OSError
        It cannot be made.
    """
    folder.parent.parent.mkdir(parents=True, exist_ok=True)
    folder.parent.mkdir(_READABLE, exist_ok=True)
    folder.mkdir(_READABLE, exist_ok=True)
    if _umask_lets_others_write():
        folder.chmod(_PRIVATE)


def _umask_lets_others_write() -> bool:
    if sys.platform == "win32":
        return False
    umask = os.umask(0o777 & ~_PRIVATE)
    os.umask(umask)
    return bool(_writers(0o777 & ~umask, os.getegid()))


def _writers(mode: int, group: int) -> int:
    """Return the bits of a mode by which others may write."""
    by_group = stat.S_IWGRP if mode & stat.S_IWGRP and not _is_private_group(group) else 0
    return by_group | mode & stat.S_IWOTH


def _shared_content(folder: Path) -> Iterator[Path]:
    """Yield what is in a folder, unless nobody else may enter it."""
    try:
        shared = sys.platform != "win32" and folder.stat().st_mode & ~_PRIVATE & 0o777
    except OSError:  # not made yet
        return
    if shared:
        yield from folder.rglob("*")


@dataclass(frozen=True)
class CachedFile:
    """A cached file, or a folder of machine code, which is kept or removed as a whole."""

    path: Path
    size: int
    """Bytes."""
    used_s: float
    """Time of the last use, Unix time in seconds."""

    @property
    def name(self) -> str:
        """Path relative to the cache folder."""
        return _name(self.path)


def _name(path: Path) -> str:
    """Path relative to the cache folder: machine code is one level down."""
    return f"{_KERNELS}/{path.name}" if path.parent.name == _KERNELS else path.name


def cached_files() -> list[CachedFile]:
    """Return the cached files, least recently used first."""
    files = []
    folder = cache_dir()
    for path in (*folder.glob("*"), *folder.glob(f"{_KERNELS}/*")):
        if _OWN_NAME.fullmatch(_name(path)):
            try:
                state = path.stat()
                size = _size_of_folder(path) if path.is_dir() else state.st_size
            except OSError:  # another process has removed it, or it is a link to nowhere
                continue
            files.append(CachedFile(path, size, state.st_mtime))
    return sorted(files, key=lambda each: each.used_s)


def _size_of_folder(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if not path.is_dir())


def kernels_written_since(unix_s: float) -> int:
    """Return how many kernels have been compiled into the cache since a Unix time in seconds."""
    count = 0
    for path in cache_dir().glob(f"{_KERNELS}/*/*/*{KERNEL_SUFFIX}"):
        try:
            count += path.stat().st_mtime >= unix_s
        except FileNotFoundError:  # another process has removed it
            continue
    return count


def size_limit() -> int:
    """Return the size limit of the cache in bytes: ``STARHIL_CACHE_LIMIT_MB``, else 500 MB.

    An invalid value is logged and the default used.
    """
    text = os.environ.get(LIMIT_VARIABLE) or f"{DEFAULT_LIMIT_MB:g}"
    try:
        limit = float(text)
    except ValueError:
        limit = math.nan
    if not 0 <= limit < math.inf:
        _log.warning(
            "%s is %r: must be a number of megabytes; %g applies", LIMIT_VARIABLE, text, DEFAULT_LIMIT_MB
        )
        limit = DEFAULT_LIMIT_MB
    return round(limit * BYTES_PER_MB)


def mark_used(path: Path) -> None:
    """Record that a cached file or folder has just been used."""
    try:
        os.utime(path)
    except OSError as error:  # a read-only cache, or another user's file
        _log.debug("cache file %s cannot be marked as used: %s", path, error)


def evict(keep: Path) -> None:
    """Remove the least recently used cached files until the cache is within its limit, but never `keep`."""
    files = cached_files()
    if all(each.path != keep for each in files):  # written to a folder outside the cache
        return
    excess = sum(each.size for each in files) - size_limit()
    for each in files:
        if excess <= 0:
            return
        if each.path != keep and remove(each):
            excess -= each.size


def remove(file: CachedFile) -> bool:
    """Remove a cached file; log a warning and return False where that is not allowed."""
    try:
        if file.path.is_dir():
            shutil.rmtree(file.path)
        else:
            file.path.unlink()
    except FileNotFoundError:  # another process has removed it
        return True
    except OSError as error:
        _log.warning("cache file %s cannot be removed: %s", file.path, error)
        return False
    return True


def cached_tables(name: str, build: Callable[[], Tables]) -> Tables:
    """Load arrays from the cache, or build and cache them.

    Parameters
    ----------
    name : str
        File name without suffix. It must depend on everything on which the arrays depend.
    build : callable
        Returns the arrays by name.

    Returns
    -------
    dict of ndarray
        The arrays. The file is an uncompressed ``.npz``, whose checksums are verified on loading. A file that
        is damaged or cannot be read is built again; if the folder cannot be written, nothing is cached.
    """
    path = cache_dir() / f"{name}.npz"
    try:
        if path.is_file():  # raises if the folder cannot be searched
            with np.load(path, allow_pickle=False) as stored:
                tables = {key: stored[key] for key in stored.files}
            mark_used(path)
            return tables
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        _log.warning("cache file %s is not usable (%s): built again", path, error)
    tables = build()

    def write(part: Path) -> None:
        with part.open("wb") as stream:
            np.savez(stream, allow_pickle=False, **tables)

    try:
        write_atomically(path, write, mode=CACHED_MODE)
        evict(keep=path)
    except OSError as error:
        _log.warning("cache file %s cannot be written (%s): computed again each time", path, error)
    return tables
