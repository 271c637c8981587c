"""SDO server: initiates transfers, passes further requests to the active one (CiA 301, SDO)."""

from __future__ import annotations

from typing import Final

from starhil.protocol.canopen.abort import AbortCode, SdoAbortError
from starhil.protocol.canopen.dictionary import Deferred, Dictionary
from starhil.protocol.canopen.sdo_transfer import Answers, Protocol, Transfer
from starhil.protocol.errors import ProtocolError

LENGTH: Final = 8
"""Data bytes of every SDO frame."""
ABORT: Final = 0x80
RESULT_TIMEOUT_S: Final = 30.0
"""Longer than any result takes: an exposure that waits for the previous image takes seconds."""


INITIATE: Final = {
    1: Transfer.download,
    2: Transfer.upload,
    5: Transfer.block_upload,
    6: Transfer.block_download,
}
"""Client command specifier → the transfer that it initiates."""


class SdoServer:
    """Answers the SDO requests of one client (1200h), whose transfer is aborted after a silence of the timeout."""

    def __init__(self, dictionary: Dictionary, timeout_s: float = 1.0) -> None:
        self._dictionary = dictionary
        self._timeout_s = timeout_s
        self._transfer: Transfer | None = None
        """The active transfer, also while its result is awaited."""
        self._protocol: Protocol | None = None
        """Its protocol, which has not ended."""
        self._waiting: Answers | None = None
        """Answers to send when its result is known."""
        self.deadline: float | None = None
        self.faults: list[str] = []
        """Texts of unexpected errors in the application, which the node reports as events."""

    @property
    def busy(self) -> bool:
        """Whether a transfer is active."""
        return self._transfer is not None

    def reset(self) -> None:
        """Drop the active transfer without an answer."""
        self._transfer = self._protocol = self._waiting = None
        self.deadline = None

    def finish(self, deferred: Deferred, refusal: SdoAbortError | None) -> Answers:
        """Answer a download whose result is known; return nothing if the client no longer waits for it."""
        transfer, answers = self._transfer, self._waiting
        if transfer is None or answers is None or transfer.deferred is not deferred:
            return []
        self.reset()
        return answers if refusal is None else [self._abort(refusal.code, transfer.index, transfer.subindex)]

    def tick(self, now: float) -> Answers:
        """Abort a transfer whose client or result has timed out."""
        if self._transfer is None or self.deadline is None or now < self.deadline:
            return []
        return [self._abort(AbortCode.TIMEOUT, self._transfer.index, self._transfer.subindex)]

    def receive(self, data: bytes, now: float) -> Answers:
        """Process the data of one CAN frame and return the data of the answers.

        A length other than 8 is ignored. `now` is the current time, s.
        """
        if len(data) != LENGTH:
            return []
        command = data[0]
        streaming = self._transfer is not None and self._transfer.streaming
        if (command >> 5 == 4 and not streaming) or command == ABORT:
            self.reset()
            return []
        if not streaming and self._initiates_transfer(command):
            index, subindex = int.from_bytes(data[1:3], "little"), data[3]
            self._transfer, self._waiting = Transfer(self._dictionary, index, subindex), None
            self._protocol = INITIATE[command >> 5](self._transfer, data)
            data = b""
        else:
            active = self._transfer
            index, subindex = (0, 0) if active is None else (active.index, active.subindex)
        try:
            answers = self._proceed(command, data)
        except SdoAbortError as abort:
            return [self._abort(abort.code, index, subindex)]
        except ProtocolError as error:
            self.faults.append(f"SDO {index:04X}h:{subindex:02X}h: {error}")
            return [self._abort(AbortCode.GENERAL, index, subindex)]
        if self._waiting is not None:
            self.deadline = now + RESULT_TIMEOUT_S
        else:
            self.deadline = now + self._timeout_s if self.busy else None
        return answers

    @staticmethod
    def _initiates_transfer(command: int) -> bool:
        """Return whether a request initiates a transfer, which replaces the active one."""
        kind = command >> 5
        return kind in {1, 2} or (kind == 5 and command & 0x03 == 0) or (kind == 6 and command & 0x01 == 0)

    def _proceed(self, command: int, data: bytes) -> Answers:
        """Pass a request to the active transfer, or nothing to a new one; return the answers that may be sent."""
        if self._protocol is None or self._transfer is None:
            raise SdoAbortError(AbortCode.COMMAND, f"0x{command:02X} without a transfer")
        try:
            return self._protocol.send(data) if data else next(self._protocol)
        except StopIteration as end:
            self._protocol = None
            answers: Answers = end.value
        if self._transfer.deferred is None:
            self._transfer = None
            return answers
        self._waiting = answers
        return []

    def _abort(self, code: int, index: int, subindex: int) -> bytes:
        self.reset()
        return bytes([ABORT]) + index.to_bytes(2, "little") + bytes([subindex]) + code.to_bytes(4, "little")
