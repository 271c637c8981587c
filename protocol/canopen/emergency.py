"""Emergency producer: error register, error history, EMCY messages (CiA 301, EMCY)."""

from __future__ import annotations

from collections import deque
from enum import IntEnum, IntFlag
from functools import partial
from typing import Final

import construct

from starhil.protocol.canopen.abort import AbortCode, SdoAbortError
from starhil.protocol.canopen.cob import ID_MASK, check_change, exists
from starhil.protocol.canopen.context import Context, EventKind

ERROR_REGISTER: Final = (0x1001, 0)
HISTORY: Final = 0x1003
COB_ID: Final = (0x1014, 0)
INHIBIT: Final = (0x1015, 0)
INHIBIT_UNIT_S: Final = 1e-4
LONGEST_QUEUE: Final = 32
"""Maximum number of messages that wait for the inhibit time; one more drops the oldest."""


MESSAGE: Final = construct.Struct(
    "code" / construct.Int16ul,
    "register" / construct.Int8ul,
    "data" / construct.Padded(5, construct.GreedyBytes),
)
"""The 8 bytes of an EMCY message: error code, error register, manufacturer-specific bytes."""


class EmergencyCode(IntEnum):
    """EMCY error codes of the communication profile."""

    RESET = 0x0000
    GENERIC = 0x1000
    COMMUNICATION = 0x8100
    CAN_OVERRUN = 0x8110
    CAN_PASSIVE = 0x8120
    HEARTBEAT = 0x8130
    BUS_OFF_RECOVERED = 0x8140
    PROTOCOL = 0x8200
    PDO_LENGTH_LOW = 0x8210
    PDO_LENGTH_HIGH = 0x8220
    SYNC_LENGTH = 0x8240
    RPDO_TIMEOUT = 0x8250


class ErrorRegister(IntFlag):
    """Bits of the error register 1001h."""

    GENERIC = 0x01
    CURRENT = 0x02
    VOLTAGE = 0x04
    TEMPERATURE = 0x08
    COMMUNICATION = 0x10
    PROFILE = 0x20
    MANUFACTURER = 0x80


class EmergencyProducer:
    """Keeps the active errors and sends a message for each that is raised or cleared."""

    def __init__(self, context: Context) -> None:
        self._context = context
        dictionary = context.dictionary
        self._register = dictionary.find(*ERROR_REGISTER)
        self._cob_id = dictionary.find(*COB_ID)
        self._inhibit = dictionary.find(*INHIBIT)
        self._count = dictionary.find(HISTORY, 0)
        self._capacity = max(subindex for index, subindex in dictionary.entries if index == HISTORY)
        self._active: dict[tuple[int, bytes], int] = {}
        self._history: list[int] = []
        self._queue: deque[bytes] = deque(maxlen=LONGEST_QUEUE)
        self._free_at = 0.0
        self._cob_id.writer = self._check_cob_id
        self._count.reader = lambda: bytes([len(self._history)])
        self._count.writer = self._clear_history
        for subindex in range(1, self._capacity + 1):
            dictionary.find(HISTORY, subindex).reader = partial(self._read_history, subindex - 1)
        self._register.reader = lambda: bytes([self._register_bits()])

    def reset(self, *, application: bool) -> None:
        """Clear the queue and the communication errors.

        With `application`, all errors and the history.
        """
        self._queue.clear()
        self._free_at = 0.0
        for error, bits in list(self._active.items()):
            if application or bits & ErrorRegister.COMMUNICATION:
                del self._active[error]
        if application:
            self._history.clear()

    def raise_error(self, code: int, bits: int, data: bytes = b"", *, key: bytes = b"") -> None:
        """Report an error unless it is already active.

        `bits` are set in the error register, besides the generic one; `data` are up to 5 manufacturer-specific bytes;
        `key` distinguishes errors with the same code: a PDO number, a node ID.
        """
        if (code, key) in self._active:
            return
        self._active[code, key] = bits | ErrorRegister.GENERIC
        self._history.insert(0, code | int.from_bytes(data[:2].ljust(2, b"\0"), "little") << 16)
        del self._history[self._capacity :]
        self._context.report(EventKind.EMERGENCY, code, f"error 0x{code:04X} data {data.hex() or '-'}")
        self._enqueue(code, data)

    def communication_error(
        self, code: EmergencyCode, data: bytes = b"", *, key: bytes = b"", active: bool = True
    ) -> None:
        if active:
            self.raise_error(code, ErrorRegister.COMMUNICATION, data, key=key)
        else:
            self.clear_error(code, key=key)

    def clear_error(self, code: int, *, key: bytes = b"") -> None:
        """Report a cleared error: code 0, and its code in the manufacturer-specific bytes."""
        if self._active.pop((code, key), None) is None:
            return
        self._context.report(EventKind.EMERGENCY, 0, f"error 0x{code:04X} gone")
        self._enqueue(EmergencyCode.RESET, code.to_bytes(2, "little"))

    @property
    def next_deadline(self) -> float | None:
        """When the next waiting message may be sent."""
        return self._free_at if self._queue and self._context.communicates else None

    def tick(self) -> None:
        """Send waiting messages, as state and inhibit time allow."""
        while self._queue and self._context.communicates and self._context.now >= self._free_at:
            message = self._queue.popleft()
            if exists(self._cob_id.number()):
                self._context.send(self._cob_id.number() & ID_MASK, message)
                self._free_at = self._context.now + self._inhibit.number() * INHIBIT_UNIT_S

    def _register_bits(self) -> int:
        register = 0
        for bits in self._active.values():
            register |= bits
        return register

    def _enqueue(self, code: int, data: bytes) -> None:
        fields = {"code": code, "register": self._register_bits(), "data": data[:5]}
        self._queue.append(MESSAGE.build(fields))
        self.tick()

    def _read_history(self, position: int) -> bytes:
        if position >= len(self._history):
            raise SdoAbortError(AbortCode.NO_DATA, f"{len(self._history)} errors in the history")
        return self._history[position].to_bytes(4, "little")

    def _clear_history(self, data: bytes) -> None:
        if data != b"\0":
            raise SdoAbortError(AbortCode.VALUE_RANGE, "the error history accepts only 0")
        self._history.clear()

    def _check_cob_id(self, data: bytes) -> None:
        check_change(self._cob_id.number(), int.from_bytes(data, "little"), enabled=exists)
