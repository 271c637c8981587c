"""PDO communication and mapping records, and the rules for changing them (CiA 301)."""

from __future__ import annotations

from collections.abc import Container
from dataclasses import dataclass
from enum import Enum
from typing import Final

import construct

from starhil.protocol.canopen.abort import AbortCode, SdoAbortError
from starhil.protocol.canopen.cob import BIT_30, ID_MASK, check_change, exists
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


class Direction(Enum):
    """RPDO or TPDO, with the indices of the first communication and mapping record."""

    RECEIVE = (0x1400, 0x1600)
    TRANSMIT = (0x1800, 0x1A00)

    @property
    def communication(self) -> int:
        """Index of the first communication record."""
        return self.value[0]

    @property
    def mapping(self) -> int:
        """Index of the first mapping record."""
        return self.value[1]

    def numbers(self, indices: Container[int]) -> list[int]:
        """Return the PDOs of this direction that a dictionary with these indices has; the first is 0."""
        return [number for number in range(0x200) if self.communication + number in indices]


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


class PdoRecords:
    """Communication and mapping record of a PDO, 0 for the first, with the rules for changing them."""

    def __init__(self, dictionary: Dictionary, direction: Direction, number: int) -> None:
        self._dictionary = dictionary
        self.direction = direction
        self.number = number
        self.changed = True
        """Whether a record was written since the PDO was configured."""
        communication = direction.communication + number
        mapping = direction.mapping + number
        self._cob_id = dictionary.find(communication, 1)
        self._type = dictionary.find(communication, 2)
        self._inhibit = dictionary.entries.get((communication, 3))
        self._event_timer = dictionary.entries.get((communication, 5))
        self._sync_start = dictionary.entries.get((communication, 6))
        self._count = dictionary.find(mapping, 0)
        self._slots = [dictionary.find(mapping, position + 1) for position in range(LARGEST_MAPPING)]
        self._cob_id.writer = self._write_cob_id
        self._type.writer = self._write_type
        for entry in (self._inhibit, self._sync_start):
            if entry is not None:
                entry.writer = self._write_when_invalid
        if self._event_timer is not None:
            self._event_timer.writer = self._write_event_timer
        if self._sync_start is not None:
            self._sync_start.writer = self._write_sync_start
        self._count.writer = self._write_count
        for slot in self._slots:
            slot.writer = self._write_slot

    @property
    def valid(self) -> bool:
        """Whether the PDO is enabled."""
        return exists(self._cob_id.number())

    @property
    def can_id(self) -> int:
        """CAN ID of the message."""
        return self._cob_id.number() & ID_MASK

    @property
    def transmission_type(self) -> int:
        """Transmission type: when the PDO is sent or applied."""
        return self._type.number()

    @property
    def inhibit_s(self) -> float:
        """Shortest time between two transmissions, s."""
        return 0.0 if self._inhibit is None else self._inhibit.number() * 1e-4

    @property
    def event_s(self) -> float:
        """TPDO: longest time between two transmissions.

        RPDO: deadline of the next message; s, 0 for none.
        """
        return 0.0 if self._event_timer is None else self._event_timer.number() * 1e-3

    @property
    def sync_start(self) -> int:
        """SYNC counter at which the PDO starts, 0 for any."""
        return 0 if self._sync_start is None else self._sync_start.number()

    def mapped(self) -> list[MappedObject]:
        """Return the mapped objects in order; none while the mapping is disabled."""
        count = min(self._count.number(), LARGEST_MAPPING)
        return [resolve(self._dictionary, slot.number(), self.direction) for slot in self._slots[:count]]

    def _write_cob_id(self, data: bytes) -> None:
        new = int.from_bytes(data, "little")
        if self.direction is Direction.TRANSMIT and not new & BIT_30:
            raise SdoAbortError(
                AbortCode.VALUE_RANGE, "remote requests are not supported: bit 30 must be set"
            )
        check_change(self._cob_id.number(), new, enabled=exists)
        self.changed = True

    def _write_type(self, data: bytes) -> None:
        if data[0] > LAST_CYCLIC and data[0] not in EVENT_DRIVEN:
            raise SdoAbortError(AbortCode.VALUE_RANGE, f"transmission type {data[0]} is not supported")
        self.changed = True

    def _write_when_invalid(self, data: bytes) -> None:
        if self.valid:
            raise SdoAbortError(AbortCode.VALUE_RANGE, f"disable the PDO before setting it to {data.hex()}")
        self.changed = True

    def _write_event_timer(self, _data: bytes) -> None:
        self.changed = True

    def _write_sync_start(self, data: bytes) -> None:
        if data[0] > LAST_CYCLIC:
            raise SdoAbortError(AbortCode.VALUE_RANGE, "SYNC start value is 0 to 240")
        self._write_when_invalid(data)

    def _require_disabled(self) -> None:
        if self.valid:
            raise SdoAbortError(AbortCode.UNSUPPORTED_ACCESS, "disable the PDO before changing its mapping")

    def _write_slot(self, data: bytes) -> None:
        self._require_disabled()
        if self._count.number():
            raise SdoAbortError(
                AbortCode.UNSUPPORTED_ACCESS, "set sub-index 0 to 0 before changing the mapping"
            )
        value = int.from_bytes(data, "little")
        if value:
            resolve(self._dictionary, value, self.direction)

    def _write_count(self, data: bytes) -> None:
        self._require_disabled()
        if data[0] > LARGEST_MAPPING:
            raise SdoAbortError(AbortCode.PDO_LENGTH, f"{data[0]} objects, at most {LARGEST_MAPPING}")
        objects = [
            resolve(self._dictionary, slot.number(), self.direction) for slot in self._slots[: data[0]]
        ]
        size = sum(mapped.size for mapped in objects)
        if size > LARGEST_PDO:
            raise SdoAbortError(AbortCode.PDO_LENGTH, f"{size} bytes, at most {LARGEST_PDO}")
        self.changed = True
