"""Things that are computed once and kept: the folder for them, and tables written whole or not at all."""

from __future__ import annotations

import logging
import os
import sys
import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

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
    """Let `write` fill a temporary file in the same folder, then move it onto `path` in one step.

    Parameters
    ----------
    path : Path
        Final name; missing folders are made.
    write : callable
        Gets the temporary path. If it raises, nothing is left behind and `path` is untouched.

    Raises
    ------
    OSError
        The folder cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    descriptor, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".part", dir=path.parent)
    os.close(descriptor)
    part = Path(name)
    try:
        write(part)
        part.chmod(0o644)
        part.replace(path)
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
