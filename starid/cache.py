"""Things that are computed once and kept: the folder for them, and tables written whole or not at all."""

from __future__ import annotations

import errno
import logging
import os
import shutil
import sys
import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from starid.files import is_stream, open_stream

_log = logging.getLogger(__name__)

Tables = dict[str, NDArray[np.generic]]


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
                return {key: stored[key] for key in stored.files}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        _log.warning("cache file %s is not usable (%s): built anew", path, error)
    tables = build()

    def write(part: Path) -> None:
        with part.open("wb") as stream:
            np.savez(stream, allow_pickle=False, **tables)

    try:
        write_atomically(path, write)
    except OSError as error:
        _log.warning("cache file %s cannot be written (%s): computed again each time", path, error)
    return tables
