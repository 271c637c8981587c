"""The judge's checks against published check values and against libraries that share no code with it."""

from __future__ import annotations

import binascii
import zlib

import pytest
import xxhash
from hypothesis import given
from hypothesis import strategies as st
from pydantic import TypeAdapter

from starhil.hil_tests.judge.checks import check_function, crc, xxh32
from starhil.protocol.icd.link_schema import CheckModel
from tests.protocol.serial.check_values import CHECK_VALUES, DIGITS

MODELS = TypeAdapter(CheckModel)


@pytest.mark.parametrize(("model", "sent"), CHECK_VALUES, ids=str)
def test_a_check_has_its_published_value(model, sent):
    compute = check_function(MODELS.validate_python(model), "big", None)
    assert compute(DIGITS).hex().upper() == sent


def test_no_check_is_empty():
    assert check_function(MODELS.validate_python({"kind": "none"}), "big", None)(DIGITS) == b""


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
