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


async def read_lines(
    reader: asyncio.StreamReader, end: bytes = b"\n", *, within_s: float | None = None
) -> AsyncIterator[bytes | None]:
    """Yield each line until the peer closes; None for a line above the reader's limit, which is dropped.

    Parameters
    ----------
    reader
        Stream of lines.
    end
        Line terminator; one byte if `within_s` is given.
    within_s
        Time within which a line that has begun must be complete, seconds; a peer may be silent between lines. The first
        byte of a line is read apart then and does not count towards the reader's limit.

    Raises
    ------
    TimeoutError
        A line was not complete in time.
    """
    too_long = False
    while True:
        begun = b""
        try:
            if within_s is not None and not too_long:
                begun = await reader.readexactly(1)
            async with asyncio.timeout(within_s):
                line = begun if begun == end else begun + await reader.readuntil(end)
        except asyncio.LimitOverrunError as overrun:
            await reader.readexactly(overrun.consumed)
            too_long = True
            continue
        except asyncio.IncompleteReadError as rest:
            if too_long or begun + rest.partial:
                yield None if too_long else begun + rest.partial
            return
        yield None if too_long else line
        too_long = False
