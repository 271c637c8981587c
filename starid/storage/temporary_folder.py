"""Folders in the temporary folder for the life of a process, and locks of folders."""

from __future__ import annotations

import atexit
import contextlib
import os
import shutil
import stat
import sys
import tempfile
import time
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Final

_NEW_S: Final = 60.0
"""Age below which a folder that nobody holds may have been made just now, seconds."""
_MOST: Final = 1000
"""Number of folders that are examined: others may have made any number."""
_RETRY_S: Final = 0.02
_held: Final[list[int]] = []
"""Descriptors of the folders of this process, which hold their locks until it ends."""


def make_temporary_folder(prefix: str) -> Path:
    """Make a folder that is removed at the end of the process, and remove those of processes that were killed.

    Parameters
    ----------
    prefix
        Begin of its name, which no other kind of folder has.

    Raises
    ------
    OSError
        It cannot be made.
    """
    if sys.platform != "win32":
        _remove_abandoned(prefix)
    folder = Path(tempfile.mkdtemp(prefix=prefix))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    if sys.platform != "win32":
        with contextlib.suppress(OSError):  # it is abandoned only if the process is killed
            _held.append(_lock(folder))
    return folder


@contextlib.contextmanager
def locked(folder: Path, patience_s: float) -> Iterator[None]:
    """Lock a folder while the body runs, or do without a lock after some time, or where there is none."""
    descriptor = None
    end_s = time.monotonic() + patience_s
    while descriptor is None and sys.platform != "win32":
        try:
            descriptor = _lock(folder)
        except BlockingIOError:
            if time.monotonic() > end_s:
                break
            time.sleep(_RETRY_S)
        except OSError:  # of a file system without locks
            break
    try:
        yield
    finally:
        if descriptor is not None:
            os.close(descriptor)


def _lock(folder: Path) -> int:
    """Lock a folder until the process ends or the descriptor is closed; BlockingIOError if another process has."""
    import fcntl

    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        raise
    return descriptor


def _remove_abandoned(prefix: str) -> None:
    for folder in islice(Path(tempfile.gettempdir()).glob(f"{prefix}*"), _MOST):
        with contextlib.suppress(OSError):  # in use, of another user, or removed by another process
            status = folder.lstat()
            if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.geteuid():
                continue
            if time.time() - status.st_mtime > _NEW_S:
                descriptor = _lock(folder)
                shutil.rmtree(folder, ignore_errors=True)
                os.close(descriptor)
