"""Reading files that a user names: regular files only, up to a size, so that no reader waits or fills the memory."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path
from typing import Final

MAX_BYTES: Final = 10_000_000
"""Largest file of settings that is read, bytes."""


class UnsuitableFileError(OSError):
    """What stands under a name is no file that can be read whole; `strerror` says why."""


def read_user_file(path: Path, limit: int = MAX_BYTES) -> bytes:
    """Return the content of a regular file; a pipe, a device or a socket is rejected without waiting for it.

    Raises
    ------
    OSError
        The file cannot be read, is not a regular one, or holds more than `limit` bytes; `strerror` says which.
    ValueError
        No file can have this name.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
    with os.fdopen(descriptor, "rb") as stream:
        mode = os.fstat(descriptor).st_mode
        if stat.S_ISDIR(mode):
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
        if not stat.S_ISREG(mode):
            raise UnsuitableFileError(errno.EINVAL, "not a regular file", str(path))
        content = stream.read(limit + 1)
    if len(content) > limit:
        raise UnsuitableFileError(errno.EFBIG, f"larger than {limit / 1e6:g} MB", str(path))
    return content


def read_user_text(path: Path, limit: int = MAX_BYTES) -> str:
    """Return the content of a regular UTF-8 file, without a byte order mark; UnicodeDecodeError if it is not UTF-8."""
    return read_user_file(path, limit).decode("utf-8-sig")
