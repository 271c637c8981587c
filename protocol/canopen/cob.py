"""COB-IDs of CiA 301: predefined CAN IDs, flags, and the rules for changing them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from starhil.protocol.canopen.abort import AbortCode, SdoAbortError

NMT: Final = 0x000
SYNC: Final = 0x080
EMERGENCY: Final = 0x080
TIME: Final = 0x100
SDO_TRANSMIT: Final = 0x580
SDO_RECEIVE: Final = 0x600
ERROR_CONTROL: Final = 0x700
LSS_SLAVE: Final = 0x7E4
LSS_MASTER: Final = 0x7E5

INVALID: Final = 1 << 31
"""PDO and EMCY: the communication object does not exist."""
BIT_30: Final = 1 << 30
"""PDO: no RTR allowed; SYNC and TIME: the device produces the message."""
EXTENDED: Final = 1 << 29
"""29-bit CAN ID; this slave uses 11-bit CAN IDs only."""
ID_MASK: Final = 0x1FFFFFFF

RESTRICTED_IDS: Final = (
    (0x000, 0x07F),
    (0x101, 0x180),
    (0x581, 0x5FF),
    (0x601, 0x67F),
    (0x6E0, 0x6FF),
    (0x701, 0x7FF),
)
"""CAN IDs, first and last, that no configurable communication object may use (CiA 301, restricted
CAN-IDs)."""


def check_can_id(cob_id: int) -> None:
    """Reject a COB-ID whose frame format or CAN ID a configurable object may not have.

    Raises SdoAbortError: VALUE_RANGE for the extended frame format, a CAN ID over 11 bits or a restricted one.
    """
    can_id = cob_id & ID_MASK
    if cob_id & EXTENDED or can_id > 0x7FF:
        raise SdoAbortError(AbortCode.VALUE_RANGE, f"COB-ID 0x{cob_id:08X} has no 11-bit CAN ID")
    if any(first <= can_id <= last for first, last in RESTRICTED_IDS):
        raise SdoAbortError(AbortCode.VALUE_RANGE, f"CAN ID 0x{can_id:03X} is restricted")


def check_change(old: int, new: int, *, enabled: Callable[[int], bool], always: bool = False) -> None:
    """Reject a change of the CAN ID of a communication object that stays enabled, and an ID that it may not have.

    The ID of an object that is not enabled is free, unless it is checked `always`.
    """
    if always or enabled(new):
        check_can_id(new)
    if enabled(old) and enabled(new) and (old ^ new) & (ID_MASK | EXTENDED):
        raise SdoAbortError(
            AbortCode.VALUE_RANGE, "disable the communication object before changing its CAN ID"
        )


def exists(cob_id: int) -> bool:
    """Return whether a PDO or EMCY with this COB-ID exists."""
    return not cob_id & INVALID
