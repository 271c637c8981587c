"""Reading of files named by a user: regular files only, up to a size limit."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path
from typing import Final

MAX_BYTES: Final = 10_000_000
"""Default size limit, bytes."""


class UnsuitableFileError(OSError):
    """A path that is not a regular file, or is too large; `strerror` gives the reason."""


def read_user_file(path: Path, limit: int = MAX_BYTES) -> bytes:
    """Return the content of a regular file; a pipe, a device or a socket is rejected without waiting for it.

    Raises
    ------
    OSError
        The file cannot be read, is not a regular file, or holds more than `limit` bytes; `strerror` gives the
        reason.
    ValueError
        The name is not a valid file name.
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
    """Return the text of a regular UTF-8 file, without a byte order mark.

    Raises as `read_user_file`, and UnicodeDecodeError.
    """
    return read_user_file(path, limit).decode("utf-8-sig")
