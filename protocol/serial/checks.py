"""Checks of messages: sum, XOR, cyclic redundancy check and XXH32, as functions from bytes to check bytes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache, reduce
from operator import xor
from typing import Final, assert_never

import xxhash

from starhil.protocol.errors import IcdError
from starhil.protocol.icd.conventions import Order
from starhil.protocol.icd.link_schema import (
    CheckModel,
    CrcCheck,
    CustomCheck,
    FletcherCheck,
    NoCheck,
    SumCheck,
    XorCheck,
    XxHashCheck,
)
from starhil.protocol.icd.values import SCALAR_SIZES

CheckFunction = Callable[[bytes], bytes]


@dataclass(frozen=True)
class Check:
    """A check: its size, what it covers and how it is computed."""

    size: int
    """Bytes of the check."""
    covers: frozenset[str]
    """`start`, `header`, `data`."""
    compute: CheckFunction


NO_CHECK: Final = Check(0, frozenset(), lambda _covered: b"")


def build_check(
    model: CheckModel, byte_order: Order, custom: Mapping[str, CheckFunction] | None = None
) -> Check:
    """Return the check that a definition selects; `custom` holds the plugin's checks by name.

    Raises IcdError: a value does not fit the check's width, or the plugin has no check of that name.
    """
    if isinstance(model, NoCheck):
        return NO_CHECK
    order: Order = model.order or byte_order
    match model:
        case SumCheck():
            compute = _sum_function(SCALAR_SIZES[model.type], model.complement, order)
        case XorCheck():
            compute = _xor_function(SCALAR_SIZES[model.type], model.init, order)
        case FletcherCheck():
            compute = _fletcher_function(model.modulus, order)
        case CrcCheck():
            compute = _crc_function(model, order)
        case XxHashCheck():
            seed = model.seed
            compute = lambda covered: xxhash.xxh32_intdigest(covered, seed).to_bytes(4, order)  # noqa: E731
        case CustomCheck():
            found = (custom or {}).get(model.name)
            if found is None:
                raise IcdError(f"link.serial.check: the plugin has no check named {model.name!r}")
            compute = found
            empty: object = compute(b"")
            if not isinstance(empty, bytes):
                raise IcdError(
                    f"link.serial.check: check {model.name} must return bytes, not {type(empty).__name__}"
                )
        case _:
            assert_never(model)
    return Check(len(compute(b"")), frozenset(model.covers), compute)


def _sum_function(width: int, complement: str, order: Order) -> CheckFunction:
    mask = (1 << 8 * width) - 1

    def compute(covered: bytes) -> bytes:
        total = sum(covered)
        if complement != "none":
            total = ~total + (complement == "twos")
        return (total & mask).to_bytes(width, order)

    return compute


def _xor_function(width: int, initial: int, order: Order) -> CheckFunction:
    if initial >= 1 << 8 * width:
        raise IcdError(f"link.serial.check: init {initial:#x} does not fit u{8 * width}")
    first = initial.to_bytes(width, order)
    # words of either byte order: each byte of the checksum is the XOR of every second byte
    return lambda covered: bytes(reduce(xor, covered[place::width], first[place]) for place in range(width))


def _fletcher_function(modulus: int, order: Order) -> CheckFunction:
    def compute(covered: bytes) -> bytes:
        total = sums = 0
        for byte in covered:
            total = (total + byte) % modulus
            sums = (sums + total) % modulus
        return (sums << 8 | total).to_bytes(2, order)

    return compute


def _crc_function(model: CrcCheck, order: Order) -> CheckFunction:
    width = SCALAR_SIZES[model.type]
    mask = (1 << 8 * width) - 1
    for name, value in (("poly", model.poly), ("init", model.init), ("xor", model.xor)):
        if value > mask:
            raise IcdError(f"link.serial.check: {name} {value:#x} does not fit {model.type}")

    def compute(covered: bytes) -> bytes:
        return crc(
            covered, width=width, poly=model.poly, init=model.init, reflect=model.reflect, xor_out=model.xor
        ).to_bytes(width, order)

    return compute


def crc(data: bytes, *, width: int, poly: int, init: int = 0, reflect: bool = False, xor_out: int = 0) -> int:
    """Return a cyclic redundancy check of `width` bytes; `poly` and `init` in normal notation."""
    table = _crc_table(width, poly, reflect)
    bits = 8 * width
    if reflect:
        register = reversed_bits(init, bits)
        for byte in data:
            register = register >> 8 ^ table[(register ^ byte) & 0xFF]
    else:
        register = init
        shift, mask = bits - 8, (1 << bits) - 1
        for byte in data:
            register = (register << 8 & mask) ^ table[register >> shift ^ byte]
    return register ^ xor_out


@lru_cache(maxsize=16)
def _crc_table(width: int, poly: int, reflect: bool) -> tuple[int, ...]:
    """Return the register after each byte value, from an empty register."""
    bits = 8 * width
    top, mask = 1 << (bits - 1), (1 << bits) - 1
    table = []
    for byte in range(256):
        register = (reversed_bits(byte, 8) if reflect else byte) << (bits - 8)
        for _ in range(8):
            register = (register << 1 ^ poly if register & top else register << 1) & mask
        table.append(reversed_bits(register, bits) if reflect else register)
    return tuple(table)


def reversed_bits(value: int, bits: int) -> int:
    return int(f"{value:0{bits}b}"[::-1], 2)
