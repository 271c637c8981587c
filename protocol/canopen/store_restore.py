"""Store and restore parameters: objects 1010h and 1011h with their signatures (CiA 301)."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Final, TypeAlias

from starhil.protocol.canopen.abort import AbortCode, SdoAbortError
from starhil.protocol.canopen.context import Context, EventKind
from starhil.protocol.canopen.dictionary import Deferred, Entry, default_bytes
from starhil.protocol.canopen.storage import COMMUNICATION, LSS, ParameterStorage, StorageError

STORE: Final = 0x1010
RESTORE: Final = 0x1011
ALL, COMMUNICATION_ONLY, APPLICATION_ONLY = 1, 2, 3
"""Sub-indices of both objects."""
SAVE: Final = b"save"
LOAD: Final = b"load"
ON_COMMAND: Final = b"\x01\0\0\0"
"""Value read from 1010h and 1011h: the node stores on command, not autonomously."""


ApplicationStore: TypeAlias = Callable[[], Deferred | None]
"""Stores the parameters of the application; a `Deferred` is answered when this is done."""


class StoreRestore:
    """Saves the parameters of the communication profile across a restart, and restores the defaults.

    Those of the application are its own: `on_save` saves them and raises `SdoAbortError` on failure; `on_restore` resets
    them to their defaults at its next restart.
    """

    def __init__(
        self,
        context: Context,
        storage: ParameterStorage,
        on_save: ApplicationStore | None = None,
        on_restore: ApplicationStore | None = None,
    ) -> None:
        self._context = context
        self._storage = storage
        self._on_save = on_save
        self._on_restore = on_restore
        for index, action in ((STORE, self._store), (RESTORE, self._restore)):
            for subindex in (ALL, COMMUNICATION_ONLY, APPLICATION_ONLY):
                entry = context.dictionary.find(index, subindex)
                entry.reader = lambda: ON_COMMAND
                entry.writer = partial(action, subindex)

    def load(self) -> None:
        """Set the entries to their defaults, then to their stored values."""
        dictionary = self._context.dictionary
        dictionary.load_defaults(self._context.node_id)
        for name, value in self._stored(COMMUNICATION).items():
            index, _, subindex = name.partition(":")
            entry = dictionary.entries.get((int(index, 16), int(subindex, 16)))
            if entry is not None and _is_stored(entry) and entry.size in {None, len(value)}:
                entry.value = value

    def load_lss(self) -> tuple[int, int] | None:
        """Return the node ID and the bit rate, bit/s, that LSS stored, or None."""
        values = self._stored(LSS)
        if "node_id" not in values or "bit_rate" not in values:
            return None
        return int.from_bytes(values["node_id"], "little"), int.from_bytes(values["bit_rate"], "little")

    def save_lss(self, node_id: int, bit_rate: int) -> None:
        """Save node ID and bit rate, bit/s. Raises `StorageError` if that fails."""
        self._storage.save(LSS, {"node_id": bytes([node_id]), "bit_rate": bit_rate.to_bytes(4, "little")})

    def clear_lss(self) -> None:
        """Delete what LSS stored. Raises `StorageError` if that fails."""
        self._storage.clear(LSS)

    def _stored(self, group: str) -> dict[str, bytes]:
        try:
            return self._storage.load(group)
        except StorageError as error:
            self._context.report(EventKind.STORAGE_ERROR, detail=str(error))
            return {}

    def _store(self, subindex: int, data: bytes) -> Deferred | None:
        if data != SAVE:
            raise SdoAbortError(AbortCode.NOT_STORED, "the signature is 'save'")
        deferred = self._apply(subindex, self._save, self._on_save)
        self._context.report(EventKind.STORED, subindex)
        return deferred

    def _restore(self, subindex: int, data: bytes) -> Deferred | None:
        if data != LOAD:
            raise SdoAbortError(AbortCode.NOT_STORED, "the signature is 'load'")
        deferred = self._apply(subindex, partial(self._storage.clear, COMMUNICATION), self._on_restore)
        self._context.report(EventKind.RESTORED, subindex)
        return deferred

    def _apply(
        self, subindex: int, action: Callable[[], None], application: ApplicationStore | None
    ) -> Deferred | None:
        """Save or clear the parameters of a sub-index, those of the application last."""
        if subindex in {ALL, COMMUNICATION_ONLY}:
            try:
                action()
            except StorageError as error:
                self._context.report(EventKind.STORAGE_ERROR, detail=str(error))
                raise SdoAbortError(AbortCode.HARDWARE, str(error)) from None
        if subindex in {ALL, APPLICATION_ONLY} and application is not None:
            return application()
        return None

    def _save(self) -> None:
        """Save the values that differ from their defaults, which may depend on the node ID."""
        values = {
            f"{entry.key[0]:04X}:{entry.key[1]:02X}": entry.value
            for entry in self._context.dictionary
            if _is_stored(entry) and entry.value != default_bytes(entry.variable, self._context.node_id)
        }
        self._storage.save(COMMUNICATION, values)


def _is_stored(entry: Entry) -> bool:
    """Return whether an entry keeps a value that can be changed and read; those that read the device do not."""
    return entry.reader is None and entry.variable.writable and entry.variable.readable
