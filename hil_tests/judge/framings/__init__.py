"""Framings of the serial line: where a message begins and ends.

A framing writes a body (header, data, check) as bytes on the line, and takes the first message out of what was
received. It takes only what the unit should send: anything else is junk, to the last byte received.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

Measure = Callable[[bytes], int | None]
"""Returns the size of the body that begins with these bytes; None if more are needed, ValueError if none does."""


@dataclass(frozen=True)
class Taken:
    """A message that was taken from the line.

    Attributes
    ----------
    body
        Header, data and check; the bytes themselves if they are junk.
    start
        Start byte, in a framing that has several.
    junk
        Whether the bytes are no message.
    """

    body: bytes
    start: int = 0
    junk: bool = False


class Framing(Protocol):
    """A way to mark messages in a stream of bytes."""

    start: bytes
    """Bytes before a body, which a check may cover and a length may count."""
    end: bytes
    """Bytes after a body, which a length may count."""
    marks: bytes
    """Bytes that are special within a message."""

    def encode(self, body: bytes) -> bytes:
        """Return a body as bytes on the line."""

    def take(self, received: bytearray, measure: Measure) -> Taken | None:
        """Remove the first message; return None if it is incomplete. Raises ValueError if the bytes are none."""


def check_start(received: bytearray, start: bytes) -> None:
    """Raise ValueError unless the bytes begin with a mark, as far as they go."""
    begun = bytes(received[: len(start)])
    if begun != start[: len(begun)]:
        raise ValueError(f"begins with {begun.hex()}, not {start.hex()}")
