"""Checks of messages against published check values."""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import TypeAdapter

from starhil.protocol.errors import IcdError
from starhil.protocol.icd.link_schema import CheckModel
from starhil.protocol.serial.checks import build_check

pytestmark = pytest.mark.lowest("xxhash")

DIGITS = b"123456789"
ADAPTER: TypeAdapter[Any] = TypeAdapter(CheckModel)

CATALOGUE = [
    # name, type, poly, init, reflect, xor, check of "123456789" (catalogue of parametrised CRC algorithms)
    ("CRC-8/SMBUS", "u8", 0x07, 0x00, False, 0x00, 0xF4),
    ("CRC-8/MAXIM-DOW", "u8", 0x31, 0x00, True, 0x00, 0xA1),
    ("CRC-8/I-432-1", "u8", 0x07, 0x00, False, 0x55, 0xA1),
    ("CRC-16/ARC", "u16", 0x8005, 0x0000, True, 0x0000, 0xBB3D),
    ("CRC-16/MODBUS", "u16", 0x8005, 0xFFFF, True, 0x0000, 0x4B37),
    ("CRC-16/XMODEM", "u16", 0x1021, 0x0000, False, 0x0000, 0x31C3),
    ("CRC-16/IBM-3740", "u16", 0x1021, 0xFFFF, False, 0x0000, 0x29B1),
    ("CRC-16/KERMIT", "u16", 0x1021, 0x0000, True, 0x0000, 0x2189),
    ("CRC-16/MCRF4XX", "u16", 0x1021, 0xFFFF, True, 0x0000, 0x6F91),
    ("CRC-16/IBM-SDLC", "u16", 0x1021, 0xFFFF, True, 0xFFFF, 0x906E),
    ("CRC-16/RIELLO", "u16", 0x1021, 0xB2AA, True, 0x0000, 0x63D0),
    ("CRC-32/ISO-HDLC", "u32", 0x04C11DB7, 0xFFFFFFFF, True, 0xFFFFFFFF, 0xCBF43926),
    ("CRC-32/BZIP2", "u32", 0x04C11DB7, 0xFFFFFFFF, False, 0xFFFFFFFF, 0xFC891918),
    ("CRC-32/MPEG-2", "u32", 0x04C11DB7, 0xFFFFFFFF, False, 0x00000000, 0x0376E6E7),
    ("CRC-32/ISCSI", "u32", 0x1EDC6F41, 0xFFFFFFFF, True, 0xFFFFFFFF, 0xE3069283),
    ("CRC-64/ECMA-182", "u64", 0x42F0E1EBA9EA3693, 0, False, 0, 0x6C40DF5F0B497347),
    ("CRC-64/XZ", "u64", 0x42F0E1EBA9EA3693, 2**64 - 1, True, 2**64 - 1, 0x995DC9BBDF1939FA),
]


def compute(data: bytes, order: Any = "big", **model: object) -> int:
    return int.from_bytes(build_check(ADAPTER.validate_python(model), order).compute(data), order)


@pytest.mark.parametrize("entry", CATALOGUE, ids=lambda entry: entry[0])
def test_crc_gives_the_check_value_of_the_catalogue(entry: tuple[str, str, int, int, bool, int, int]) -> None:
    _, size, poly, init, reflect, xor, expected = entry
    found = compute(DIGITS, kind="crc", type=size, poly=poly, init=init, reflect=reflect, xor=xor)
    assert found == expected


@pytest.mark.parametrize(
    ("data", "seed", "expected"),
    [
        (b"", 0, 0x02CC5D05),
        (b"", 0x9E3779B1, 0x36B78AE7),
        (b"abc", 0, 0x32D153FF),
        (b"Nobody inspects the spammish repetition", 0, 0xE2293B2F),
    ],
)
def test_xxh32_gives_the_published_vectors(data: bytes, seed: int, expected: int) -> None:
    assert compute(data, kind="xxh32", seed=seed) == expected


@pytest.mark.parametrize(
    ("model", "expected"),
    [
        ({"kind": "sum"}, 0xDD),
        ({"kind": "sum", "type": "u16"}, 0x01DD),
        ({"kind": "sum", "complement": "ones"}, 0x22),
        ({"kind": "sum", "complement": "twos"}, 0x23),
        ({"kind": "xor"}, 0x31),
        ({"kind": "xor", "init": 0xFF}, 0xCE),
        ({"kind": "xor", "type": "u16"}, 0x3908),
        ({"kind": "xor", "type": "u16", "init": 0x1234}, 0x2B3C),
        ({"kind": "fletcher16"}, 0x1EDE),
        ({"kind": "fletcher16", "modulus": 256}, 0x15DD),
    ],
)
def test_sum_xor_and_fletcher_of_the_digits(model: dict[str, object], expected: int) -> None:
    assert compute(DIGITS, **model) == expected


def test_the_byte_order_of_the_check_overrides_the_unit_s() -> None:
    model = {"kind": "crc", "type": "u16", "poly": 0x1021, "order": "big"}
    assert build_check(ADAPTER.validate_python(model), "little").compute(DIGITS) == bytes.fromhex("31C3")


def test_value_wider_than_the_check_is_rejected() -> None:
    with pytest.raises(IcdError, match="poly 0x11021 does not fit u16"):
        build_check(ADAPTER.validate_python({"kind": "crc", "type": "u16", "poly": 0x11021}), "little")


def test_the_words_of_an_xor_are_in_the_order_of_the_check() -> None:
    model = {"kind": "xor", "type": "u16", "init": 0x1234}
    assert build_check(ADAPTER.validate_python(model), "little").compute(DIGITS) == bytes.fromhex("0D1A")
    with pytest.raises(IcdError, match="init 0x1234 does not fit u8"):
        build_check(ADAPTER.validate_python(model | {"type": "u8"}), "little")


@pytest.mark.parametrize(
    ("text", "expected"), [(b"abcde", 0xC8F0), (b"abcdef", 0x2057), (b"abcdefgh", 0x0627)]
)
def test_fletcher_gives_the_published_vectors(text: bytes, expected: int) -> None:
    assert compute(text, kind="fletcher16") == expected


def test_check_of_a_plugin_is_found_by_name() -> None:
    model = ADAPTER.validate_python({"kind": "custom", "name": "length"})
    check = build_check(model, "little", {"length": lambda covered: bytes((len(covered),))})
    assert (check.size, check.compute(DIGITS)) == (1, b"\x09")
    with pytest.raises(IcdError, match="no check named 'length'"):
        build_check(model, "little")
