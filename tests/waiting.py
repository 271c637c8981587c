"""How tests wait for what has to happen: so long that only what never happens takes longer, whatever else the machine does."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable

PATIENCE_S = 600.0


async def until(condition: Callable[[], object]) -> None:
    """Wait until something is true, while the loop runs."""
    async with asyncio.timeout(PATIENCE_S):
        while not condition():
            await asyncio.sleep(0.005)


async def turns(count: int = 50) -> None:
    """Let the loop do what is due, if there is anything."""
    for _ in range(count):
        await asyncio.sleep(0)


def wait_until(condition: Callable[[], object]) -> None:
    """Wait until something is true."""
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, "it has not happened"
        time.sleep(0.02)
