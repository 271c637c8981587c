"""Replace a file so that an interruption or power cut leaves either the old or the new one."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path


def replace_durably(path: Path, data: bytes) -> None:
    """Write a new file beside the old one, flush it to disk, and rename it; the folder must exist.

    Only one process at a time may do so: the temporary file has a fixed name, so that interrupted calls leave
    at most one.

    Raises OSError: the file cannot be written; the old one remains.
    """
    temporary = path.with_name(f"{path.name}.new")
    try:
        temporary.unlink(missing_ok=True)  # of an interrupted call, or a link that others have put there
        with temporary.open("xb") as file:
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
