"""Things that are computed once and kept: the folder for them, its size limit, and tables written whole or not at all."""

from __future__ import annotations

import errno
import logging
import math
import os
import re
import shutil
import sys
import tempfile
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from starid.files import is_stream, open_stream

_log = logging.getLogger(__name__)

Tables = dict[str, NDArray[np.generic]]

LIMIT_VARIABLE: Final = "STARHIL_CACHE_LIMIT_MB"
DEFAULT_LIMIT_MB: Final = 500.0
BYTES_PER_MB: Final = 1_000_000
_OWN_NAME: Final = re.compile(r"(?:hipparcos|index|features)-[0-9a-f]{16}\.(?:npz|bin)")
"""Names of cached files: whatever else is in the folder is not ours to remove."""


def cache_dir() -> Path:
    """Return the folder for cached files; it need not exist yet.

    ``STARHIL_CACHE_DIR`` if set, else ``starhil`` under ``XDG_CACHE_HOME``, else under the platform's cache
    folder, else (no home folder) under the temporary folder.
    """
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
        return Path(tempfile.gettempdir()) / "starhil-cache"
    return home / ("Library/Caches" if sys.platform == "darwin" else ".cache") / "starhil"


@dataclass(frozen=True)
class CachedFile:
    """A file in the cache folder."""

    path: Path
    size: int
    """Bytes."""
    used_s: float
    """When it was last used, seconds since 1970."""


def cached_files() -> list[CachedFile]:
    """Return the cached files, the least recently used first."""
    found = []
    folder = cache_dir()
    for path in folder.iterdir() if folder.is_dir() else ():
        if _OWN_NAME.fullmatch(path.name):
            try:
                state = path.stat()
            except FileNotFoundError:  # another process has removed it
                continue
            found.append(CachedFile(path, state.st_size, state.st_mtime))
    return sorted(found, key=lambda each: each.used_s)


def size_limit() -> int:
    """Return how many bytes the cached files may have together: ``STARHIL_CACHE_LIMIT_MB``, else 500 MB.

    A value that is no number of at least 0 is reported in the log, and the default holds.
    """
    text = os.environ.get(LIMIT_VARIABLE) or f"{DEFAULT_LIMIT_MB:g}"
    try:
        limit = float(text)
    except ValueError:
        limit = math.nan
    if not 0 <= limit < math.inf:
        _log.warning(
            "%s is %r: must be a number of megabytes; %g holds", LIMIT_VARIABLE, text, DEFAULT_LIMIT_MB
        )
        limit = DEFAULT_LIMIT_MB
    return round(limit * BYTES_PER_MB)


def mark_used(path: Path) -> None:
    """Note that a cached file was used now, so that others are evicted before it."""
    try:
        os.utime(path)
    except OSError as error:  # a read-only cache, or the file of another user
        _log.debug("cache file %s cannot be marked as used: %s", path, error)


def evict(keep: Path) -> None:
    """Remove the least recently used cached files until the limit holds; `keep`, just written, stays."""
    if keep.parent != cache_dir():
        return
    files = cached_files()
    excess = sum(each.size for each in files) - size_limit()
    for each in files:
        if excess <= 0:
            return
        if each.path != keep and remove(each):
            excess -= each.size


def remove(file: CachedFile) -> bool:
    """Remove a cached file; False, with a warning in the log, where that is not allowed."""
    try:
        file.path.unlink(missing_ok=True)
    except OSError as error:
        _log.warning("cache file %s cannot be removed: %s", file.path, error)
        return False
    return True


def write_atomically(path: Path, write: Callable[[Path], object]) -> None:
    """Let `write` fill a temporary file, then move it onto `path` in one step.

    Where `path` is a link, the file that it leads to is replaced. What is no regular file (a device, a pipe, the
    standard output) gets the content written into it when all of it is there.

    Parameters
    ----------
    path : Path
        Final name; missing folders are made.
    write : callable
        Gets the temporary path. If it raises, nothing is left behind and `path` is untouched.

    Raises
    ------
    OSError
        The folder cannot be written, or `path` is a folder itself.
    """
    if is_stream(path):
        with tempfile.TemporaryDirectory() as folder:
            whole = Path(folder, path.name)
            write(whole)
            with whole.open("rb") as content, open_stream(path) as stream:
                shutil.copyfileobj(content, stream)
        return
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    target = Path(os.path.realpath(path))
    target.parent.mkdir(parents=True, exist_ok=True)
    descriptor, name = tempfile.mkstemp(prefix=f".{target.name}.", suffix=".part", dir=target.parent)
    os.close(descriptor)
    part = Path(name)
    try:
        write(part)
        part.chmod(0o644)
        part.replace(target)
    finally:
        part.unlink(missing_ok=True)


def cached_tables(name: str, build: Callable[[], Tables]) -> Tables:
    """Load arrays from the cache, or build and keep them.

    Parameters
    ----------
    name : str
        File name without suffix. It must change with whatever the arrays are made from: a stale file is
        one with another name.
    build : callable
        Makes the arrays by name.

    Returns
    -------
    dict of ndarray
        As built. The file is an uncompressed ``.npz``, whose checksums are verified on loading; a damaged
        one, or one that cannot be read, is built anew. Where the folder cannot be written the arrays are
        only returned.
    """
    path = cache_dir() / f"{name}.npz"
    try:
        if path.is_file():  # which raises where the folder cannot be searched
            with np.load(path, allow_pickle=False) as stored:
                tables = {key: stored[key] for key in stored.files}
            mark_used(path)
            return tables
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        _log.warning("cache file %s is not usable (%s): built anew", path, error)
    tables = build()

    def write(part: Path) -> None:
        with part.open("wb") as stream:
            np.savez(stream, allow_pickle=False, **tables)

    try:
        write_atomically(path, write)
        evict(keep=path)
    except OSError as error:
        _log.warning("cache file %s cannot be written (%s): computed again each time", path, error)
    return tables
