"""Checks: sum, XOR, Fletcher, CRC and XXH32, each bit by bit or step by step from its definition.

Sources: the Rocksoft model (R. Williams, "A painless guide to CRC error detection algorithms", 1993), whose terms
the CRC catalogues use, the xxHash specification (Y. Collet, doc/xxhash_spec.md), and RFC 1146 (Fletcher). The tests compare with the check
values that the catalogues publish for "123456789" and with `zlib`, `binascii` and the xxHash library.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final, Literal

from starhil.hil_tests.judge.rows import SIZES

WORD: Final = 0xFFFFFFFF


def check_function(model: Any, order: Literal["little", "big"], plugin: Any) -> Callable[[bytes], bytes]:
    """Return the check that a definition selects, as a function from the covered bytes to the bytes sent.

    `order` is the byte order if it has none of its own; `plugin` has the custom checks of the unit by name.
    """
    if model.kind == "none":
        return lambda _covered: b""
    if model.kind == "custom":
        check: Callable[[bytes], bytes] = plugin.checks[model.name]
        return check
    order = model.order or order
    size = {"fletcher16": 2, "xxh32": 4}.get(model.kind) or SIZES[model.type]

    def number(covered: bytes) -> int:
        match model.kind:
            case "sum":
                return _sum(covered, size, model.complement)
            case "xor":
                return _xor(covered, size, model.init, order)
            case "fletcher16":
                return _fletcher(covered, model.modulus)
            case "crc":
                return crc(covered, 8 * size, model.poly, model.init, model.xor, reflect=model.reflect)
            case _:
                return xxh32(covered, model.seed)

    return lambda covered: number(covered).to_bytes(size, order)


def described(model: Any) -> str:
    """Return the name of the check that a definition selects, with its type, and its polynomial or plugin name if it has one."""
    own = f"{model.poly:X}h" if model.kind == "crc" else getattr(model, "name", "")
    return " ".join(filter(None, (model.kind, getattr(model, "type", ""), own)))


def _sum(covered: bytes, size: int, complement: str) -> int:
    total = sum(covered) % (1 << 8 * size)
    return {"none": total, "ones": (1 << 8 * size) - 1 - total, "twos": -total % (1 << 8 * size)}[complement]


def _xor(covered: bytes, size: int, start: int, order: Literal["little", "big"]) -> int:
    """Return the XOR of words in an order; zeros complete the last one."""
    for place in range(0, len(covered), size):
        start ^= int.from_bytes(covered[place : place + size].ljust(size, b"\0"), order)
    return start


def _fletcher(covered: bytes, modulus: int) -> int:
    """Return Fletcher's checksum: a byte counts once in the lower sum, and in the upper as often as bytes are left."""
    lower = sum(covered) % modulus
    upper = sum(byte * (len(covered) - place) for place, byte in enumerate(covered)) % modulus
    return upper * 256 + lower


def crc(data: bytes, bits: int, poly: int, init: int, xor_out: int, *, reflect: bool) -> int:
    """Return a CRC: the register shifts once for each bit of the message, the highest bit first unless reflected."""
    register = init
    for byte in data:
        for place in range(8) if reflect else range(7, -1, -1):
            out = register >> bits - 1 ^ byte >> place & 1
            register = (register << 1 ^ (poly if out else 0)) & (1 << bits) - 1
    if reflect:
        register = sum((register >> place & 1) << bits - 1 - place for place in range(bits))
    return register ^ xor_out


PRIMES: Final = (0x9E3779B1, 0x85EBCA77, 0xC2B2AE3D, 0x27D4EB2F, 0x165667B1)


def _rotated(number: int, count: int) -> int:
    number &= WORD
    return (number << count | number >> 32 - count) & WORD


def xxh32(data: bytes, seed: int) -> int:
    """Return XXH32, in the steps of its specification."""
    one, two, three, four, five = PRIMES
    striped = len(data) // 16 * 16
    if len(data) >= 16:
        lanes = [seed + one + two, seed + two, seed, seed - one]  # step 1
        for start in range(0, striped, 4):  # step 2: four lanes in turn
            word = int.from_bytes(data[start : start + 4], "little")
            lane = start // 4 % 4
            lanes[lane] = _rotated(lanes[lane] + word * two, 13) * one & WORD
        total = sum(_rotated(lane, turn) for lane, turn in zip(lanes, (1, 7, 12, 18), strict=True))  # step 3
    else:
        total = seed + five
    total += len(data)  # step 4
    rest = data[striped:]
    for start in range(0, len(rest) // 4 * 4, 4):  # step 5
        total = _rotated(total + int.from_bytes(rest[start : start + 4], "little") * three, 17) * four
    for byte in rest[len(rest) // 4 * 4 :]:
        total = _rotated(total + byte * five, 11) * one
    total &= WORD
    for shift, prime in ((15, two), (13, three), (16, 1)):  # step 6
        total = (total ^ total >> shift) * prime & WORD
    return total
