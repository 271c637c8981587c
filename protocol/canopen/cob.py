"""COB-IDs: the communication object identifiers of CiA 301 and the rules for configuring them."""

from __future__ import annotations

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
"""The 29-bit frame format; this slave speaks the base format only."""
ID_MASK: Final = 0x1FFFFFFF

RESTRICTED: Final = (
    (0x000, 0x07F),
    (0x101, 0x180),
    (0x581, 0x5FF),
    (0x601, 0x67F),
    (0x6E0, 0x6FF),
    (0x701, 0x7FF),
)
"""Identifiers, first and last, that no configurable communication object may use (CiA 301, restricted CAN-IDs)."""


def check_identifier(cob_id: int) -> None:
    """Refuse a COB-ID whose frame format or identifier a configurable object may not have.

    Raises
    ------
    SdoAbortError
        VALUE_RANGE for the extended frame format, an identifier over 11 bits or a restricted one.
    """
    identifier = cob_id & ID_MASK
    if cob_id & EXTENDED or identifier > 0x7FF:
        raise SdoAbortError(AbortCode.VALUE_RANGE, f"COB-ID 0x{cob_id:08X} is not an 11-bit identifier")
    if any(first <= identifier <= last for first, last in RESTRICTED):
        raise SdoAbortError(AbortCode.VALUE_RANGE, f"identifier 0x{identifier:03X} is restricted")


def check_replacement(old: int, new: int, *, lives_before: bool, lives_after: bool) -> None:
    """Refuse a change of identifier (32-bit COB-ID entries) of an object that exists before and after."""
    if lives_before and lives_after and (old ^ new) & (ID_MASK | EXTENDED):
        raise SdoAbortError(
            AbortCode.VALUE_RANGE, "disable the communication object before changing its identifier"
        )
