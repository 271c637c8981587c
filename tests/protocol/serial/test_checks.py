"""Checks of messages against published check values."""

from __future__ import annotations

from typing import Any, get_args

import pytest
from pydantic import TypeAdapter

from starhil.protocol.errors import IcdError
from starhil.protocol.icd.link_schema import CheckModel
from starhil.protocol.serial.checks import build_check
from tests.protocol.serial.check_values import CHECK_VALUES, DIGITS

pytestmark = pytest.mark.lowest("xxhash")

ADAPTER: TypeAdapter[Any] = TypeAdapter(CheckModel)


def compute(data: bytes, order: Any = "big", **model: object) -> int:
    return int.from_bytes(build_check(ADAPTER.validate_python(model), order).compute(data), order)


@pytest.mark.parametrize(("model", "sent"), CHECK_VALUES, ids=str)
def test_a_check_has_its_published_value(model: dict[str, Any], sent: str) -> None:
    assert build_check(ADAPTER.validate_python(model), "big").compute(DIGITS).hex().upper() == sent


def test_each_kind_of_check_has_a_published_value() -> None:
    kinds = {get_args(item.model_fields["kind"].annotation)[0] for item in get_args(get_args(CheckModel)[0])}
    assert {model["kind"] for model, _ in CHECK_VALUES} == kinds - {"none", "custom"}


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


def test_value_wider_than_the_check_is_rejected() -> None:
    with pytest.raises(IcdError, match="poly 0x11021 does not fit u16"):
        build_check(ADAPTER.validate_python({"kind": "crc", "type": "u16", "poly": 0x11021}), "little")


def test_an_initial_value_wider_than_the_xor_is_rejected() -> None:
    with pytest.raises(IcdError, match="init 0x1234 does not fit u8"):
        build_check(ADAPTER.validate_python({"kind": "xor", "init": 0x1234}), "little")


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
