"""The state that survives a restart (parameters and boot count), written atomically.

The file is JSON with a checksum over its content. It is written under a temporary name, flushed to disk and renamed
over the old file, so that a reader finds either the old or the new state even if the writer is killed. A corrupt
file is renamed, and the device uses its defaults.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
from pathlib import Path
from typing import Any, Final, TypeAlias

from starhil.emulator.errors import EmulatorError, explained
from starhil.protocol.files.durable_file import replace_durably
from starhil.protocol.files.user_file import UnsuitableFileError, read_user_file

FORMAT: Final = 1
STATE_FILE: Final = "device.json"
CANOPEN_FILE: Final = "canopen.json"
"""Beside it, the parameters of a CANopen node, which `protocol.canopen.storage` writes."""
LOCK_FILE: Final = "lock"
MAX_BYTES: Final = 1_000_000
_LOCK: Final = os.O_CREAT | os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW
"""Flags of the lock's file, which is no link that others have put there."""


class MemoryStore:
    """State that survives a reset of the device, but not the end of the process."""

    def __init__(self) -> None:
        self.corrupt = False
        """Whether the stored state could not be read and was renamed."""
        self._text = "{}"

    def load(self) -> dict[str, Any]:
        """Return the last saved state."""
        content: dict[str, Any] = json.loads(self._text)
        return content

    def save(self, content: dict[str, Any]) -> None:
        self._text = json.dumps(content)

    def close(self) -> None:
        """Do nothing: no other process uses the store."""


class FileStore:
    """State in a folder, which only one process at a time can use."""

    def __init__(self, folder: Path) -> None:
        self.corrupt = False
        self.path = folder / STATE_FILE
        with explained(f"state folder {folder}: cannot be used", "choose another with --state-dir"):
            folder.mkdir(parents=True, exist_ok=True)
            self._lock = os.open(folder / LOCK_FILE, _LOCK, 0o644)
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(self._lock)
            taken = isinstance(error, BlockingIOError)
            why = "in use by another emulator" if taken else f"cannot be used ({error.strerror})"
            raise EmulatorError(f"state folder {folder}: {why}; choose another with --state-dir") from None

    def load(self) -> dict[str, Any]:
        """Return the last saved state; a corrupt file is renamed `device.json.corrupt`, or with a number if there is one."""
        remedy = "make it readable, or choose another folder with --state-dir"
        with explained(f"state file {self.path}: cannot be read", remedy):
            try:
                content = _decode(read_user_file(self.path, MAX_BYTES))
            except FileNotFoundError:
                return {}
            except UnsuitableFileError:
                content = None
        if content is None:
            self.corrupt = True
            with explained(f"state file {self.path}: is corrupt, and cannot be renamed", "remove it"):
                aside, number = self.path.with_name(STATE_FILE + ".corrupt"), 1
                while os.path.lexists(aside):
                    number += 1
                    aside = self.path.with_name(f"{STATE_FILE}.corrupt-{number}")
                self.path.replace(aside)
            return {}
        return content

    def save(self, content: dict[str, Any]) -> None:
        """Save the whole content, or none of it."""
        with explained(f"state file {self.path}: cannot be written", "the previous state is kept"):
            replace_durably(self.path, _encode(content))

    def close(self) -> None:
        os.close(self._lock)


StateStore: TypeAlias = MemoryStore | FileStore


def _encode(content: dict[str, Any]) -> bytes:
    body = json.dumps(content, sort_keys=True, allow_nan=False)
    digest = hashlib.sha256(body.encode()).hexdigest()
    return json.dumps(
        {"format": FORMAT, "sha256": digest, "state": content}, sort_keys=True, indent=1
    ).encode()


def _decode(data: bytes) -> dict[str, Any] | None:
    """Return the content of a state file, or None if it is corrupt."""
    try:
        document = json.loads(data)
        content = document["state"]
        body = json.dumps(content, sort_keys=True, allow_nan=False)
        intact = (
            document["format"] == FORMAT and document["sha256"] == hashlib.sha256(body.encode()).hexdigest()
        )
    except (ValueError, KeyError, TypeError, RecursionError):
        return None
    return content if intact and isinstance(content, dict) else None
