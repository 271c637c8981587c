"""Framing by size: a field of the header counts the bytes (`length`), or each row has its own size (`fixed`).

    | start | header … length … | data | check | end |        length
    | start | header | data of the row's size  | check | end |        fixed
      DE AD                                             BE EF        NOS3 (generic_star_tracker_device.c)

Start and end may be empty. There is no escaping: the marks may occur in the body.
"""

from __future__ import annotations

from starhil.hil_tests.judge.framings import Measure, Taken, check_start


class Counted:
    """A body of a known size between marks."""

    def __init__(self, start: list[int], end: list[int]) -> None:
        self.start, self.end = bytes(start), bytes(end)
        self.marks = self.start + self.end or b"\x1f\x7f\xff"

    def encode(self, body: bytes) -> bytes:
        """Return the body between its marks."""
        return self.start + body + self.end

    def take(self, received: bytearray, measure: Measure) -> Taken | None:
        """Remove a message that must begin at once."""
        check_start(received, self.start)
        size = measure(bytes(received[len(self.start) :]))
        if size is None or len(received) < len(self.start) + size + len(self.end):
            return None
        line = bytes(received[: len(self.start) + size + len(self.end)])
        if line[len(self.start) + size :] != self.end:
            raise ValueError(f"no end {self.end.hex()} after {size} bytes")
        del received[: len(line)]
        return Taken(line[len(self.start) : len(self.start) + size])
