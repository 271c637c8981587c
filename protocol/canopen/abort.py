"""SDO abort codes of CiA 301, whose texts are those of `canopen`, and the exception that carries one."""

from __future__ import annotations

from enum import IntEnum
from typing import Final

from canopen import SdoAbortedError

from starhil.protocol.errors import ProtocolError
from starhil.protocol.messages import ErrorCode


class AbortCode(IntEnum):
    """Reasons for which this node aborts a transfer, or which are published as errors of a row."""

    TOGGLE = 0x05030000
    TIMEOUT = 0x05040000
    COMMAND = 0x05040001
    BLOCK_SIZE = 0x05040002
    SEQUENCE = 0x05040003
    CRC = 0x05040004
    UNSUPPORTED_ACCESS = 0x06010000
    WRITE_ONLY = 0x06010001
    READ_ONLY = 0x06010002
    NO_OBJECT = 0x06020000
    NOT_MAPPABLE = 0x06040041
    PDO_LENGTH = 0x06040042
    INCOMPATIBLE = 0x06040043
    HARDWARE = 0x06060000
    LENGTH = 0x06070010
    LENGTH_HIGH = 0x06070012
    LENGTH_LOW = 0x06070013
    NO_SUBINDEX = 0x06090011
    VALUE_RANGE = 0x06090030
    VALUE_HIGH = 0x06090031
    VALUE_LOW = 0x06090032
    GENERAL = 0x08000000
    NOT_STORED = 0x08000020
    DEVICE_STATE = 0x08000022
    NO_DATA = 0x08000024


ABORTS: Final = {
    ErrorCode.INVALID_ID: (AbortCode.NO_OBJECT, AbortCode.NO_SUBINDEX),
    ErrorCode.INVALID_LENGTH: (AbortCode.LENGTH, AbortCode.LENGTH_HIGH, AbortCode.LENGTH_LOW),
    ErrorCode.INVALID_PARAMETER: (AbortCode.VALUE_RANGE, AbortCode.VALUE_HIGH, AbortCode.VALUE_LOW),
    ErrorCode.NOT_IMPLEMENTED: (AbortCode.UNSUPPORTED_ACCESS,),
    ErrorCode.BUSY: (AbortCode.DEVICE_STATE,),
    ErrorCode.SEQUENCE: (AbortCode.DEVICE_STATE,),
}
"""Abort codes of each published error code, of which the node sends the first."""


def error_of(abort: int) -> ErrorCode:
    """Return the first published error code that has an abort code; internal error if none has it."""
    return next((error for error, aborts in ABORTS.items() if abort in aborts), ErrorCode.INTERNAL)


class SdoAbortError(ProtocolError):
    """A refused access to the object dictionary, with the SDO abort code, which may be one that this node never sends."""

    def __init__(self, code: int, detail: str = "") -> None:
        self.code = code
        text = f"0x{code:08X} {SdoAbortedError.CODES.get(code, 'unknown')}"
        super().__init__(f"{text}: {detail}" if detail else text)
