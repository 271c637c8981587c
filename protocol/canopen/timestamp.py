"""TIME consumer: receives the time of day from the master (CiA 301: 1012h, TIME_OF_DAY)."""

from __future__ import annotations

from typing import Final

from starhil.protocol.canopen.abort import AbortCode, SdoAbortError
from starhil.protocol.canopen.cob import BIT_30, ID_MASK, check_change
from starhil.protocol.canopen.context import Context, EventKind

COB_ID: Final = (0x1012, 0)
CONSUMER_BIT: Final = 1 << 31
EPOCH_UNIX_S: Final = 441_763_200
"""1984-01-01T00:00:00 UTC, day 0 of TIME_OF_DAY, in Unix time."""
DAY_S: Final = 86_400
DAY_MS: Final = 86_400_000


def decode_time_of_day(data: bytes) -> float | None:
    """Return the Unix time, s, of a TIME_OF_DAY (28 bits of milliseconds, 16 bits of days), or None."""
    if len(data) != 6:
        return None
    milliseconds = int.from_bytes(data[:4], "little") & 0x0FFFFFFF
    if milliseconds >= DAY_MS:
        return None
    return EPOCH_UNIX_S + int.from_bytes(data[4:], "little") * DAY_S + milliseconds / 1000


class TimeConsumer:
    """Reports each TIME message as an event whose value is the Unix time in s."""

    def __init__(self, context: Context) -> None:
        self._context = context
        self._cob_id = context.dictionary.find(*COB_ID)
        self._cob_id.writer = self._check_cob_id

    @property
    def can_id(self) -> int | None:
        """CAN ID of the TIME message, None while it is not consumed."""
        value = self._cob_id.number()
        return value & ID_MASK if value & CONSUMER_BIT else None

    def receive(self, data: bytes) -> None:
        """Process a TIME message; ignore one that is not a valid time of day."""
        unix_s = decode_time_of_day(data)
        if unix_s is not None and self._context.communicates:
            self._context.report(EventKind.TIME, unix_s)

    def _check_cob_id(self, data: bytes) -> None:
        old, new = self._cob_id.number(), int.from_bytes(data, "little")
        if new & BIT_30:
            raise SdoAbortError(AbortCode.VALUE_RANGE, "this node does not produce TIME messages")
        check_change(old, new, enabled=lambda value: bool(value & CONSUMER_BIT), always=True)
