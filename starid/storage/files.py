"""Reading and writing files named by the user.

Only regular files up to a size limit are read; text may begin with a byte order mark. Output to a device, a
pipe or standard output is written into it, not moved over it.
"""

from __future__ import annotations

import contextlib
import errno
import math
import os
import re
import secrets
import shutil
import stat
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO, Final

MEGABYTE: Final = 1_000_000

_OPEN: Final = sum(getattr(os, name, 0) for name in ("O_RDONLY", "O_NONBLOCK", "O_CLOEXEC", "O_BINARY"))
"""Flags with which a file is opened for reading; no system has all of them."""

STDOUT: Final = 1
"""File descriptor of standard output."""

_MOST_LINKS: Final = 40
"""Number of links that Linux follows one after the other."""

_ANY_MODE: Final = 0o666
"""Mode of a new file, unless the umask takes some of it."""

_NUMBER: Final = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?", re.ASCII)

TEXT_LIMIT: Final = 10 * MEGABYTE
"""Largest configuration file that is read, bytes."""


def open_regular(path: str | Path) -> BinaryIO:
    """Open a regular file for reading; a pipe is rejected without waiting for a writer.

    Raises
    ------
    OSError
        The file cannot be opened, or is a folder, device, pipe or socket.
    """
    try:
        descriptor = os.open(path, _OPEN)
    except ValueError as error:  # not a valid file name
        raise OSError(errno.EINVAL, str(error), str(path)) from None
    mode = os.fstat(descriptor).st_mode
    if stat.S_ISREG(mode):
        return os.fdopen(descriptor, "rb")
    os.close(descriptor)
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    raise OSError(errno.EINVAL, "not a regular file", str(path))


def read_bytes(path: str | Path, limit: int) -> bytes:
    """Return the content of a regular file.

    Parameters
    ----------
    path : path
        The file.
    limit : int
        Largest size that is read, bytes.

    Raises
    ------
    OSError
        See `open_regular`; also, the file is larger than `limit`.
    """
    with open_regular(path) as stream:
        size = os.fstat(stream.fileno()).st_size
        content: bytes | None = b"" if size > limit else stream.read(limit + 1)
    if content is None:  # a file of the kernel that has nothing yet
        raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN), str(path))
    if max(size, len(content)) > limit:
        raise OSError(errno.EFBIG, f"larger than {limit / MEGABYTE:g} MB", str(path))
    return content


def read_text(path: str | Path, limit: int = TEXT_LIMIT) -> str:
    """Return the content of a regular UTF-8 file, without its byte order mark if it has one.

    Raises
    ------
    OSError
        See `read_bytes`.
    UnicodeDecodeError
        The file is not UTF-8.
    """
    return read_bytes(path, limit).decode("utf-8-sig")


def read_number(text: str) -> float:
    """Parse a finite number in the notation common to most programs.

    Raises
    ------
    ValueError
        The text is not a finite number, or has underscores or non-ASCII digits, which Python would accept.
    """
    value = float(text) if _NUMBER.fullmatch(text.strip()) else math.inf
    if not math.isfinite(value):
        raise ValueError(f"{text.strip()!r} is not a number")
    return value


def is_stdout(path: str | Path) -> bool:
    """Whether a path is the file to which this process's standard output goes."""
    try:
        return os.path.samestat(Path(path).stat(), os.fstat(STDOUT))
    except (OSError, ValueError):
        return False


def is_stream(path: str | Path) -> bool:
    """Whether a path is a device, a pipe, a socket or standard output, which are written in place."""
    try:
        mode = Path(path).stat().st_mode
    except (OSError, ValueError):
        return False
    return not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)) or is_stdout(path)


def open_stream(path: str | Path) -> BinaryIO:
    """Open a stream (`is_stream`) for writing, after flushing what this process has printed.

    Raises
    ------
    OSError
        It cannot be opened.
    """
    if not is_stdout(path):
        return open(path, "wb", opener=open_output)
    if sys.stdout is not None:
        sys.stdout.flush()
    return os.fdopen(os.dup(STDOUT), "wb")


def check_links(path: str | Path) -> Path:
    """Check that a file to write is not a link of another user, as in /tmp: it could lead to any file of this one.

    Return the file to which own links and those of root lead, which may be missing.

    Raises
    ------
    PermissionError
        It is a link of another user.
    """
    for _ in range(_MOST_LINKS):
        path = Path(path)
        try:
            status = os.lstat(path)
        except (OSError, ValueError):  # there is none, or it cannot be written either
            return path
        if sys.platform == "win32" or not stat.S_ISLNK(status.st_mode) or _is_of_the_kernel(path):
            return path
        if status.st_uid not in (os.geteuid(), 0):
            raise PermissionError(errno.EPERM, f"a link that user {status.st_uid} has made", str(path))
        path = path.parent / path.readlink()
    return Path(path)


def _is_of_the_kernel(path: Path) -> bool:
    """Whether a path is in /proc, whose links to open files have no path as their target."""
    return path.is_relative_to("/proc")


def open_output(path: str | Path, flags: int) -> int:
    """Open a file for writing, with `flags` of `os.open`; a link that another user makes meanwhile is not followed.

    An `opener` for Python's `open`. The mode of a new file is what the umask leaves.

    Raises
    ------
    OSError
        The file cannot be opened, or is a link of another user.
    """
    target = check_links(path)
    follow = 0 if _is_of_the_kernel(target) else getattr(os, "O_NOFOLLOW", 0)
    return os.open(target, flags | follow, _ANY_MODE)


def write_atomically(path: Path, write: Callable[[Path], object], *, mode: int = _ANY_MODE) -> None:
    """Write a file by filling a temporary one and renaming it.

    Where `path` is a link, its target is replaced. A device, pipe or standard output gets the complete
    content.

    Parameters
    ----------
    path : Path
        Final name; missing folders are created.
    write : callable
        Called with the temporary path. If it raises, the temporary file is removed and `path` is untouched.
    mode : int
        Mode of a new file, of which the umask may take some; a file that is replaced keeps its own.

    Raises
    ------
    OSError
        The folder cannot be written, or `path` is a folder itself, or a link of another user.
    """
    check_links(path)
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
    with removing_new_folders_on_error(target.parent):
        target.parent.mkdir(parents=True, exist_ok=True)
        part = target.with_name(f".{target.name}.{secrets.token_hex(4)}.part")
        os.close(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode))
        try:
            write(part)
            with contextlib.suppress(FileNotFoundError):  # a new file
                part.chmod(stat.S_IMODE(target.stat().st_mode))
            part.replace(target)
        finally:
            part.unlink(missing_ok=True)


@contextlib.contextmanager
def removing_new_folders_on_error(folder: Path) -> Iterator[None]:
    """Remove a folder and its parents that are made inside, unless they have contents, if the body raises."""
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        yield
    except BaseException:
        with contextlib.suppress(OSError):  # not empty
            for path in filter(Path.is_dir, missing):
                path.rmdir()
        raise
