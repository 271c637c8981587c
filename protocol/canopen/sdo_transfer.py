"""SDO transfers, server side: expedited, segmented and block (CiA 301, SDO protocols).

A transfer is a generator in the order of its protocol. It yields the 8-byte answers to each request, is sent the next
request, and returns the answers to the last one. It raises `SdoAbortError` if the protocol is violated; the server then
sends the abort and drops the transfer.
"""

from __future__ import annotations

from binascii import crc_hqx
from collections.abc import Generator
from typing import Final

from starhil.protocol.canopen.abort import AbortCode, SdoAbortError
from starhil.protocol.canopen.dictionary import Deferred, Dictionary, check_length

SEGMENT: Final = 7
"""Data bytes of a segment."""
MAXIMUM_BLOCK: Final = 127
"""Maximum number of segments in a block."""

Answers = list[bytes]
Protocol = Generator[Answers, bytes, Answers]


class Transfer:
    """The transfers of an index and sub-index, of which one is active."""

    def __init__(self, dictionary: Dictionary, index: int, subindex: int) -> None:
        self.index = index
        self.subindex = subindex
        self._dictionary = dictionary
        self.streaming = False
        """Whether the next frame is a segment of a block, whose first byte is not a command."""
        self.deferred: Deferred | None = None
        """Set at the end of a download whose result follows later and has to be awaited."""

    def download(self, data: bytes) -> Protocol:
        """The client writes up to 4 bytes with its request, or more in segments of up to 7 bytes, each confirmed."""
        command = data[0]
        answer = bytes([0x60]) + data[1:4] + bytes(4)
        # bit e: expedited, the data are in the request; bit s: their size is indicated, otherwise it is that of the entry
        if command & 0x02:
            entry = self._dictionary.writable(self.index, self.subindex)
            length = 4 - (command >> 2 & 0x03) if command & 0x01 else min(4, entry.size or 4)
            self._write(data[4 : 4 + length])
            return [answer]
        buffer = self._buffer(data, sized=bool(command & 0x01))
        toggle = 0
        while True:
            data = yield [answer]
            command = _command(data, data[0] >> 5 == 0)
            if command & 0x10 != toggle:
                raise SdoAbortError(AbortCode.TOGGLE)
            unused = command >> 1 & 0x07
            buffer.data += data[1 : 8 - unused]
            buffer.check()
            answer = bytes([0x20 | toggle]) + bytes(7)
            if command & 0x01:
                self._write(buffer.finish())
                return [answer]
            toggle ^= 0x10

    def upload(self, data: bytes) -> Protocol:
        """The client reads up to 4 bytes at once, or more in segments of up to 7 bytes."""
        value = self._dictionary.read(self.index, self.subindex)
        if 1 <= len(value) <= 4:
            unused = 4 - len(value)
            return [bytes([0x43 | unused << 2]) + data[1:4] + value + bytes(unused)]
        answer = bytes([0x41]) + data[1:4] + len(value).to_bytes(4, "little")
        toggle = position = 0
        last = False
        while not last:
            data = yield [answer]
            command = _command(data, data[0] >> 5 == 3)
            if command & 0x10 != toggle:
                raise SdoAbortError(AbortCode.TOGGLE)
            chunk = value[position : position + SEGMENT]
            position += len(chunk)
            last = position >= len(value)
            unused = SEGMENT - len(chunk)
            answer = bytes([toggle | unused << 1 | last]) + chunk + bytes(unused)
            toggle ^= 0x10
        return [answer]

    def block_download(self, data: bytes) -> Protocol:
        """The client writes blocks of up to 127 unconfirmed segments, with a CRC over all data at the end.

        After a gap, the block is confirmed up to the last segment in sequence; the client repeats the others.
        """
        buffer = self._buffer(data, sized=bool(data[0] & 0x02))
        has_crc = bool(data[0] & 0x04)
        answers = [bytes([0xA4]) + data[1:4] + bytes([MAXIMUM_BLOCK]) + bytes(3)]
        good = 0
        self.streaming = True
        while self.streaming:
            data = yield answers
            number, last = data[0] & 0x7F, bool(data[0] & 0x80)
            if number == 0:
                raise SdoAbortError(AbortCode.SEQUENCE, "segment number 0")
            expected = number == good + 1
            if expected:
                good = number
                buffer.data += data[1:]
                # how much of the last segment is padding is known only at the end
                if len(buffer.data) > buffer.maximum + SEGMENT:
                    buffer.check()
            answers = []
            if last or number == MAXIMUM_BLOCK:
                answers = [bytes([0xA2, good, MAXIMUM_BLOCK]) + bytes(5)]
                good = 0
                # after a gap, the client sends the last segment again in the next block
                self.streaming = not (last and expected)
        data = yield answers
        command = _command(data, data[0] >> 5 == 6 and data[0] & 0x01 == 1)
        unused = command >> 2 & 0x07
        if unused:
            del buffer.data[-unused:]
        received = buffer.finish()
        if has_crc and crc_hqx(received, 0) != int.from_bytes(data[1:3], "little"):
            raise SdoAbortError(AbortCode.CRC)
        self._write(received)
        return [bytes([0xA1]) + bytes(7)]

    def block_upload(self, data: bytes) -> Protocol:
        """The client reads blocks of up to 127 segments, confirms each block, and may request segments again."""
        value = self._dictionary.read(self.index, self.subindex)
        block_size, threshold = _valid_block_size(data[4]), data[5]
        # protocol switch: the client prefers a plain upload for a short value
        if threshold and len(value) <= threshold:
            return (yield from self.upload(data))
        check = crc_hqx(value, 0) if data[0] & 0x04 else 0
        data = yield [bytes([0xC6]) + data[1:4] + len(value).to_bytes(4, "little")]
        _command(data, data[0] >> 5 == 5 and data[0] & 0x03 == 3)
        position = good = 0
        # an empty value is sent as one segment too, which the client must confirm
        while position < len(value) or good == 0:
            segments = _block(value, position, block_size)
            data = yield segments
            _command(data, data[0] >> 5 == 5 and data[0] & 0x03 == 2)
            good = data[1]
            if good > len(segments):
                raise SdoAbortError(AbortCode.SEQUENCE, f"{good} segments confirmed, {len(segments)} sent")
            block_size = _valid_block_size(data[2])
            position = min(position + good * SEGMENT, len(value))
        unused = -len(value) % SEGMENT if value else SEGMENT
        data = yield [bytes([0xC1 | unused << 2]) + check.to_bytes(2, "little") + bytes(5)]
        _command(data, data[0] >> 5 == 5 and data[0] & 0x03 == 1)
        return []

    def _buffer(self, data: bytes, *, sized: bool) -> _Buffer:
        """Return the buffer of a download whose request announces its size, or does not."""
        entry = self._dictionary.writable(self.index, self.subindex)
        announced = int.from_bytes(data[4:8], "little") if sized else None
        if announced is not None:
            check_length(entry, announced)
        return _Buffer(announced, entry.maximum_size if entry.size is None else entry.size)

    def _write(self, data: bytes) -> None:
        self.deferred = self._dictionary.write(self.index, self.subindex, data)


