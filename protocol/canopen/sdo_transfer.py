"""Segmented and block SDO transfers, server side: one object per active transfer (CiA 301, SDO protocols).

A transfer receives the 8 bytes of each further request and returns the 8-byte answers; `done` is set when it
has ended. It raises `SdoAbortError` if the protocol is violated; the server then sends the abort and drops
the transfer.
"""

from __future__ import annotations

from binascii import crc_hqx
from collections.abc import Callable
from typing import Final

from starhil.protocol.canopen.abort import AbortCode, SdoAbortError
from starhil.protocol.canopen.dictionary import Deferred

SEGMENT: Final = 7
"""Data bytes of a segment."""
MAXIMUM_BLOCK: Final = 127
"""Maximum number of segments in a block."""

Commit = Callable[[bytes], Deferred | None]
"""Writes the complete data to the object; raises `SdoAbortError`, or returns a token if the result follows
later."""


class Transfer:
    """An active transfer of an index and sub-index."""

    def __init__(self, index: int, subindex: int) -> None:
        self.index = index
        self.subindex = subindex
        self.done = False
        self.deferred: Deferred | None = None
        """Set at the end of a download whose result follows later and has to be awaited."""

    def request(self, data: bytes) -> list[bytes]:
        """Answer one request; the base class rejects all requests."""
        raise SdoAbortError(AbortCode.COMMAND, f"0x{data[0]:02X}")


class ReceiveBuffer:
    """Collects the data of a download, up to the announced size and the maximum size of the object.

    Parameters
    ----------
    announced
        Size announced by the client, or None.
    maximum
        Maximum size of the object in bytes.
    """

    def __init__(self, announced: int | None, maximum: int) -> None:
        self.announced = announced
        self.maximum = maximum
        self.data = bytearray()

    def check(self) -> None:
        """Reject more data than the maximum or the announced size."""
        if len(self.data) > self.maximum:
            raise SdoAbortError(AbortCode.LENGTH_HIGH, f"{len(self.data)} bytes, at most {self.maximum}")
        if self.announced is not None and len(self.data) > self.announced:
            raise SdoAbortError(AbortCode.LENGTH, f"{len(self.data)} bytes, {self.announced} announced")

    def finish(self) -> bytes:
        """Return the complete data; reject less data than announced."""
        self.check()
        if self.announced is not None and len(self.data) != self.announced:
            raise SdoAbortError(AbortCode.LENGTH, f"{len(self.data)} bytes, {self.announced} announced")
        return bytes(self.data)


class SegmentedDownload(Transfer):
    """The client writes segments of up to 7 bytes, each confirmed."""

    def __init__(self, index: int, subindex: int, buffer: ReceiveBuffer, commit: Commit) -> None:
        super().__init__(index, subindex)
        self._buffer = buffer
        self._commit = commit
        self._toggle = 0

    def request(self, data: bytes) -> list[bytes]:
        """Process a segment (command specifier 0)."""
        command = data[0]
        if command >> 5 != 0:
            return super().request(data)
        if command & 0x10 != self._toggle:
            raise SdoAbortError(AbortCode.TOGGLE)
        unused = command >> 1 & 0x07
        self._buffer.data += data[1 : 8 - unused]
        self._buffer.check()
        if command & 0x01:
            self.deferred = self._commit(self._buffer.finish())
            self.done = True
        answer = bytes([0x20 | self._toggle]) + bytes(7)
        self._toggle ^= 0x10
        return [answer]


class SegmentedUpload(Transfer):
    """The client reads segments of up to 7 bytes."""

    def __init__(self, index: int, subindex: int, data: bytes) -> None:
        super().__init__(index, subindex)
        self._data = data
        self._position = 0
        self._toggle = 0

    def request(self, data: bytes) -> list[bytes]:
        """Answer a segment request (command specifier 3)."""
        command = data[0]
        if command >> 5 != 3:
            return super().request(data)
        if command & 0x10 != self._toggle:
            raise SdoAbortError(AbortCode.TOGGLE)
        chunk = self._data[self._position : self._position + SEGMENT]
        self._position += len(chunk)
        self.done = self._position >= len(self._data)
        unused = SEGMENT - len(chunk)
        answer = bytes([self._toggle | unused << 1 | self.done]) + chunk + bytes(unused)
        self._toggle ^= 0x10
        return [answer]


