"""Shortening of a life that ends in a violation, to the fewest steps that still show it."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace

from starhil.hil_tests.endurance.life import Life, Step


def kind_of(violation: str) -> str:
    """Return a violation without its numbers, to tell whether two are of the same kind."""
    return re.sub(r"-?\d[\d.e+-]*", "#", violation)


def shortened(life: Life, fails: Callable[[Life], bool], *, attempts: int = 400) -> Life:
    """Return the life with as few steps as possible for which `fails` holds (delta debugging, Zeller 1999).

    At most this many `attempts` are made to live a shorter life.
    """
    left = attempts

    def still_fails(steps: Sequence[Step]) -> bool:
        nonlocal left
        left -= 1
        return fails(replace(life, steps=tuple(steps)))

    steps = list(life.steps)
    size = max(1, len(steps) // 2)
    while left > 0:
        removed = False
        start = 0
        while start < len(steps) and left > 0:
            rest = steps[:start] + steps[start + size :]
            if still_fails(rest):
                steps, removed = rest, True
            else:
                start += size
        if size == 1 and not removed:
            break
        size = max(1, size // 2)
    return replace(life, steps=tuple(steps))
