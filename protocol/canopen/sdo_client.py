"""SDO client: transfers as generators that yield requests of 8 bytes and are sent the responses."""

from __future__ import annotations

import struct
from collections.abc import Generator, Sequence
from contextlib import suppress
from typing import Final

from starhil.protocol.canopen.abort import SdoAbortError
from starhil.protocol.canopen.device_dictionary import DeviceDictionary, Key, in_order, span_of
from starhil.protocol.icd.codec import Row, Slot

SdoTransfer = Generator[bytes, bytes, bytes]
"""Returns the data of an upload, or no data after a download; raises `SdoAbortError` on an abort."""

_ABORT: Final = 0x80
_SEGMENT: Final = 7
_CONFIRMATION: Final = bytes(8)
_EXECUTE: Final = b"\x01"
"""Written to the entry of a telecommand that has no data."""


def upload(index: int, subindex: int) -> SdoTransfer:
    """Read an entry, expedited or in segments."""
    answer = _checked((yield struct.pack("<BHB4x", 0x40, index, subindex)))
    if answer[0] & 0x02:
        return answer[4 : 8 - (answer[0] >> 2 & 3)]
    data, toggle = b"", 0
    while True:
        answer = _checked((yield bytes([0x60 | toggle]).ljust(8, b"\0")))
        data += answer[1 : 8 - (answer[0] >> 1 & 7)]
        if answer[0] & 0x01:
            return data
        toggle ^= 0x10


def download(index: int, subindex: int, data: bytes) -> SdoTransfer:
    """Write an entry, expedited up to 4 bytes, otherwise in segments."""
    if 0 < len(data) <= 4:
        command = 0x23 | (4 - len(data)) << 2
        _checked((yield struct.pack("<BHB", command, index, subindex) + data.ljust(4, b"\0")))
        return b""
    _checked((yield struct.pack("<BHBI", 0x21, index, subindex, len(data))))
    for start in range(0, len(data), _SEGMENT):
        piece = data[start : start + _SEGMENT]
        toggle = 0x10 * (start // _SEGMENT % 2)
        last = start + _SEGMENT >= len(data)
        command = toggle | (_SEGMENT - len(piece)) << 1 | last
        _checked((yield bytes([command]) + piece.ljust(_SEGMENT, b"\0")))
    return b""


def row_transfer(dictionary: DeviceDictionary, row: Row, data: bytes = b"") -> SdoTransfer:
    """Execute a telecommand with its data, or read a telemetry row, through the entries that hold it.

    Raises IcdError: the object dictionary does not hold the row.
    """
    entries = dictionary.entries_of(row)
    if row.kind == "telemetry":
        return _read(row, entries)
    return _write(data, entries)


def _read(row: Row, entries: Sequence[tuple[Key, Slot | None]]) -> SdoTransfer:
    data = bytearray(row.encode())
    for key, slot in entries:
        value = yield from upload(*key)
        if slot is None:
            return value
        data[span_of(slot)] = in_order(slot, value).ljust(slot.size, b"\0")  # a text ends before its NULs
    return bytes(data)


def _write(data: bytes, entries: Sequence[tuple[Key, Slot | None]]) -> SdoTransfer:
    for key, slot in entries:
        part = data if len(entries) == 1 or slot is None else data[span_of(slot)]
        value = part if slot is None else in_order(slot, part)
        yield from download(*key, value if data else _EXECUTE)
    return b""


def requests_of(transfer: SdoTransfer) -> list[bytes]:
    """Return the requests of a download, assuming that it is not aborted."""
    requests = [next(transfer)]
    with suppress(StopIteration):
        while True:
            requests.append(transfer.send(_CONFIRMATION))
    return requests


def _checked(answer: bytes) -> bytes:
    if answer[0] == _ABORT:
        raise SdoAbortError(int.from_bytes(answer[4:], "little"))
    return answer
