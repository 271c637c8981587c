"""Damaged input for decoders."""

from __future__ import annotations

import random


def mutated(seeds: list[bytes], source: random.Random, marks: bytes) -> bytes:
    """One to three seeds in a row, with bytes changed, inserted and left out; `marks` are bytes that a framing uses."""
    data = bytearray(b"".join(source.choices(seeds, k=source.randrange(1, 4))))
    for _ in range(source.randrange(5)):
        place = source.randrange(len(data) + 1)
        match source.randrange(5):
            case 0 if place < len(data):
                data[place] = source.randrange(256)
            case 1:
                data.insert(place, source.choice(marks))
            case 2:
                del data[place : place + source.randrange(1, 9)]
            case 3:
                data[place:place] = source.randbytes(source.randrange(12))
            case _:
                del data[place:]
    return bytes(data)
