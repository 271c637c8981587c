"""SDO server: initiates transfers, passes further requests to the active one (CiA 301, SDO)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Final

from starhil.protocol.canopen.abort import AbortCode, SdoAbortError
from starhil.protocol.canopen.dictionary import Deferred, Dictionary, check_length
from starhil.protocol.canopen.sdo_transfer import (
    MAXIMUM_BLOCK,
    BlockDownload,
    BlockUpload,
    Commit,
    ReceiveBuffer,
    SegmentedDownload,
    SegmentedUpload,
    Transfer,
    valid_block_size,
)
from starhil.protocol.errors import ProtocolError

LENGTH: Final = 8
"""Data bytes of every SDO frame."""
ABORT: Final = 0x80
RESULT_TIMEOUT_S: Final = 30.0
"""Longer than any result takes: an exposure that waits for the previous image takes seconds."""


@dataclass
class _Waiting:
    """A download that was accepted but not yet answered."""

    deferred: Deferred
    answers: list[bytes]
    index: int
    subindex: int


class SdoServer:
    """Answers the SDO requests of one client (1200h).

    Parameters
    ----------
    dictionary
        Object dictionary to read and write.
    timeout_s
        Silence of the client after which a transfer is aborted.
    """

    def __init__(self, dictionary: Dictionary, timeout_s: float = 1.0) -> None:
        self._dictionary = dictionary
        self._timeout_s = timeout_s
        self._transfer: Transfer | None = None
        self._waiting: _Waiting | None = None
        self.deadline: float | None = None
        self.faults: list[str] = []
        """Texts of unexpected errors in the application, which the node reports as events."""

    @property
    def busy(self) -> bool:
        """Whether a transfer is active."""
        return self._transfer is not None or self._waiting is not None

    def reset(self) -> None:
        """Drop the active transfer without an answer."""
        self._transfer = None
        self._waiting = None
        self.deadline = None

    def finish(self, deferred: Deferred, refusal: SdoAbortError | None) -> list[bytes]:
        """Answer a download whose result is known; return nothing if the client no longer waits for it."""
        waiting = self._waiting
        if waiting is None or waiting.deferred is not deferred:
            return []
        self._waiting = None
        self.deadline = None
        if refusal is None:
            return waiting.answers
        return [self._abort(refusal.code, waiting.index, waiting.subindex)]

    def tick(self, now: float) -> list[bytes]:
        """Abort a transfer whose client or result has timed out."""
        active = self._transfer or self._waiting
        if active is None or self.deadline is None or now < self.deadline:
            return []
        return [self._abort(AbortCode.TIMEOUT, active.index, active.subindex)]

    def receive(self, data: bytes, now: float) -> list[bytes]:
        """Process the data of one CAN frame and return the data of the answers.

        Parameters
        ----------
        data
            Data of a frame with the COB-ID of requests; a length other than 8 is ignored.
        now
            Current time, s.
        """
        if len(data) != LENGTH:
            return []
        index, subindex = int.from_bytes(data[1:3], "little"), data[3]
        if not self._initiates_transfer(data):
            active = self._transfer or self._waiting
            index, subindex = (0, 0) if active is None else (active.index, active.subindex)
        try:
            answers = self._execute_command(data, index, subindex)
        except SdoAbortError as abort:
            return [self._abort(abort.code, index, subindex)]
        except ProtocolError as error:
            self.faults.append(f"SDO {index:04X}h:{subindex:02X}h: {error}")
            return [self._abort(AbortCode.GENERAL, index, subindex)]
        if self._transfer is not None and self._transfer.done:
            if self._transfer.deferred is not None:
                self._waiting = _Waiting(self._transfer.deferred, [], index, subindex)
            self._transfer = None
        self.deadline = now + self._timeout_s if self.busy else None
        if self._waiting is not None:
            self._waiting.answers, answers = answers, []
            self.deadline = now + RESULT_TIMEOUT_S
        return answers

    def _streaming(self) -> bool:
        return isinstance(self._transfer, BlockDownload) and self._transfer.streaming

    def _initiates_transfer(self, data: bytes) -> bool:
        """Return whether a request initiates a transfer, which replaces the active one."""
        if self._streaming():
            return False
        command = data[0]
        kind = command >> 5
        return kind in {1, 2} or (kind == 5 and command & 0x03 == 0) or (kind == 6 and command & 0x01 == 0)

    def _execute_command(self, data: bytes, index: int, subindex: int) -> list[bytes]:
        command = data[0]
        if command == ABORT or (command >> 5 == 4 and not self._streaming()):
            self._transfer = self._waiting = None
            return []
        if not self._initiates_transfer(data):
            if self._transfer is None:
                raise SdoAbortError(AbortCode.COMMAND, f"0x{command:02X} without a transfer")
            return self._transfer.request(data)
        self._transfer = self._waiting = None
        match command >> 5:
            case 1:
                return self._initiate_download(data, index, subindex)
            case 2:
                return self._initiate_upload(index, subindex, self._dictionary.read(index, subindex))
            case 5:
                return self._initiate_block_upload(data, index, subindex)
            case _:
                return self._initiate_block_download(data, index, subindex)

    def _initiate_download(self, data: bytes, index: int, subindex: int) -> list[bytes]:
        command = data[0]
        if command & 0x02:
            entry = self._dictionary.writable(index, subindex)
            length = 4 - (command >> 2 & 0x03) if command & 0x01 else min(4, entry.size or 4)
            deferred = self._dictionary.write(index, subindex, data[4 : 4 + length])
            if deferred is not None:
                self._waiting = _Waiting(deferred, [], index, subindex)
        else:
            buffer = self._buffer(data, index, subindex, sized=bool(command & 0x01))
            self._transfer = SegmentedDownload(index, subindex, buffer, self._commit(index, subindex))
        return [bytes([0x60]) + data[1:4] + bytes(4)]

    def _initiate_upload(self, index: int, subindex: int, value: bytes) -> list[bytes]:
        multiplexer = index.to_bytes(2, "little") + bytes([subindex])
        if 1 <= len(value) <= 4:
            unused = 4 - len(value)
            return [bytes([0x43 | unused << 2]) + multiplexer + value + bytes(unused)]
        self._transfer = SegmentedUpload(index, subindex, value)
        return [bytes([0x41]) + multiplexer + len(value).to_bytes(4, "little")]

    def _initiate_block_upload(self, data: bytes, index: int, subindex: int) -> list[bytes]:
        value = self._dictionary.read(index, subindex)
        size, threshold = valid_block_size(data[4]), data[5]
        if threshold and len(value) <= threshold:
            return self._initiate_upload(index, subindex, value)
        self._transfer = BlockUpload(index, subindex, value, size, crc=bool(data[0] & 0x04))
        return [bytes([0xC6]) + data[1:4] + len(value).to_bytes(4, "little")]

    def _initiate_block_download(self, data: bytes, index: int, subindex: int) -> list[bytes]:
        buffer = self._buffer(data, index, subindex, sized=bool(data[0] & 0x02))
        commit = self._commit(index, subindex)
        self._transfer = BlockDownload(index, subindex, buffer, commit, crc=bool(data[0] & 0x04))
        return [bytes([0xA4]) + data[1:4] + bytes([MAXIMUM_BLOCK]) + bytes(3)]

    def _buffer(self, data: bytes, index: int, subindex: int, *, sized: bool) -> ReceiveBuffer:
        entry = self._dictionary.writable(index, subindex)
        announced = int.from_bytes(data[4:8], "little") if sized else None
        if announced is not None:
            check_length(entry, announced)
        return ReceiveBuffer(announced, entry.maximum_size if entry.size is None else entry.size)

    def _commit(self, index: int, subindex: int) -> Commit:
        return partial(self._dictionary.write, index, subindex)

    def _abort(self, code: AbortCode, index: int, subindex: int) -> bytes:
        self.reset()
        return bytes([ABORT]) + index.to_bytes(2, "little") + bytes([subindex]) + code.to_bytes(4, "little")
