"""The communication and mapping record of a PDO, and the rules for changing them (CiA 301)."""

from __future__ import annotations

from collections.abc import Container, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import ClassVar, Final

import construct

from starhil.protocol.canopen.abort import AbortCode, SdoAbortError
from starhil.protocol.canopen.cob import BIT_30, ID_MASK, check_change, exists
from starhil.protocol.canopen.context import Context
from starhil.protocol.canopen.dictionary import Dictionary, Entry, type_size

LARGEST_MAPPING: Final = 8
"""Maximum number of objects in a PDO; the granularity is 8 bits."""
LARGEST_PDO: Final = 8
"""Maximum number of bytes in a PDO."""
FIRST_DUMMY: Final = 0x0002
LAST_DUMMY: Final = 0x0007
"""Data types whose index may be mapped in an RPDO as a placeholder (INTEGER8 to UNSIGNED32)."""
LAST_CYCLIC: Final = 240
"""Transmission types up to this one are synchronous."""
EVENT_DRIVEN: Final = frozenset({254, 255})


MAPPING_ENTRY: Final = construct.Struct(
    "index" / construct.Int16ub, "subindex" / construct.Int8ub, "bits" / construct.Int8ub
)
"""The 32-bit value of a mapping entry, most significant byte first."""


class Direction(IntEnum):
    """RPDO or TPDO, as the index of its first communication record."""

    RECEIVE = 0x1400
    TRANSMIT = 0x1800

    def mapping(self, number: int) -> int:
        """Return the index of the mapping record of a PDO, 0 for the first."""
        return self + 0x200 + number

    def numbers(self, indices: Container[int]) -> list[int]:
        """Return the PDOs of this direction that a dictionary with these indices has; the first is 0."""
        return [number for number in range(0x200) if self + number in indices]


@dataclass(frozen=True)
class MappedObject:
    """One object of a PDO; a placeholder has no entry."""

    entry: Entry | None
    size: int


def resolve(dictionary: Dictionary, value: int, direction: Direction) -> MappedObject:
    """Return the object of a mapping entry, as in `MAPPING_ENTRY`.

    Raises SdoAbortError: NO_OBJECT for an object that does not exist, NOT_MAPPABLE for one that cannot be mapped in
    this direction or in this length.
    """
    entry_bits = MAPPING_ENTRY.parse(value.to_bytes(4, "big"))
    index, subindex, bits = entry_bits.index, entry_bits.subindex, entry_bits.bits
    if direction is Direction.RECEIVE and FIRST_DUMMY <= index <= LAST_DUMMY and subindex == 0:
        size = type_size(index)
        if size is None or bits != size * 8:
            raise SdoAbortError(
                AbortCode.NOT_MAPPABLE, f"placeholder 0x{index:04X} does not have {bits} bits"
            )
        return MappedObject(None, size)
    try:
        entry = dictionary.find(index, subindex)
    except SdoAbortError:
        raise SdoAbortError(AbortCode.NO_OBJECT, f"{index:04X}h:{subindex:02X}h") from None
    variable = entry.variable
    access = variable.access_type
    usable = variable.readable and access != "rww" if direction is Direction.TRANSMIT else variable.writable
    if not variable.pdo_mappable or not usable or (direction is Direction.RECEIVE and access == "rwr"):
        raise SdoAbortError(AbortCode.NOT_MAPPABLE, f"{index:04X}h:{subindex:02X}h")
    if entry.size is None or bits != entry.size * 8:
        raise SdoAbortError(AbortCode.NOT_MAPPABLE, f"{index:04X}h:{subindex:02X}h does not have {bits} bits")
    return MappedObject(entry, entry.size)


def resolve_all(dictionary: Dictionary, values: Sequence[int], direction: Direction) -> list[MappedObject]:
    """Return the objects of a mapping. Raises SdoAbortError as `resolve`, and PDO_LENGTH if a PDO cannot hold them."""
    objects = [resolve(dictionary, value, direction) for value in values]
    size = sum(mapped.size for mapped in objects)
    if size > LARGEST_PDO:
        raise SdoAbortError(AbortCode.PDO_LENGTH, f"{size} bytes, at most {LARGEST_PDO}")
    return objects


class Pdo:
    """A PDO, 0 for the first: its communication and mapping record, and the rules for changing them."""

    direction: ClassVar[Direction]

    def __init__(self, context: Context, number: int) -> None:
        self._context = context
        self.number = number
        self.indices = communication, mapping = self.direction + number, self.direction.mapping(number)
        self._objects: list[MappedObject] = []
        find = context.dictionary.find
        self._cob_id, self._type, self._event_timer = (find(communication, item) for item in (1, 2, 5))
        self._count, *self._slots = (find(mapping, item) for item in range(LARGEST_MAPPING + 1))
        self._cob_id.writer = self._check_cob_id
        self._type.writer = self._check_type
        self._count.writer = self._check_count
        for slot in self._slots:
            slot.writer = self._check_slot

    def configure(self) -> None:
        """Apply the current records; no objects are mapped while the mapping is disabled."""
        self._objects = self._mapped(self._count.number())

    @property
    def exists(self) -> bool:
        """Whether the PDO is enabled and maps objects."""
        return self._valid and bool(self._objects)

    @property
    def can_id(self) -> int:
        return self._cob_id.number() & ID_MASK

    @property
    def _valid(self) -> bool:
        return exists(self._cob_id.number())

    @property
    def _synchronous(self) -> bool:
        return self._type.number() <= LAST_CYCLIC

    @property
    def _event_s(self) -> float:
        """TPDO: longest time between two transmissions. RPDO: deadline of the next message; s, 0 for none."""
        return self._event_timer.number() * 1e-3

    def _check_cob_id(self, data: bytes) -> None:
        new = int.from_bytes(data, "little")
        if self.direction is Direction.TRANSMIT and not new & BIT_30:
            raise SdoAbortError(
                AbortCode.VALUE_RANGE, "remote requests are not supported: bit 30 must be set"
            )
        check_change(self._cob_id.number(), new, enabled=exists)

    def _check_type(self, data: bytes) -> None:
        if data[0] > LAST_CYCLIC and data[0] not in EVENT_DRIVEN:
            raise SdoAbortError(AbortCode.VALUE_RANGE, f"transmission type {data[0]} is not supported")

    def _check_slot(self, data: bytes) -> None:
        self._require_disabled()
        if self._count.number():
            raise SdoAbortError(
                AbortCode.UNSUPPORTED_ACCESS, "set sub-index 0 to 0 before changing the mapping"
            )
        value = int.from_bytes(data, "little")
        if value:
            resolve(self._context.dictionary, value, self.direction)

    def _check_count(self, data: bytes) -> None:
        self._require_disabled()
        if data[0] > LARGEST_MAPPING:
            raise SdoAbortError(AbortCode.PDO_LENGTH, f"{data[0]} objects, at most {LARGEST_MAPPING}")
        self._mapped(data[0])

    def _mapped(self, count: int) -> list[MappedObject]:
        values = [slot.number() for slot in self._slots[:count]]
        return resolve_all(self._context.dictionary, values, self.direction)

    def _require_disabled(self) -> None:
        if self._valid:
            raise SdoAbortError(AbortCode.UNSUPPORTED_ACCESS, "disable the PDO before changing its mapping")
