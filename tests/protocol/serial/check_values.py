"""Published check values, for the product's checks and for the judge's: of a new kind of check, a row here tests both."""

from __future__ import annotations

from typing import Any, Final

DIGITS: Final = b"123456789"
"""What a check value is of."""

_CRCS: Final = [
    # name, type, poly, init, reflect, xor, check value (catalogue of parametrised CRC algorithms)
    ("CRC-8/SMBUS", "u8", 0x07, 0x00, False, 0x00, "F4"),
    ("CRC-8/MAXIM-DOW", "u8", 0x31, 0x00, True, 0x00, "A1"),
    ("CRC-8/I-432-1", "u8", 0x07, 0x00, False, 0x55, "A1"),
    ("CRC-16/ARC", "u16", 0x8005, 0x0000, True, 0x0000, "BB3D"),
    ("CRC-16/MODBUS", "u16", 0x8005, 0xFFFF, True, 0x0000, "4B37"),
    ("CRC-16/XMODEM", "u16", 0x1021, 0x0000, False, 0x0000, "31C3"),
    ("CRC-16/IBM-3740", "u16", 0x1021, 0xFFFF, False, 0x0000, "29B1"),
    ("CRC-16/KERMIT", "u16", 0x1021, 0x0000, True, 0x0000, "2189"),
    ("CRC-16/MCRF4XX", "u16", 0x1021, 0xFFFF, True, 0x0000, "6F91"),
    ("CRC-16/IBM-SDLC", "u16", 0x1021, 0xFFFF, True, 0xFFFF, "906E"),
    ("CRC-16/RIELLO", "u16", 0x1021, 0xB2AA, True, 0x0000, "63D0"),
    ("CRC-32/ISO-HDLC", "u32", 0x04C11DB7, 0xFFFFFFFF, True, 0xFFFFFFFF, "CBF43926"),
    ("CRC-32/BZIP2", "u32", 0x04C11DB7, 0xFFFFFFFF, False, 0xFFFFFFFF, "FC891918"),
    ("CRC-32/MPEG-2", "u32", 0x04C11DB7, 0xFFFFFFFF, False, 0x00000000, "0376E6E7"),
    ("CRC-32/ISCSI", "u32", 0x1EDC6F41, 0xFFFFFFFF, True, 0xFFFFFFFF, "E3069283"),
    ("CRC-64/ECMA-182", "u64", 0x42F0E1EBA9EA3693, 0, False, 0, "6C40DF5F0B497347"),
    ("CRC-64/XZ", "u64", 0x42F0E1EBA9EA3693, 2**64 - 1, True, 2**64 - 1, "995DC9BBDF1939FA"),
]

CHECK_VALUES: Final[list[tuple[dict[str, Any], str]]] = [
    *(
        (
            {"kind": "crc", "type": size, "poly": poly, "init": init, "reflect": reflect, "xor": xor},
            value,
        )
        for _, size, poly, init, reflect, xor, value in _CRCS
    ),
    ({"kind": "sum"}, "DD"),
    ({"kind": "sum", "type": "u16"}, "01DD"),
    ({"kind": "sum", "complement": "ones"}, "22"),
    ({"kind": "sum", "complement": "twos"}, "23"),
    ({"kind": "xor"}, "31"),
    ({"kind": "xor", "init": 0xFF}, "CE"),
    ({"kind": "xor", "type": "u16"}, "3908"),
    ({"kind": "xor", "type": "u16", "init": 0x1234}, "2B3C"),
    ({"kind": "xor", "type": "u16", "init": 0x1234, "order": "little"}, "0D1A"),
    ({"kind": "crc", "type": "u16", "poly": 0x1021, "order": "little"}, "C331"),
    ({"kind": "fletcher16"}, "1EDE"),
    ({"kind": "fletcher16", "modulus": 256}, "15DD"),
    ({"kind": "fletcher16", "modulus": 256, "order": "little"}, "DD15"),
    ({"kind": "xxh32"}, "937BAD67"),
]
"""Keys of a check, and its value of `DIGITS` as sent, big-endian unless the check has an order."""
