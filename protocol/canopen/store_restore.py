"""Store and restore parameters: objects 1010h and 1011h with their signatures (CiA 301)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
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

Ended: TypeAlias = Callable[[StorageError | None], None]
"""Called at the end of a write, with its error or None."""

Background: TypeAlias = Callable[[Callable[[], None], Ended], None]
"""Performs a write, and then calls a function with its error or None, at once or later; in the order of the writes."""


def write_at_once(work: Callable[[], None], ended: Ended) -> None:
    try:
        work()
    except StorageError as error:
        ended(error)
    else:
        ended(None)


@dataclass(eq=False)
class _Write:
    """A write of communication parameters that an SDO has caused."""

    ended: bool = False
    refusal: SdoAbortError | None = None
    answers: Deferred | None = None
    """What its end answers; None if something that follows it does."""


class StoreRestore:
    """Saves the parameters of the communication profile across a restart, and restores the defaults.

    Those of the application are its own: `on_save` saves them and raises `SdoAbortError` on failure; `on_restore` resets
    them to their defaults at its next restart. It performs its writes after those of `background` that precede it.

    `finish` answers an SDO whose write has ended later. Until it has ended, the group has its new values, and no other
    SDO or LSS command may write it.
    """

    def __init__(
        self,
        context: Context,
        storage: ParameterStorage,
        finish: Callable[[Deferred, SdoAbortError | None], None],
        on_save: ApplicationStore | None = None,
        on_restore: ApplicationStore | None = None,
        background: Background = write_at_once,
    ) -> None:
        self._context = context
        self._storage = storage
        self._finish = finish
        self._on_save = on_save
        self._on_restore = on_restore
        self._background = background
        self._writing: dict[str, Mapping[str, bytes]] = {}
        """Values of the groups that are being written."""
        self._followed: dict[Deferred, _Write] = {}
        """Writes that a deferred write of the application follows."""
        for index, action in ((STORE, self._store), (RESTORE, self._restore)):
            for subindex in (ALL, COMMUNICATION_ONLY, APPLICATION_ONLY):
                entry = context.dictionary.find(index, subindex)
                entry.reader = lambda: ON_COMMAND
                entry.writer = partial(action, subindex)

    def load(self) -> None:
        """Set the entries to their defaults, then to their stored values."""
        dictionary = self._context.dictionary
        dictionary.load_defaults(self._context.node_id)
        stored = self._stored(COMMUNICATION)
        for entry in dictionary if stored else ():
            value = stored.get(_name(entry))
            if value is not None and _is_stored(entry) and entry.size in {None, len(value)}:
                entry.value = value

    def load_lss(self) -> tuple[int, int] | None:
        """Return the node ID and the bit rate, bit/s, that LSS stored, or None."""
        values = self._stored(LSS)
        if "node_id" not in values or "bit_rate" not in values:
            return None
        return int.from_bytes(values["node_id"], "little"), int.from_bytes(values["bit_rate"], "little")

    def save_lss(self, node_id: int, bit_rate: int, ended: Ended) -> None:
        """Save node ID and bit rate, bit/s."""
        if LSS in self._writing:
            ended(StorageError("the last values are still being written"))
            return
        self._write(LSS, {"node_id": bytes([node_id]), "bit_rate": bit_rate.to_bytes(4, "little")}, ended)

    def clear_lss(self) -> None:
        """Delete what LSS stored, unless that is under way; an error is reported as an event."""
        if self._writing.get(LSS) != {}:
            self._write(LSS, {}, lambda _error: None)

    def refusal_of(self, deferred: Deferred) -> SdoAbortError | None:
        """Return why the write that preceded a deferred write of the application has failed; None if it has not."""
        write = self._followed.pop(deferred, None)
        return None if write is None else write.refusal

    def _write(self, group: str, values: Mapping[str, bytes], ended: Ended) -> None:
        """Write the values of a group, or delete a group without values."""

        def work() -> None:
            if values:
                self._storage.save(group, values)
            else:
                self._storage.clear(group)

        def written(error: StorageError | None) -> None:
            if self._writing.get(group) is values:
                del self._writing[group]
            if error is not None:
                self._context.report(EventKind.STORAGE_ERROR, detail=str(error))
            ended(error)

        self._writing[group] = values
        self._background(work, written)

    def _stored(self, group: str) -> Mapping[str, bytes]:
        if group in self._writing:
            return self._writing[group]
        try:
            return self._storage.load(group)
        except StorageError as error:
            self._context.report(EventKind.STORAGE_ERROR, detail=str(error))
            return {}

    def _store(self, subindex: int, data: bytes) -> Deferred | None:
        if data != SAVE:
            raise SdoAbortError(AbortCode.NOT_STORED, "the signature is 'save'")
        deferred = self._apply(subindex, self._changed, self._on_save)
        self._context.report(EventKind.STORED, subindex)
        return deferred

    def _restore(self, subindex: int, data: bytes) -> Deferred | None:
        if data != LOAD:
            raise SdoAbortError(AbortCode.NOT_STORED, "the signature is 'load'")
        deferred = self._apply(subindex, dict, self._on_restore)
        self._context.report(EventKind.RESTORED, subindex)
        return deferred

    def _apply(
        self, subindex: int, values: Callable[[], Mapping[str, bytes]], application: ApplicationStore | None
    ) -> Deferred | None:
        """Write the parameters of a sub-index, those of the application last; `values` are only collected if they are written."""
        follows = application if subindex in {ALL, APPLICATION_ONLY} else None
        if subindex == APPLICATION_ONLY:
            return None if follows is None else follows()
        if COMMUNICATION in self._writing:
            raise SdoAbortError(AbortCode.DEVICE_STATE, "the last values are still being written")
        write = _Write()

        def ended(error: StorageError | None) -> None:
            write.ended = True
            write.refusal = None if error is None else SdoAbortError(AbortCode.HARDWARE, str(error))
            if write.answers is not None:
                self._finish(write.answers, write.refusal)

        self._write(COMMUNICATION, values(), ended)
        if write.refusal is not None:
            raise write.refusal
        deferred = None if follows is None else follows()
        if not write.ended and deferred is not None:
            self._followed[deferred] = write
        elif not write.ended:
            deferred = write.answers = Deferred()
        return deferred

    def _changed(self) -> dict[str, bytes]:
        """Return the values that differ from their defaults, which may depend on the node ID."""
        return {
            _name(entry): entry.value
            for entry in self._context.dictionary
            if _is_stored(entry) and entry.value != default_bytes(entry.variable, self._context.node_id)
        }


def _name(entry: Entry) -> str:
    """Return the name under which the value of an entry is stored."""
    return f"{entry.key[0]:04X}:{entry.key[1]:02X}"


def _is_stored(entry: Entry) -> bool:
    """Return whether an entry keeps a value that can be changed and read; those that read the device do not."""
    return entry.reader is None and entry.variable.writable and entry.variable.readable
