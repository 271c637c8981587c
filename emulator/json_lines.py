"""JSON objects, one per line, with limited length and without repeated keys."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from typing import Any


class RepeatedKeyError(ValueError):
    """An object has a key twice, so its value is ambiguous."""


def parse_json(line: bytes | str) -> Any:
    """Decode one line.

    Raises
    ------
    RepeatedKeyError
        An object has a key twice; the message names it.
    ValueError, RecursionError
        The line is not JSON.
    """
    return json.loads(line, object_pairs_hook=_without_repeats)


def _without_repeats(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for key, value in pairs:
        if key in values:
            raise RepeatedKeyError(f"key {key!r} is repeated")
        values[key] = value
    return values


async def read_lines(reader: asyncio.StreamReader, end: bytes = b"\n") -> AsyncIterator[bytes | None]:
    """Yield each line until the peer closes; None for a line above the reader's limit, which is dropped.

    `end` is the line terminator.
    """
    too_long = False
    while True:
        try:
            line = await reader.readuntil(end)
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
