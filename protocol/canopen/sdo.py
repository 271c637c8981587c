"""SDO server: initiates transfers, passes further requests to the active one (CiA 301, SDO)."""

from __future__ import annotations

import struct
from typing import Final

from starhil.protocol.canopen.abort import AbortCode, SdoAbortError
from starhil.protocol.canopen.cob import SDO_TRANSMIT
from starhil.protocol.canopen.context import Context, EventKind
from starhil.protocol.canopen.dictionary import Deferred
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

    def __init__(self, context: Context, timeout_s: float) -> None:
        self._context = context
        self._timeout_s = timeout_s
        self._transfer: Transfer | None = None
        """The active transfer, also while its result is awaited."""
        self._protocol: Protocol | None = None
        """Its protocol, which has not ended."""
        self._waiting: Answers | None = None
        """Answers to send when its result is known."""
        self.next_deadline: float | None = None

    @property
    def busy(self) -> bool:
        return self._transfer is not None

    def reset(self) -> None:
        """Drop the active transfer without an answer."""
        self._transfer = self._protocol = self._waiting = None
        self.next_deadline = None

    def finish(self, deferred: Deferred, refusal: SdoAbortError | None) -> None:
        """Answer a download whose result is known, unless the client no longer waits for it."""
        transfer, answers = self._transfer, self._waiting
        if transfer is None or answers is None or transfer.deferred is not deferred:
            return
        if refusal is None:
            self.reset()
            self._send(answers)
        else:
            self._abort(refusal.code, transfer.index, transfer.subindex)

    def tick(self) -> None:
        """Abort a transfer whose client or result has timed out."""
        due = self.next_deadline is not None and self._context.now >= self.next_deadline
        if due and self._transfer is not None:
            self._abort(AbortCode.TIMEOUT, self._transfer.index, self._transfer.subindex)

    def receive(self, data: bytes) -> None:
        """Process the data of a CAN frame; ignore any length other than 8."""
        if len(data) != LENGTH or not self._context.communicates:
            return
        command = data[0]
        streaming = self._transfer is not None and self._transfer.streaming
        if (command >> 5 == 4 and not streaming) or command == ABORT:
            self.reset()
            return
        if not streaming and self._initiates_transfer(command):
            index, subindex = int.from_bytes(data[1:3], "little"), data[3]
            self._transfer, self._waiting = Transfer(self._context.dictionary, index, subindex), None
            self._protocol = INITIATE[command >> 5](self._transfer, data)
            data = b""
        else:
            active = self._transfer
            index, subindex = (0, 0) if active is None else (active.index, active.subindex)
        try:
            answers = self._proceed(command, data)
        except SdoAbortError as abort:
            self._abort(abort.code, index, subindex)
            return
        except ProtocolError as error:
            self._context.report(EventKind.FAULT, detail=f"SDO {index:04X}h:{subindex:02X}h: {error}")
            self._abort(AbortCode.GENERAL, index, subindex)
            return
        patience_s = self._timeout_s if self._waiting is None else RESULT_TIMEOUT_S
        self.next_deadline = self._context.now + patience_s if self.busy else None
        self._send(answers)

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

    def _abort(self, code: int, index: int, subindex: int) -> None:
        self.reset()
        self._send([struct.pack("<BHBI", ABORT, index, subindex, code)])

    def _send(self, answers: Answers) -> None:
        for data in answers:
            self._context.send(SDO_TRANSMIT + self._context.node_id, data)
