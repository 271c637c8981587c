"""The object dictionary of a running node: values, access checks and handlers.

`canopen.ObjectDictionary` describes the objects. A `Dictionary` adds an `Entry` to each variable, with the
current value as bytes on the wire and the functions that read and write it in the device.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Final

from canopen.objectdictionary import ObjectDictionary, ODVariable

from starhil.protocol.canopen.abort import AbortCode, SdoAbortError

Value = int | float | bool | str | bytes

MAXIMUM_STRING: Final = 256
"""Longest string or octet string that may be written, in bytes, unless the entry has its own limit."""


class Deferred:
    """A write that the device has accepted and whose result follows by `finish_write`."""


Writer = Callable[[bytes], Deferred | None]
"""Writes a value that has passed all checks; raises `SdoAbortError`, or returns a token if the result follows
later."""


@dataclass(slots=True)
class Entry:
    """One variable of a node's object dictionary with its current value."""

    variable: ODVariable
    value: bytes = b""
    """Current value as on the wire; unused if there is a `reader`."""
    reader: Callable[[], bytes] | None = None
    """Returns the current value from the device."""
    writer: Writer | None = None
    """Called before `value` changes."""
    maximum_size: int = MAXIMUM_STRING
    """Longest value, bytes, of a type without a fixed size."""

    @property
    def key(self) -> tuple[int, int]:
        return self.variable.index, self.variable.subindex

    @property
    def size(self) -> int | None:
        """Size on the wire in bytes, or None for strings and domains."""
        return type_size(self.variable.data_type)

    def read(self) -> bytes:
        """Return the current value as on the wire, without an access check."""
        return self.value if self.reader is None else self.reader()

    def number(self) -> int:
        """Return the value of an unsigned entry without a reader."""
        return int.from_bytes(self.value, "little")


def type_size(data_type: int | None) -> int | None:
    """Return the size of a CANopen data type in bytes, or None if it varies (strings, DOMAIN)."""
    packer = ODVariable.STRUCT_TYPES.get(data_type if data_type is not None else -1)
    return None if packer is None else packer.size


def encode(variable: ODVariable, value: Value) -> bytes:
    """Pack a raw (unscaled) value; `bytes` pass unchanged.

    Raises SdoAbortError: VALUE_RANGE if the value does not fit the type.
    """
    if isinstance(value, str):
        return value.encode("ascii", errors="replace")
    try:
        return bytes(variable.encode_raw(value))
    except (ValueError, OverflowError, TypeError) as error:
        raise SdoAbortError(
            AbortCode.VALUE_RANGE, f"{value!r} does not fit {variable.qualname}: {error}"
        ) from None


class Dictionary:
    """Object dictionary of one node, with an entry for each variable; `load_defaults` sets their default values.

    `connected` are the entries that read or write the device.
    """

    def __init__(self, od: ObjectDictionary, connected: Iterable[Entry] = ()) -> None:
        self.od = od
        self.entries = {entry.key: entry for entry in connected}
        for item in od.values():
            members = [item] if isinstance(item, ODVariable) else item.subindices.values()
            for variable in members:
                self.entries.setdefault((variable.index, variable.subindex), Entry(variable))
        self.changed: set[tuple[int, int]] = set()
        """Keys written since the node last cleared them."""
        self.instant = 0
        """Number of the sampling instant, within which a reader may return the same sample again."""

    def __iter__(self) -> Iterator[Entry]:
        return iter(self.entries.values())

    def find(self, index: int, subindex: int) -> Entry:
        """Return an entry. Raises `SdoAbortError` NO_OBJECT or NO_SUBINDEX."""
        entry = self.entries.get((index, subindex))
        if entry is not None:
            return entry
        if index in self.od.indices:
            raise SdoAbortError(AbortCode.NO_SUBINDEX, f"{index:04X}h:{subindex:02X}h")
        raise SdoAbortError(AbortCode.NO_OBJECT, f"{index:04X}h")

    def load_defaults(self, node_id: int) -> None:
        """Set the entries that keep a value to their defaults; relative defaults include the node ID."""
        for entry in self:
            if entry.reader is None:
                entry.value = default_bytes(entry.variable, node_id)

    def new_instant(self) -> None:
        """Begin a new sampling instant: readers sample the device again."""
        self.instant += 1

    def read(self, index: int, subindex: int) -> bytes:
        """Read as an SDO client.

        Raises `SdoAbortError` if there is no such entry or it is write-only.
        """
        entry = self.find(index, subindex)
        if not entry.variable.readable:
            raise SdoAbortError(AbortCode.WRITE_ONLY, f"{index:04X}h:{subindex:02X}h")
        return entry.read()

    def writable(self, index: int, subindex: int) -> Entry:
        """Return an entry that an SDO client may write; raise `SdoAbortError` otherwise."""
        entry = self.find(index, subindex)
        if not entry.variable.writable:
            raise SdoAbortError(AbortCode.READ_ONLY, f"{index:04X}h:{subindex:02X}h")
        return entry

    def write(self, index: int, subindex: int, data: bytes) -> Deferred | None:
        """Write as an SDO client: check access, length and range, then call the handler.

        Returns a token if the result follows later.
        """
        entry = self.writable(index, subindex)
        check_length(entry, len(data))
        check_value(entry.variable, data)
        deferred = None if entry.writer is None else entry.writer(data)
        entry.value = data
        self.changed.add(entry.key)
        self.new_instant()
        return deferred


def default_bytes(variable: ODVariable, node_id: int) -> bytes:
    """Return the default of a variable as bytes; zero or empty if it has none."""
    default = variable.default
    if default is None:
        return bytes(type_size(variable.data_type) or 0)
    if variable.relative:
        default += node_id
    return encode(variable, default)


def check_length(entry: Entry, length: int) -> None:
    """Reject a length in bytes that is invalid for the entry."""
    lowest, highest = (0, entry.maximum_size) if entry.size is None else (entry.size, entry.size)
    if length > highest:
        raise SdoAbortError(
            AbortCode.LENGTH_HIGH, f"{length} bytes for {entry.variable.qualname}, at most {highest}"
        )
    if length < lowest:
        raise SdoAbortError(
            AbortCode.LENGTH_LOW, f"{length} bytes for {entry.variable.qualname}, {lowest} needed"
        )


def check_value(variable: ODVariable, data: bytes) -> None:
    """Reject NaN, and a number outside the variable's limits or named values."""
    if type_size(variable.data_type) is None:
        return
    value = variable.decode_raw(data)
    if not isinstance(value, int | float):
        return
    if math.isnan(value):
        raise SdoAbortError(AbortCode.VALUE_RANGE, f"{variable.qualname} takes no NaN")
    if variable.max is not None and value > variable.max:
        raise SdoAbortError(AbortCode.VALUE_HIGH, f"{value} for {variable.qualname}, at most {variable.max}")
    if variable.min is not None and value < variable.min:
        raise SdoAbortError(AbortCode.VALUE_LOW, f"{value} for {variable.qualname}, at least {variable.min}")
    if variable.value_descriptions and value not in variable.value_descriptions:
        raise SdoAbortError(AbortCode.VALUE_RANGE, f"{value} is not a named value of {variable.qualname}")
