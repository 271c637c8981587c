"""JSON objects, one per line, with limited length and without repeated keys."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from typing import Any

from starhil.protocol.errors import shortened


class RepeatedKeyError(ValueError):
    """An object has a key twice, so its value is ambiguous."""


def parse_json(line: bytes | str) -> Any:
    """Decode one line; RepeatedKeyError names a repeated key, ValueError and RecursionError mean that it is not JSON."""
    return json.loads(line, object_pairs_hook=_without_repeats)


def _without_repeats(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    values = dict(pairs)
    if len(values) < len(pairs):
        seen: set[str] = set()
        for key, _ in pairs:
            if key in seen:
                raise RepeatedKeyError(f"key {shortened(repr(key))} is repeated")
            seen.add(key)
    return values


async def read_lines(
    reader: asyncio.StreamReader, end: bytes = b"\n", *, within_s: float | None = None
) -> AsyncIterator[bytes | None]:
    """Yield each line until the peer closes; None for a line above the reader's limit, which is dropped.

    A line that has begun must be complete within `within_s` seconds, or TimeoutError is raised; a peer may be silent between
    lines. The terminator is then one byte, and the first byte of a line does not count towards the reader's limit.
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
        await asyncio.sleep(0)  # many lines may have arrived at once: other tasks run in between
