"""Reading of files named by a user: regular files only, up to a size limit; and of TOML, which may come from one."""

from __future__ import annotations

import errno
import os
import re
import stat
import tomllib
from pathlib import Path
from typing import Any, BinaryIO, Final

MAX_BYTES: Final = 10_000_000
"""Default size limit, bytes."""

MAX_DEPTH: Final = 64
"""Maximum depth of tables and lists in TOML."""

TOO_WIDE: Final = "a whole number does not fit 64 bits"

_TOO_LONG: Final = re.compile(r"[0-9][0-9_]{4300}")
"""A decimal number with more digits than Python converts."""


_PART: Final = r"""(?:[\w-]+|"(?:[^"\\\n]|\\.)*"|'[^'\n]*')"""
_DEEP_KEY: Final = re.compile(
    rf"(?:^|[\[{{,])[ \t]*{_PART}(?:[ \t]*\.[ \t]*{_PART}){{{MAX_DEPTH}}}", re.MULTILINE
)
"""A key of more parts than tables may be deep, for which Python's reader takes time that grows with the square of their number."""


class TomlError(ValueError):
    """Text is not TOML, or has a value that nothing can use; the text is the reason."""


class UnsuitableFileError(OSError):
    """A path that is not a regular file, or is too large; `strerror` gives the reason."""


def open_user_file(path: Path) -> BinaryIO:
    """Open a regular file for reading; a pipe, a device or a socket is rejected without waiting for it.

    `starid`, which is installed without this package, has the same in `starid.storage.files`.

    Raises
    ------
    OSError
        The file cannot be opened, or is not a regular file; `strerror` gives the reason.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
    except ValueError as error:  # not a valid file name
        raise UnsuitableFileError(errno.EINVAL, str(error), str(path)) from None
    mode = os.fstat(descriptor).st_mode
    if stat.S_ISREG(mode):
        return os.fdopen(descriptor, "rb")
    os.close(descriptor)
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    raise UnsuitableFileError(errno.EINVAL, "not a regular file", str(path))


def read_user_file(path: Path, limit: int = MAX_BYTES) -> bytes:
    """Return the content of a regular file.

    Raises as `open_user_file`, and OSError if the file holds more than `limit` bytes.
    """
    with open_user_file(path) as stream:
        content: bytes | None = stream.read(limit + 1)
    if content is None:  # a file of the kernel that has nothing yet
        raise UnsuitableFileError(errno.EAGAIN, os.strerror(errno.EAGAIN), str(path))
    if len(content) > limit:
        raise UnsuitableFileError(errno.EFBIG, f"larger than {limit / 1e6:g} MB", str(path))
    return content


def read_user_text(path: Path, limit: int = MAX_BYTES) -> str:
    """Return the text of a regular UTF-8 file, without a byte order mark.

    Raises as `read_user_file`, and UnicodeDecodeError.
    """
    return read_user_file(path, limit).decode("utf-8-sig")


def read_user_toml(path: Path) -> dict[str, Any]:
    """Return the document of a TOML file.

    Raises as `read_user_file`, and TomlError.
    """
    try:
        text = read_user_text(path)
    except UnicodeDecodeError as error:
        raise TomlError(f"not UTF-8: {error.reason} (at byte {error.start})") from None
    return parse_toml(text)


def parse_toml(text: str) -> dict[str, Any]:
    """Return the document that a TOML text describes.

    Raises TomlError also for what Python would accept, but no path, message or field can hold: a whole number of more
    than 64 bits, the character NUL, and tables deeper than `MAX_DEPTH`.
    """
    if deep := _DEEP_KEY.search(text):
        raise TomlError(f"nested too deeply{_line_of(text, deep)}")
    try:
        document = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise TomlError(str(error)) from None
    except RecursionError:
        raise TomlError("nested too deeply") from None
    except ValueError:
        found = _TOO_LONG.search(text)
        raise TomlError(TOO_WIDE + ("" if found is None else _line_of(text, found))) from None
    if wrong := _unusable(document, MAX_DEPTH):
        raise TomlError(wrong.removeprefix("."))
    return document


def _line_of(text: str, found: re.Match[str]) -> str:
    return f" (at line {text.count(chr(10), 0, found.end()) + 1})"


def _unusable(value: object, depth: int) -> str:
    """Return the first value that cannot be used as `.key.key: reason`; empty if there is none."""
    if isinstance(value, (dict, list)):
        if not depth:
            return ": nested too deeply"
        for name, below in value.items() if isinstance(value, dict) else (("", each) for each in value):
            if wrong := _unusable(below, depth - 1):
                return f".{name}{wrong}" if name else wrong
    elif isinstance(value, int) and not -(1 << 63) <= value < 1 << 64:
        return f": {TOO_WIDE}"
    elif isinstance(value, str) and "\0" in value:
        return ": has the character NUL"
    return ""
