"""Framing by delimiters, as bytes or as hexadecimal digits (the form of NMEA 0183 sentences).

| start | body, in which `end` does not occur | end |        binary
| start | two digits 0-9, A-F for each byte   | end |        hex
"""

from __future__ import annotations

from typing import Any

from starhil.hil_tests.judge.framings import Measure, Taken, check_start


class Delimited:
    """`start`, the body, `end`."""

    def __init__(self, model: Any) -> None:
        self.start, self.end = bytes(model.start), bytes(model.end)
        self._hex = model.encoding == "hex"
        self.marks = self.start + self.end

    def encode(self, body: bytes) -> bytes:
        text = "".join(f"{byte:02X}" for byte in body).encode() if self._hex else body
        return self.start + text + self.end

    def take(self, received: bytearray, measure: Measure) -> Taken | None:  # noqa: ARG002 -- the end is marked
        """Remove a message that must begin at once."""
        check_start(received, self.start)
        end = received.find(self.end, len(self.start))
        if end < 0:
            return None
        text = bytes(received[len(self.start) : end])
        del received[: end + len(self.end)]
        if not self._hex:
            return Taken(text)
        digits = text.decode("latin-1")
        if len(text) % 2 or any(digit not in "0123456789ABCDEF" for digit in digits):
            return Taken(text, junk=True)
        return Taken(bytes(int(digits[place : place + 2], 16) for place in range(0, len(digits), 2)))