class _Buffer:
    """Collects the data of a download, up to the announced size and the maximum size of the object, bytes."""

    def __init__(self, announced: int | None, maximum: int) -> None:
        self._announced = announced
        self.maximum = maximum
        self.data = bytearray()

    def check(self) -> None:
        """Reject more data than the maximum or the announced size."""
        if len(self.data) > self.maximum:
            raise SdoAbortError(AbortCode.LENGTH_HIGH, f"{len(self.data)} bytes, at most {self.maximum}")
        if self._announced is not None and len(self.data) > self._announced:
            raise SdoAbortError(AbortCode.LENGTH, f"{len(self.data)} bytes, {self._announced} announced")

    def finish(self) -> bytes:
        """Return the complete data; reject less data than announced."""
        self.check()
        if self._announced is not None and len(self.data) != self._announced:
            raise SdoAbortError(AbortCode.LENGTH, f"{len(self.data)} bytes, {self._announced} announced")
        return bytes(self.data)


def _command(data: bytes, expected: bool) -> int:
    """Return the command of a request; reject one that does not continue the transfer."""
    if not expected:
        raise SdoAbortError(AbortCode.COMMAND, f"0x{data[0]:02X}")
    return data[0]


def _valid_block_size(size: int) -> int:
    """Return a number of segments per block; reject one that is not 1 to 127."""
    if not 1 <= size <= MAXIMUM_BLOCK:
        raise SdoAbortError(AbortCode.BLOCK_SIZE, f"{size} segments per block")
    return size


def _block(value: bytes, position: int, block_size: int) -> list[bytes]:
    """Return the numbered segments of a block that begins at a position; the last of the value is marked."""
    end = position + block_size * SEGMENT
    block = value[position:end]
    count = max(1, -(-len(block) // SEGMENT))
    block = block.ljust(count * SEGMENT, b"\0")
    segments = [
        bytes([number + 1]) + block[number * SEGMENT : (number + 1) * SEGMENT] for number in range(count)
    ]
    if end >= len(value):
        segments[-1] = bytes([0x80 | count]) + segments[-1][1:]
    return segments
