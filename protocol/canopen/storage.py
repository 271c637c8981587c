"""Storage of a node's parameters: in memory, or in a file that is replaced atomically."""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Final, Protocol

from starhil.protocol.durable_file import replace_durably
from starhil.protocol.errors import ProtocolError
from starhil.protocol.user_file import read_user_file

COMMUNICATION: Final = "communication"
APPLICATION: Final = "application"
LSS: Final = "lss"


class StorageError(ProtocolError):
    """Stored parameters that cannot be read or written."""


class ParameterStorage(Protocol):
    """Stores groups of named values across a restart."""

    def load(self, group: str) -> dict[str, bytes]:
        """Return a group's values, empty if none are stored.

        Raises `StorageError` if they are damaged.
        """

    def save(self, group: str, values: Mapping[str, bytes]) -> None:
        """Replace all values of a group.

        Raises `StorageError` if that fails; the old values then remain.
        """

    def clear(self, group: str) -> None:
        """Delete a group's values."""


class MemoryStorage:
    """Stores values for the lifetime of the object."""

    def __init__(self) -> None:
        self._groups: dict[str, dict[str, bytes]] = {}

    def load(self, group: str) -> dict[str, bytes]:
        """Return a copy of a group's values."""
        return dict(self._groups.get(group, {}))

    def save(self, group: str, values: Mapping[str, bytes]) -> None:
        """Replace a group's values."""
        self._groups[group] = dict(values)

    def clear(self, group: str) -> None:
        """Delete a group's values."""
        self._groups.pop(group, None)


class FileStorage:
    """Stores values in a JSON file with a checksum; a save writes a new file and renames it over the old one.

    Parameters
    ----------
    path
        The file; the first save creates its folder. Only one process at a time may use it; the emulator locks
        its state folder.
    """

    def __init__(self, path: Path) -> None:
        self._path = path

    def load(self, group: str) -> dict[str, bytes]:
        """Return a group's values.

        Raises `StorageError` if the file cannot be read or its checksum is wrong.
        """
        values = self._read().get(group, {})
        return {name: bytes.fromhex(value) for name, value in values.items()}

    def save(self, group: str, values: Mapping[str, bytes]) -> None:
        """Replace a group's values; a damaged file is replaced as a whole."""
        groups = self._readable()
        groups[group] = {name: value.hex() for name, value in values.items()}
        self._write(groups)

    def clear(self, group: str) -> None:
        """Delete a group's values."""
        groups = self._readable()
        if groups.pop(group, None) is not None or not self._intact():
            self._write(groups)

    def _intact(self) -> bool:
        try:
            self._read()
        except StorageError:
            return False
        return True

    def _readable(self) -> dict[str, dict[str, str]]:
        try:
            return self._read()
        except StorageError:
            return {}

    def _read(self) -> dict[str, dict[str, str]]:
        try:
            document = json.loads(read_user_file(self._path))
            groups: dict[str, dict[str, str]] = document["groups"]
            if not isinstance(groups, dict) or document["crc32"] != _checksum(groups):
                raise StorageError(f"{self._path}: wrong checksum; store the parameters again")
        except FileNotFoundError:
            return {}
        except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
            raise StorageError(f"{self._path}: no stored parameters ({error}); store them again") from None
        return groups

    def _write(self, groups: Mapping[str, Mapping[str, str]]) -> None:
        text = json.dumps({"crc32": _checksum(groups), "groups": groups}, indent=1)
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            replace_durably(self._path, text.encode("ascii"))
        except OSError as error:
            raise StorageError(f"{self._path}: cannot be written ({error})") from None


def _checksum(groups: Mapping[str, Mapping[str, str]]) -> int:
    return zlib.crc32(json.dumps(groups, sort_keys=True).encode("ascii"))
