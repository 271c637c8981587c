"""Byte stuffing without an end mark: the bytes of a range are sent as two (Hyperion ST200, libgs hyp_st200.c).

    | start | body, E to E | M as E and its bits in M |          escape E, mask M
      F1      41 F0 00 7F F0 03  (the body 41 F0 7F F3)           F0        0F

The header byte is not stuffed; the size is that of the row, or given by the header.
"""

from __future__ import annotations

from typing import Any

from starhil.hil_tests.judge.framings import Measure, Taken, check_start


class Stuffed:
    """`start`, the stuffed body of a known size, `end`."""

    def __init__(self, model: Any) -> None:
        self.start, self.end = bytes(model.start), bytes(model.end)
        escape, mask = model.stuffing.escape, model.stuffing.mask
        self._pairs = {
            byte: bytes((escape, byte & mask)) for byte in range(256) if byte | mask == escape | mask
        }
        self._originals = {pair: byte for byte, pair in self._pairs.items()}
        self._escape = escape
        self.marks = self.start + bytes((escape, escape | mask)) + self.end

    def encode(self, body: bytes) -> bytes:
        """Return the stuffed body between its marks."""
        return self.start + b"".join(self._pairs.get(byte, bytes((byte,))) for byte in body) + self.end

    def take(self, received: bytearray, measure: Measure) -> Taken | None:
        """Remove a message that must begin at once; a byte of the range that is not stuffed makes it junk."""
        check_start(received, self.start)
        body, position = bytearray(), len(self.start)
        while True:
            size = measure(bytes(body))
            if size is not None and len(body) >= size:
                break
            pair = bytes(received[position : position + 2])
            if not pair or (pair[0] == self._escape and len(pair) < 2):
                return None
            if pair in self._originals:
                body.append(self._originals[pair])
                position += 2
            elif pair[0] in self._pairs:
                raise ValueError(f"{pair[0]:02x} is not stuffed")
            else:
                body.append(pair[0])
                position += 1
        whole = position + len(self.end)
        if len(received) < whole:
            return None
        if bytes(received[position:whole]) != self.end:
            raise ValueError(f"no end {self.end.hex()} after {size} bytes")
        del received[:whole]
        return Taken(bytes(body))
