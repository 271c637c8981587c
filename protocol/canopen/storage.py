"""Storage of a node's parameters: in memory, or in a file that is replaced atomically."""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from starhil.protocol.errors import ProtocolError
from starhil.protocol.files.durable_file import replace_durably
from starhil.protocol.files.user_file import read_user_file

COMMUNICATION: Final = "communication"
LSS: Final = "lss"


class StorageError(ProtocolError):
    """Stored parameters that cannot be read or written."""


Groups = dict[str, dict[str, bytes]]


class ParameterStorage:
    """Stores groups of named values; this one keeps them for the lifetime of the object."""

    def __init__(self) -> None:
        self._groups: Groups = {}

    def load(self, group: str) -> dict[str, bytes]:
        """Return a copy of a group's values, empty if none are stored. Raises `StorageError` if they are damaged."""
        return dict(self._read().get(group, {}))

    def save(self, group: str, values: Mapping[str, bytes]) -> None:
        """Replace all values of a group; damaged groups are replaced together.

        Raises `StorageError` if that fails; the old values then remain.
        """
        self._write((self._intact() or {}) | {group: dict(values)})

    def clear(self, group: str) -> None:
        """Delete a group's values."""
        groups = self._intact()
        if groups is None or group in groups:
            self._write({name: values for name, values in (groups or {}).items() if name != group})

    def _intact(self) -> Groups | None:
        """Return all groups, or None if they are damaged."""
        try:
            return self._read()
        except StorageError:
            return None

    def _read(self) -> Groups:
        return self._groups

    def _write(self, groups: Groups) -> None:
        self._groups = groups


class FileStorage(ParameterStorage):
    """Stores values in a JSON file with a checksum; a save writes a new file and renames it over the old one.

    The first save creates the folder of the file. Only one process at a time may use it; the emulator locks its state
    folder.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._path = path

    def _read(self) -> Groups:
        try:
            document = json.loads(read_user_file(self._path))
            groups = document["groups"]
            if not isinstance(groups, dict) or document["crc32"] != _checksum(groups):
                raise StorageError(f"{self._path}: wrong checksum; store the parameters again")
            return {
                group: {name: bytes.fromhex(value) for name, value in values.items()}
                for group, values in groups.items()
            }
        except FileNotFoundError:
            return {}
        except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise StorageError(f"{self._path}: no stored parameters ({error}); store them again") from None

    def _write(self, groups: Groups) -> None:
        texts = {
            group: {name: value.hex() for name, value in values.items()} for group, values in groups.items()
        }
        text = json.dumps({"crc32": _checksum(texts), "groups": texts}, indent=1)
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            replace_durably(self._path, text.encode("ascii"))
        except OSError as error:
            raise StorageError(f"{self._path}: cannot be written ({error})") from None


def _checksum(groups: Mapping[str, Mapping[str, str]]) -> int:
    return zlib.crc32(json.dumps(groups, sort_keys=True).encode("ascii"))
