"""SDO abort codes of CiA 301 (table "SDO abort codes") and the exception that carries one."""

from __future__ import annotations

from enum import IntEnum
from typing import Final

from starhil.protocol.errors import ProtocolError


class AbortCode(IntEnum):
    """Reasons for which an SDO server may abort a transfer."""

    TOGGLE = 0x05030000
    TIMEOUT = 0x05040000
    COMMAND = 0x05040001
    BLOCK_SIZE = 0x05040002
    SEQUENCE = 0x05040003
    CRC = 0x05040004
    OUT_OF_MEMORY = 0x05040005
    UNSUPPORTED_ACCESS = 0x06010000
    WRITE_ONLY = 0x06010001
    READ_ONLY = 0x06010002
    NO_OBJECT = 0x06020000
    NOT_MAPPABLE = 0x06040041
    PDO_LENGTH = 0x06040042
    INCOMPATIBLE = 0x06040043
    INTERNAL_INCOMPATIBLE = 0x06040047
    HARDWARE = 0x06060000
    LENGTH = 0x06070010
    LENGTH_HIGH = 0x06070012
    LENGTH_LOW = 0x06070013
    NO_SUBINDEX = 0x06090011
    VALUE_RANGE = 0x06090030
    VALUE_HIGH = 0x06090031
    VALUE_LOW = 0x06090032
    MAXIMUM_BELOW_MINIMUM = 0x06090036
    NO_CONNECTION = 0x060A0023
    GENERAL = 0x08000000
    NOT_STORED = 0x08000020
    LOCAL_CONTROL = 0x08000021
    DEVICE_STATE = 0x08000022
    NO_DICTIONARY = 0x08000023
    NO_DATA = 0x08000024


ABORT_TEXTS: Final[dict[AbortCode, str]] = {
    AbortCode.TOGGLE: "toggle bit not alternated",
    AbortCode.TIMEOUT: "SDO protocol timed out",
    AbortCode.COMMAND: "command specifier not valid or unknown",
    AbortCode.BLOCK_SIZE: "invalid block size",
    AbortCode.SEQUENCE: "invalid sequence number",
    AbortCode.CRC: "CRC error",
    AbortCode.OUT_OF_MEMORY: "out of memory",
    AbortCode.UNSUPPORTED_ACCESS: "unsupported access to an object",
    AbortCode.WRITE_ONLY: "attempt to read a write-only object",
    AbortCode.READ_ONLY: "attempt to write a read-only object",
    AbortCode.NO_OBJECT: "object does not exist",
    AbortCode.NOT_MAPPABLE: "object cannot be mapped to the PDO",
    AbortCode.PDO_LENGTH: "number and length of the mapped objects exceed the PDO",
    AbortCode.INCOMPATIBLE: "general parameter incompatibility",
    AbortCode.INTERNAL_INCOMPATIBLE: "general internal incompatibility in the device",
    AbortCode.HARDWARE: "access failed because of a hardware error",
    AbortCode.LENGTH: "length of the service parameter does not match",
    AbortCode.LENGTH_HIGH: "length of the service parameter too high",
    AbortCode.LENGTH_LOW: "length of the service parameter too low",
    AbortCode.NO_SUBINDEX: "sub-index does not exist",
    AbortCode.VALUE_RANGE: "invalid value for the parameter",
    AbortCode.VALUE_HIGH: "value written too high",
    AbortCode.VALUE_LOW: "value written too low",
    AbortCode.MAXIMUM_BELOW_MINIMUM: "maximum value is less than minimum value",
    AbortCode.NO_CONNECTION: "resource not available: SDO connection",
    AbortCode.GENERAL: "general error",
    AbortCode.NOT_STORED: "data cannot be transferred or stored",
    AbortCode.LOCAL_CONTROL: "data cannot be transferred or stored because of local control",
    AbortCode.DEVICE_STATE: "data cannot be transferred or stored in the present device state",
    AbortCode.NO_DICTIONARY: "no object dictionary is present",
    AbortCode.NO_DATA: "no data available",
}
"""Short text of each code."""


class SdoAbortError(ProtocolError):
    """A refused access to the object dictionary, with the SDO abort code."""

    def __init__(self, code: AbortCode, detail: str = "") -> None:
        self.code = code
        text = f"0x{code:08X} {ABORT_TEXTS[code]}"
        super().__init__(f"{text}: {detail}" if detail else text)
