"""JSON objects, one per line, with limited length, without repeated keys and with finite numbers only."""

from __future__ import annotations

import asyncio
import json
import math
from collections.abc import AsyncIterator
from typing import Any, Final

from starhil.protocol.errors import shortened

TURN: Final = 2048
"""Maximum number of bytes read before other tasks run."""


class JsonError(ValueError):
    """A line is not an unambiguous JSON object; the text is the reason."""


def parse_object(line: bytes | str) -> dict[str, Any]:
    """Decode a JSON object.

    Raises JsonError, also for what Python would accept but no answer can repeat: NaN and infinite numbers.
    """
    try:
        content = json.loads(line, object_pairs_hook=_table)
    except JsonError:
        raise
    except (ValueError, RecursionError):
        content = None
    if not isinstance(content, dict):
        raise JsonError("not a JSON object on one line")
    return content


def _table(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for key, value in pairs:
        if key in values:
            raise JsonError(f"key {shortened(repr(key))} is repeated")
        wrong = _not_finite(value)
        if wrong is not None:
            raise JsonError(f"{shortened(key)}: {wrong!r} is not a finite number")
        values[key] = value
    return values


def _not_finite(value: object) -> float | None:
    """Return the first number in a value that is not finite, apart from tables, which have been checked."""
    if isinstance(value, list):
        return next((wrong for wrong in map(_not_finite, value) if wrong is not None), None)
    return value if isinstance(value, float) and not math.isfinite(value) else None


async def read_lines(
    reader: asyncio.StreamReader, limit: int, end: bytes = b"\n", *, within_s: float | None = None
) -> AsyncIterator[bytes | None]:
    """Yield each line that is not blank until the peer closes; None for a line longer than `limit` bytes, which is dropped.

    A line that has begun must be complete within `within_s` seconds, or TimeoutError is raised; a peer may be silent between
    lines. Other tasks run after each line and after each `TURN` bytes.
    """
    rest, searched, too_long = bytearray(), 0, False
    late_s: float | None = None
    while True:
        async with asyncio.timeout_at(late_s):
            chunk = await reader.read(TURN)
        rest += chunk
        while (at := rest.find(end, searched)) >= 0:
            line = bytes(rest[: at + len(end)])
            del rest[: len(line)]
            blank = not at or line[:at].isspace()
            if too_long or at > limit or not blank:
                yield None if too_long or at > limit else line
                await asyncio.sleep(0)
            searched, too_long, late_s = 0, False, None
        if len(rest) >= limit + len(end):
            del rest[: len(rest) - len(end) + 1]  # which may be the begin of `end`
            too_long = True
        if not chunk:
            if too_long or rest.strip():
                yield None if too_long or len(rest) > limit else bytes(rest)
            return
        searched = max(0, len(rest) - len(end) + 1)
        if within_s is not None and late_s is None and (rest or too_long):
            late_s = asyncio.get_running_loop().time() + within_s
        await asyncio.sleep(0)
