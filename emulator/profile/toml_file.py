"""Reading of TOML files."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

from starhil.emulator.errors import EmulatorError, explained
from starhil.protocol.files.bundled import Kind, find, not_found
from starhil.protocol.files.user_file import TomlError, read_user_toml


def find_toml(kind: Kind, name_or_path: str, relative_to: Path = Path()) -> Path:
    """Return the path of a file given by the name of a bundled one, or by a path."""
    failed = f"{kind} {name_or_path!r}: cannot be read"  # RuntimeError: the home folder of an unknown user
    with explained(failed, "give another path", errors=(OSError, RuntimeError)):
        path = relative_to / find(kind, name_or_path)
        with suppress(FileNotFoundError, NotADirectoryError, ValueError):  # a null byte is in no path
            path.stat()  # Path.exists is silent about other errors from Python 3.14 on
            if name_or_path:  # an empty name is the working folder as a path
                return path
    raise EmulatorError(not_found(kind, name_or_path))


def read_toml(path: Path, what: str) -> dict[str, Any]:
    """Read a TOML file; `what` is its kind, for messages: `profile`, `scenario`."""
    try:
        with explained(f"{what} {path}: cannot be read", "give a TOML file"):
            return read_user_toml(path)
    except TomlError as error:
        raise EmulatorError(f"{what} {path}: not valid TOML: {error}") from None