class BlockDownload(Transfer):
    """The client writes blocks of up to 127 unconfirmed segments, with a CRC over all data at the end.

    After a gap, the block is confirmed up to the last segment in sequence; the client repeats the others.
    """

    def __init__(
        self, index: int, subindex: int, buffer: ReceiveBuffer, commit: Commit, *, crc: bool
    ) -> None:
        super().__init__(index, subindex)
        self._buffer = buffer
        self._commit = commit
        self._crc = crc
        self._good = 0
        self._ending = False

    @property
    def streaming(self) -> bool:
        """Whether the next frame is a segment, whose first byte is not a command."""
        return not self._ending

    def request(self, data: bytes) -> list[bytes]:
        """Process a segment, or the end request after the last segment."""
        return self._complete(data) if self._ending else self._segment(data)

    def _segment(self, data: bytes) -> list[bytes]:
        number = data[0] & 0x7F
        last = bool(data[0] & 0x80)
        if number == 0:
            raise SdoAbortError(AbortCode.SEQUENCE, "segment number 0")
        expected = number == self._good + 1
        if expected:
            self._good = number
            self._buffer.data += data[1:]
            if len(self._buffer.data) > self._buffer.maximum + SEGMENT:
                self._buffer.check()
        if not last and number != MAXIMUM_BLOCK:
            return []
        answer = bytes([0xA2, self._good, MAXIMUM_BLOCK]) + bytes(5)
        self._good = 0
        self._ending = last and expected
        return [answer]

    def _complete(self, data: bytes) -> list[bytes]:
        command = data[0]
        if command >> 5 != 6 or command & 0x01 != 1:
            return super().request(data)
        unused = command >> 2 & 0x07
        if unused:
            del self._buffer.data[-unused:]
        received = self._buffer.finish()
        if self._crc and crc_hqx(received, 0) != int.from_bytes(data[1:3], "little"):
            raise SdoAbortError(AbortCode.CRC)
        self.deferred = self._commit(received)
        self.done = True
        return [bytes([0xA1]) + bytes(7)]


class BlockUpload(Transfer):
    """The client reads blocks of up to 127 segments.

    The client confirms each block and may request segments again.
    """

    def __init__(self, index: int, subindex: int, data: bytes, block_size: int, *, crc: bool) -> None:
        super().__init__(index, subindex)
        self._data = data
        self._check = crc_hqx(data, 0) if crc else 0
        self._block_size = valid_block_size(block_size)
        self._position = 0
        self._sent = 0
        self._started = False
        self._ending = False

    def request(self, data: bytes) -> list[bytes]:
        """Answer start, confirmation of a block or end (specifier 5, subcommands 3, 2 and 1)."""
        command = data[0]
        if command >> 5 != 5:
            return super().request(data)
        subcommand = command & 0x03
        if subcommand == 3 and not self._started:
            self._started = True
            return self._block()
        if subcommand == 2 and self._started and not self._ending:
            return self._confirmed(data[1], data[2])
        if subcommand == 1 and self._ending:
            self.done = True
            return []
        return super().request(data)

    def _confirmed(self, good: int, block_size: int) -> list[bytes]:
        if good > self._sent:
            raise SdoAbortError(AbortCode.SEQUENCE, f"{good} segments confirmed, {self._sent} sent")
        self._block_size = valid_block_size(block_size)
        self._position = min(self._position + good * SEGMENT, len(self._data))
        if self._position < len(self._data) or good == 0:
            return self._block()
        self._ending = True
        unused = -len(self._data) % SEGMENT if self._data else SEGMENT
        return [bytes([0xC1 | unused << 2]) + self._check.to_bytes(2, "little") + bytes(5)]

    def _block(self) -> list[bytes]:
        end = self._position + self._block_size * SEGMENT
        block = self._data[self._position : end]
        self._sent = max(1, -(-len(block) // SEGMENT))
        block += bytes(self._sent * SEGMENT - len(block))
        segments = [
            bytes([number + 1]) + block[number * SEGMENT : (number + 1) * SEGMENT]
            for number in range(self._sent)
        ]
        if end >= len(self._data):
            segments[-1] = bytes([0x80 | self._sent]) + segments[-1][1:]
        return segments


def valid_block_size(size: int) -> int:
    """Return a number of segments per block if it is 1 to 127.

    Raise `SdoAbortError` BLOCK_SIZE otherwise.
    """
    if not 1 <= size <= MAXIMUM_BLOCK:
        raise SdoAbortError(AbortCode.BLOCK_SIZE, f"{size} segments per block")
    return size
