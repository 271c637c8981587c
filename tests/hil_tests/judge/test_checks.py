"""The judge's checks against published check values and against libraries that share no code with it."""

from __future__ import annotations

import binascii
import zlib
from types import SimpleNamespace

import pytest
import xxhash
from hypothesis import given
from hypothesis import strategies as st

from starhil.hil_tests.judge.checks import check_function, crc, xxh32

NINE = b"123456789"
CATALOGUE = {  # reveng.sourceforge.io/crc-catalogue: bits, poly, init, reflect, xor, check
    "CRC-8/SMBUS": (8, 0x07, 0x00, False, 0x00, 0xF4),
    "CRC-8/MAXIM-DOW": (8, 0x31, 0x00, True, 0x00, 0xA1),
    "CRC-16/XMODEM": (16, 0x1021, 0x0000, False, 0x0000, 0x31C3),
    "CRC-16/IBM-3740": (16, 0x1021, 0xFFFF, False, 0x0000, 0x29B1),
    "CRC-16/MCRF4XX": (16, 0x1021, 0xFFFF, True, 0x0000, 0x6F91),
    "CRC-16/MODBUS": (16, 0x8005, 0xFFFF, True, 0x0000, 0x4B37),
    "CRC-16/RIELLO": (16, 0x1021, 0xB2AA, True, 0x0000, 0x63D0),
    "CRC-32/ISO-HDLC": (32, 0x04C11DB7, 0xFFFFFFFF, True, 0xFFFFFFFF, 0xCBF43926),
    "CRC-32/BZIP2": (32, 0x04C11DB7, 0xFFFFFFFF, False, 0xFFFFFFFF, 0xFC891918),
    "CRC-64/XZ": (64, 0x42F0E1EBA9EA3693, (1 << 64) - 1, True, (1 << 64) - 1, 0x995DC9BBDF1939FA),
}


@pytest.mark.parametrize("name", CATALOGUE)
def test_crcs_have_the_check_values_of_the_catalogue(name):
    bits, poly, init, reflect, xor, check = CATALOGUE[name]
    assert crc(NINE, bits, poly, init, xor, reflect=reflect) == check


@given(st.binary(max_size=80))
def test_crcs_agree_with_the_standard_library(data):
    assert crc(data, 32, 0x04C11DB7, 0xFFFFFFFF, 0xFFFFFFFF, reflect=True) == zlib.crc32(data)
    assert crc(data, 16, 0x1021, 0, 0, reflect=False) == binascii.crc_hqx(data, 0)


@given(st.binary(max_size=100), st.integers(0, 0xFFFFFFFF))
def test_xxh32_agrees_with_its_reference_implementation(data, seed):
    assert xxh32(data, seed) == xxhash.xxh32_intdigest(data, seed)


def test_xxh32_of_nothing_is_the_published_value():
    assert xxh32(b"", 0) == 0x02CC5D05  # xxHash, tests/sanity_test_vectors.h
    assert xxh32(b"", 0x9E3779B1) == 0x36B78AE7


@pytest.mark.parametrize(
    ("model", "sent"),
    [
        ({"kind": "none"}, ""),
        ({"kind": "sum", "type": "u8", "complement": "none"}, "DD"),
        ({"kind": "sum", "type": "u16", "complement": "none", "order": "big"}, "01DD"),
        ({"kind": "xor", "type": "u16", "init": 0x1234, "order": "little"}, "0D1A"),
        ({"kind": "fletcher16", "modulus": 255, "order": "big"}, "1EDE"),
        ({"kind": "fletcher16", "modulus": 256, "order": "little"}, "DD15"),
        ({"kind": "sum", "type": "u8", "complement": "ones"}, "22"),
        ({"kind": "sum", "type": "u8", "complement": "twos"}, "23"),
        ({"kind": "xor", "type": "u8", "init": 0x0F}, "3E"),
        ({"kind": "crc", "type": "u16", "poly": 0x1021, "init": 0, "reflect": False, "xor": 0}, "C331"),
        ({"kind": "crc", "type": "u16", "poly": 0x1021, "init": 0, "reflect": False, "xor": 0, "order": "big"}, "31C3"),
    ],
    ids=str,
)  # fmt: skip
def test_checks_are_sent_in_their_byte_order(model, sent):
    compute = check_function(SimpleNamespace(**{"order": None, **model}), "little", None)
    assert compute(NINE).hex().upper() == sent
