"""Replace a file so that it is the old one or the new one, whenever the process or the machine stops."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path


def replace_durably(path: Path, data: bytes) -> None:
    """Write a new file beside an old one, flush it to the disk, and rename it over the old one; the folder must exist.

    One process at a time may do so: the temporary file has a fixed name, so that an interrupted call leaves
    at most one.

    Raises
    ------
    OSError
        It cannot be written; the old file remains.
    """
    temporary = path.with_name(f"{path.name}.new")
    try:
        with temporary.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
        folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
    except OSError:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise
