"""A temporary folder for one run; if the run is killed, the next one removes it."""

from __future__ import annotations

import fcntl
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

LOCK_NAME: Final = "owner.lock"
"""File that is locked while the owner of the folder is running; the kernel releases the lock."""


@contextmanager
def temporary_folder(prefix: str, base: Path | None = None) -> Iterator[Path]:
    """Create a temporary folder and remove it at the end, together with folders whose owner was killed.

    Abandoned folders with the same prefix are removed; `base` is the system's temporary folder by default.
    """
    root = Path(tempfile.gettempdir()) if base is None else base
    for folder in root.glob(f"{prefix}*"):
        _remove_abandoned(folder)
    folder = Path(tempfile.mkdtemp(prefix=prefix, dir=root))
    lock = os.open(folder / LOCK_NAME, os.O_CREAT | os.O_RDWR | os.O_CLOEXEC, 0o600)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield folder
    finally:
        shutil.rmtree(folder)
        os.close(lock)


def _remove_abandoned(folder: Path) -> None:
    """Remove a folder that no process has locked."""
    try:
        lock = os.open(folder / LOCK_NAME, os.O_RDWR | os.O_CLOEXEC)
    except OSError:  # another kind of folder, a folder being created, or another user's folder
        return
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        shutil.rmtree(folder)
    except OSError:  # its owner is running, or another process is removing it
        return
    finally:
        os.close(lock)
