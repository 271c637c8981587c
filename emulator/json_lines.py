"""Objects that arrive as JSON, one a line: lines of bounded length, and no key given twice."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from typing import Any


class RepeatedKeyError(ValueError):
    """An object gives a key twice, so that it is open which value counts."""


def parse_json(line: bytes | str) -> Any:
    """Decode one line.

    Raises
    ------
    RepeatedKeyError
        A key stands in an object twice; the text names it.
    ValueError, RecursionError
        The line is not JSON.
    """
    return json.loads(line, object_pairs_hook=_without_repeats)


def _without_repeats(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for key, value in pairs:
        if key in values:
            raise RepeatedKeyError(f"key {key!r} is given twice")
        values[key] = value
    return values


async def read_lines(reader: asyncio.StreamReader) -> AsyncIterator[bytes | None]:
    """Yield each line until the peer hangs up; None stands for a line longer than the reader's limit, which is dropped."""
    too_long = False
    while True:
        try:
            line = await reader.readuntil(b"\n")
        except asyncio.LimitOverrunError as overrun:
            await reader.readexactly(overrun.consumed)
            too_long = True
            continue
        except asyncio.IncompleteReadError as end:
            if too_long or end.partial:
                yield None if too_long else end.partial
            return
        yield None if too_long else line
        too_long = False
