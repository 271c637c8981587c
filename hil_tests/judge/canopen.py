"""CANopen: the bytes of SDO transfers, the entries of a unit's object dictionary, and what a PDO carries of them.

    SDO      | command | index, low byte first | sub-index | data or size, 4 bytes |    600h + node, 580h + node
    segment  | command with toggle 10h | 7 bytes of data |
    PDO      | object | object | …         each as long as its mapping entry says, the lowest byte first
    mapping  index << 16 | sub-index << 8 | number of bits

Source: CiA 301, 7.2.4.3 (SDO), 7.4.7 (PDO mapping), 7.3.5 (CAN IDs). All numbers are little-endian; a row that is
big-endian on its other links is converted.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Final

from starhil.hil_tests.judge.definition import Unit
from starhil.hil_tests.judge.rows import Field, Row

PREDEFINED: Final = {0x1400: (0x200, 0x300, 0x400, 0x500), 0x1800: (0x180, 0x280, 0x380, 0x480)}
"""CAN IDs of the first four RPDOs and TPDOs, to which the node ID is added (CiA 301 7.3.5)."""
NMT, SYNC, EMERGENCY, TIME = 0x000, 0x080, 0x080, 0x100
SDO_RESPONSE, SDO_REQUEST, HEARTBEAT = 0x580, 0x600, 0x700
"""CAN IDs; to those of EMCY, SDO and heartbeat, the node ID is added (CiA 301 7.3.5)."""
SDO_SIZE: Final = 8
"""Bytes of each SDO request and response."""
EXPEDITED, SEGMENT = 4, 7
"""Maximum number of bytes in an expedited SDO, and in a segment."""
ABORT: Final = 0x80

Exchange = Callable[[bytes], bytes | None]
"""Sends an SDO request, and returns the response, None without one; it fills the request up to 8 bytes."""


# --- SDO ---


def multiplexer(index: int, subindex: int) -> bytes:
    """Return index and sub-index as encoded in an SDO."""
    return index.to_bytes(2, "little") + bytes([subindex])


def upload_request(index: int, subindex: int) -> bytes:
    """Return the request that begins to read an object."""
    return bytes([0x40]) + multiplexer(index, subindex)


def abort_code(response: bytes) -> int:
    return int.from_bytes(response[4:], "little")


class AbortedError(Exception):
    """The node has refused a transfer, with the code of its abort."""

    def __init__(self, code: int) -> None:
        super().__init__(f"abort 0x{code:08X}")
        self.code = code


class BadResponseError(Exception):
    """What was expected, and the response that was seen instead, None for none."""

    def __init__(self, expected: str, seen: bytes | None) -> None:
        super().__init__(expected)
        self.expected, self.seen = expected, seen


def upload(exchange: Exchange, index: int, subindex: int) -> bytes:
    """Read an object, expedited or in segments.

    Raises AbortedError, and BadResponseError for a response that a server must not send.
    """
    name, mux = f"{index:04X}h:{subindex:02X}h", multiplexer(index, subindex)
    seen = exchange(upload_request(index, subindex))
    begun = _checked(seen, f"an answer to reading {name}", 0xE0, 0x40, mux)
    if begun[0] & 0x02:
        return begun[4 : SDO_SIZE - (begun[0] >> 2 & 3)]
    data, toggle, is_last = b"", 0, False
    while not is_last:
        segment = _checked(exchange(bytes([0x60 | toggle])), f"a segment of {name}", 0xF0, toggle)
        data += segment[1 : SDO_SIZE - (segment[0] >> 1 & 7)]
        toggle, is_last = toggle ^ 0x10, bool(segment[0] & 1)
    if begun[0] & 1 and len(data) != int.from_bytes(begun[4:], "little"):
        raise BadResponseError(f"as many bytes of {name} as announced", data)
    return data


def download(exchange: Exchange, index: int, subindex: int, data: bytes) -> None:
    """Write an object, expedited or in segments; raises as `upload`."""
    name, mux = f"{index:04X}h:{subindex:02X}h", multiplexer(index, subindex)
    command, first, pieces = 0x23 | (EXPEDITED - len(data)) << 2, data, []
    if len(data) > EXPEDITED:
        command, first = 0x21, len(data).to_bytes(4, "little")
        pieces = [data[start : start + SEGMENT] for start in range(0, len(data), SEGMENT)]
    response = exchange(bytes([command]) + mux + first)
    _checked(response, f"an answer to writing {name}", 0xFF, 0x60, mux)
    for number, piece in enumerate(pieces, 1):
        toggle = 0 if number % 2 else 0x10
        response = exchange(bytes([toggle | SEGMENT - len(piece) << 1 | (number == len(pieces))]) + piece)
        _checked(response, f"a confirmed segment of {name}", 0xFF, 0x20 | toggle, mux, named=False)


def _checked(
    response: bytes | None,
    expected: str,
    mask: int,
    command: int,
    mux: bytes | None = None,
    *,
    named: bool = True,
) -> bytes:
    """Return a response with this command, `named` with its object; it may be an abort if an object is given."""
    if response is not None and len(response) == SDO_SIZE:
        names = mux is None or response[1:4] == mux
        if response[0] == ABORT and mux is not None and names and abort_code(response):
            raise AbortedError(abort_code(response))
        if response[0] & mask == command and (names or not named):
            return response
    raise BadResponseError(expected, response)


# --- the object dictionary of a unit ---


@dataclass(frozen=True)
class Entry:
    """An entry of the object dictionary, as defined in `[canopen]`.

    Attributes
    ----------
    name
        Name used by PDOs: `INDEX.NAME`, or `INDEX`.
    size
        Size in bytes; 0 if it varies, as for a text.
    row, slot
        Telemetry row, and the slot that the entry reads.
    command, part
        Telecommand that a write executes, and the part of its data that is written; None: all of it.
    packed
        Model of an entry that has a field of `packed.source` in another type.
    """

    index: int
    subindex: int
    name: str
    size: int
    row: Row | None = None
    slot: Field | None = None
    command: Row | None = None
    part: Field | None = None
    packed: Any = None

    @property
    def mapping(self) -> int:
        return self.index << 16 | self.subindex << 8 | 8 * self.size


def entries(unit: Unit, layout: Any) -> Iterator[Entry]:
    for placed in layout.object:
        index, at = placed.index, f"{placed.index:04x}"
        command = None if placed.telecommand is None else unit.telecommands[placed.telecommand]
        if placed.telemetry is not None and placed.type is not None:
            whole = whole_row(index, 0, unit.telemetry[placed.telemetry])
            yield replace(whole, name=at, command=command)
        elif placed.telemetry is not None:
            row = unit.telemetry[placed.telemetry]
            for number, slot in enumerate(places(row), 1):
                part = None if command is None else slot
                yield Entry(index, number, f"{at}.{slot.name}", slot.size, row, slot, command, part)
        elif placed.members:
            subindex = 0
            for member in placed.members:
                subindex = member.subindex or subindex + 1
                yield _entry(unit, member, index, subindex, f"{at}.{member.name.lower()}")
        elif placed.value is not None or placed.telecommand is not None:
            yield _entry(unit, placed, index, 0, at)
        elif placed.parameters:
            for parameter in unit.parameters.values():
                yield Entry(index, parameter.id, f"{at}.{parameter.name}", _bytes_of(parameter.type))
        for number, packed in enumerate(placed.packed, 1):
            name = packed.name or packed.source.partition(".")[2]
            yield Entry(index, number, f"{at}.{name}", _bytes_of(packed.type), packed=packed)


def whole_row(index: int, subindex: int, row: Row) -> Entry:
    """Return an entry that reads all data of a telemetry row as one slot, or executes a telecommand."""
    if not row.is_telemetry:
        return Entry(index, subindex, row.name, row.size, command=row)
    slot = Field("", "bytes", "bytes", "little", 0, row.size)
    return Entry(index, subindex, row.name, row.size, row, slot)


def _entry(unit: Unit, placed: Any, index: int, subindex: int, name: str) -> Entry:
    row, slot, size = None, None, 0
    if placed.value is not None:
        row_name, _, field = placed.value.partition(".")
        row = unit.telemetry[row_name]
        slot = row.named[field]
        size = 0 if slot.kind == "text" else slot.size
    command = None if placed.telecommand is None else unit.telecommands[placed.telecommand]
    if command is not None and not is_text(command):
        size = size or command.size
    if getattr(placed, "parameter", None) is not None:
        size = _bytes_of(unit.parameters[placed.parameter].type)
    return Entry(index, subindex, name, size, row, slot, command)


def places(row: Row) -> list[Field]:
    """Return the first named field at each place of a row; fields of bits share one."""
    return list({item.offset: item for item in reversed(list(row.named.values()))}.values())[::-1]


def is_text(command: Row) -> bool:
    """Return whether a telecommand has a text, which is written without padding."""
    return [field.kind for field in command.fields] == ["text"]


def _bytes_of(type_: str) -> int:
    """Return the bytes of a type; names end in the number of bits, but for `bool`."""
    return int("".join(filter(str.isdigit, type_)) or 8) // 8


def with_byte_order(slot: Field | None, data: bytes) -> bytes:
    """Convert bytes between the byte order of a slot and CANopen's, little-endian."""
    return data[::-1] if slot is not None and slot.order == "big" and slot.type != "bytes" else data


