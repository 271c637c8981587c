"""SYNC consumer and producer with the optional counter (CiA 301: 1005h, 1006h, 1019h)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from starhil.protocol.canopen.abort import AbortCode, SdoAbortError
from starhil.protocol.canopen.cob import BIT_30, ID_MASK, check_change
from starhil.protocol.canopen.context import Context
from starhil.protocol.canopen.emergency import EmergencyCode, EmergencyProducer

COB_ID: Final = (0x1005, 0)
PERIOD: Final = (0x1006, 0)
OVERFLOW: Final = (0x1019, 0)
LARGEST_OVERFLOW: Final = 240


class SyncService:
    """Validates SYNC messages, and produces them if bit 30 of 1005h is set.

    `on_sync` is called with the counter of each SYNC, 0 if it carries none.
    """

    def __init__(
        self, context: Context, emergency: EmergencyProducer, on_sync: Callable[[int], None]
    ) -> None:
        self._context = context
        self._emergency = emergency
        self._on_sync = on_sync
        find = context.dictionary.find
        self._cob_id, self._period, self._overflow = find(*COB_ID), find(*PERIOD), find(*OVERFLOW)
        self._cob_id.writer = self._check_cob_id
        self._period.writer = lambda data: self._schedule(
            self._cob_id.number(), int.from_bytes(data, "little")
        )
        self._overflow.writer = self._check_overflow
        self._counter = 0
        self.next_deadline: float | None = None

    @property
    def can_id(self) -> int:
        return self._cob_id.number() & ID_MASK

    def configure(self) -> None:
        """Reset the counter, and produce the first SYNC after one period."""
        self._counter = 0
        self._schedule(self._cob_id.number(), self._period.number())

    def receive(self, data: bytes) -> None:
        """Act on a SYNC; report a wrong length."""
        if not self._context.communicates:
            return
        wrong = len(data) != (1 if self._overflow.number() else 0)
        self._emergency.communication_error(EmergencyCode.SYNC_LENGTH, bytes([len(data)]), active=wrong)
        if not wrong:
            self._on_sync(data[0] if data else 0)

    def tick(self) -> None:
        """Produce a SYNC if one is due, and act on it too."""
        now, deadline = self._context.now, self.next_deadline
        if deadline is None or now < deadline:
            return
        period = self._period.number() * 1e-6
        self.next_deadline = max(deadline + period, now)
        if not self._context.communicates:
            return
        overflow = self._overflow.number()
        if overflow:
            self._counter = self._counter % overflow + 1
        self._context.send(self.can_id, bytes([self._counter]) if overflow else b"")
        self._on_sync(self._counter if overflow else 0)

    def restart_counter(self) -> None:
        """Restart the counter at 1, as after leaving STOPPED."""
        self._counter = 0

    def _schedule(self, cob_id: int, period_us: int) -> None:
        produces = bool(cob_id & BIT_30) and period_us > 0
        self.next_deadline = self._context.now + period_us * 1e-6 if produces else None

    def _check_cob_id(self, data: bytes) -> None:
        old, new = self._cob_id.number(), int.from_bytes(data, "little")
        check_change(old, new, enabled=lambda value: bool(value & BIT_30), always=True)
        self._counter = 0
        self._schedule(new, self._period.number())

    def _check_overflow(self, data: bytes) -> None:
        if data[0] == 1 or data[0] > LARGEST_OVERFLOW:
            raise SdoAbortError(AbortCode.VALUE_RANGE, "synchronous counter overflow is 0 or 2 to 240")
        if self._period.number():
            raise SdoAbortError(AbortCode.DEVICE_STATE, "set 1006h to 0 before changing the counter overflow")
        self._counter = 0
