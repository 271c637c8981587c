"""Store and restore parameters: objects 1010h and 1011h with their signatures (CiA 301)."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Final, TypeAlias

from starhil.protocol.canopen.abort import AbortCode, SdoAbortError
from starhil.protocol.canopen.context import Context, EventKind
from starhil.protocol.canopen.dictionary import COMMUNICATION as COMMUNICATION_INDICES
from starhil.protocol.canopen.dictionary import Deferred, Entry, default_bytes
from starhil.protocol.canopen.storage import APPLICATION, COMMUNICATION, LSS, ParameterStorage, StorageError

STORE: Final = 0x1010
RESTORE: Final = 0x1011
ALL: Final = 1
GROUPS: Final = {2: COMMUNICATION, 3: APPLICATION}
SAVE: Final = b"save"
LOAD: Final = b"load"
ON_COMMAND: Final = b"\x01\0\0\0"
"""Value read from 1010h and 1011h: the node stores on command, not autonomously."""


ApplicationStore: TypeAlias = Callable[[], Deferred | None]
"""Stores the parameters of the application; a `Deferred` is answered when this is done."""


class ParameterStore:
    """Saves parameters across a restart, and restores the defaults.

    `on_save` saves the parameters of the application and raises `SdoAbortError` on failure; `on_restore` resets them to
    their defaults at its next restart.
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
            for subindex in (ALL, *GROUPS):
                entry = context.dictionary.find(index, subindex)
                entry.reader = lambda: ON_COMMAND
                entry.writer = partial(action, subindex)
                entry.persistent = False

    def load(self, group: str) -> None:
        """Set the group's entries to their defaults, then to their stored values."""
        self.set_defaults(group)
        for name, value in self._stored(group).items():
            entry = self._named(name)
            if entry is not None and self._belongs(entry, group) and entry.size in {None, len(value)}:
                entry.value = value

    def set_defaults(self, group: str) -> None:
        """Set the group's entries to their defaults; leave the stored values unchanged."""
        above = range(COMMUNICATION_INDICES.stop, 0x10000)
        indices = COMMUNICATION_INDICES if group == COMMUNICATION else above
        self._context.dictionary.load_defaults(indices, self._context.node_id)

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

    def _named(self, name: str) -> Entry | None:
        index, _, subindex = name.partition(":")
        return self._context.dictionary.entries.get((int(index, 16), int(subindex, 16)))

    def _belongs(self, entry: Entry, group: str) -> bool:
        if not entry.persistent or entry.reader is not None:
            return False
        return (entry.key[0] in COMMUNICATION_INDICES) == (group == COMMUNICATION)

    def _store(self, subindex: int, data: bytes) -> Deferred | None:
        if data != SAVE:
            raise SdoAbortError(AbortCode.NOT_STORED, "the signature is 'save'")
        deferred = self._for_groups(subindex, self._save, self._on_save)
        self._context.report(EventKind.STORED, subindex)
        return deferred

    def _restore(self, subindex: int, data: bytes) -> Deferred | None:
        if data != LOAD:
            raise SdoAbortError(AbortCode.NOT_STORED, "the signature is 'load'")
        deferred = self._for_groups(subindex, self._storage.clear, self._on_restore)
        self._context.report(EventKind.RESTORED, subindex)
        return deferred

    def _for_groups(
        self, subindex: int, action: Callable[[str], None], application: ApplicationStore | None
    ) -> Deferred | None:
        """Save or clear the groups of a sub-index, then those of the application."""
        deferred = None
        for number, group in GROUPS.items():
            if subindex in {ALL, number}:
                try:
                    action(group)
                except StorageError as error:
                    self._context.report(EventKind.STORAGE_ERROR, detail=str(error))
                    raise SdoAbortError(AbortCode.HARDWARE, str(error)) from None
                if group == APPLICATION and application is not None:
                    deferred = application()
        return deferred

    def _save(self, group: str) -> None:
        """Save the values of a group that differ from their defaults, which may depend on the node ID."""
        values = {
            f"{entry.key[0]:04X}:{entry.key[1]:02X}": entry.value
            for entry in self._context.dictionary
            if self._belongs(entry, group)
            and entry.value != default_bytes(entry.variable, self._context.node_id)
        }
        self._storage.save(group, values)