def slots(row: Row, entries: Iterable[Entry]) -> list[tuple[Entry, Field]]:
    """Return the entries that hold slots of a row, given by its name, and the slots."""
    return [
        (entry, entry.slot)
        for entry in entries
        if entry.row is not None and entry.row.name == row.name and entry.slot is not None
    ]


def row_data(row: Row, found: Iterable[Entry], read: Callable[[Entry], bytes]) -> bytes:
    """Return the data of a row, read through the entries that hold its slots; a text ends before its NULs."""
    data = bytearray(row.size)
    for entry, slot in slots(row, found):
        value = with_byte_order(slot, read(entry)).ljust(slot.size, b"\0")
        data[slot.offset : slot.offset + slot.size] = value
    return bytes(data)


def written(entry: Entry, command: Row, data: bytes) -> bytes:
    part = places(command)[0] if entry.part is None and len(places(command)) == 1 else entry.part
    if not data:
        return b"\x01"
    if is_text(command):
        return data.rstrip(b"\0") or b"\0"
    return data if part is None else with_byte_order(part, data[part.offset : part.offset + part.size])


# --- PDOs ---


def pdo_can_id(node: int, index: int, model: Any) -> int:
    """Return the default CAN ID of a PDO, given the index of its communication record; 0 for none."""
    predefined = PREDEFINED[index & ~0x1FF]
    number = index & 0x1FF
    if model.can_id is None:
        return predefined[number] + node if number < len(predefined) else 0
    return int(model.can_id) + (node if model.relative else 0)
