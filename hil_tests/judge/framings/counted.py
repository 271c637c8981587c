"""Framing by size: a field of the header counts the bytes (`length`), or each row has its own size (`fixed`).

    | start | header … length … | data | check | end |        length
    | start | header | data of the row's size  | check | end |        fixed
      DE AD                                             BE EF        NOS3 (generic_star_tracker_device.c)

Start and end may be empty. There is no escaping, so that the marks may occur in the body, but the bytes of a range may
be stuffed, each sent as two (Hyperion ST200, libgs hyp_st200.c); the size counts them before:

    | start | body, E to E | M as E and its bits in M |          escape E, mask M
      F1      41 F0 00 7F F0 03  (the body 41 F0 7F F3)           F0        0F
"""

from __future__ import annotations

from typing import Any

from starhil.hil_tests.judge.framings import Measure, Taken, check_start


class Counted:
    """A body of a known size between marks, stuffed or not."""

    def __init__(self, model: Any) -> None:
        self.start, self.end = bytes(model.start), bytes(model.end)
        self._escape, special = None, b""
        self._pairs: dict[int, bytes] = {}
        if model.stuffing is not None:
            self._escape, mask = model.stuffing.escape, model.stuffing.mask
            last = self._escape | mask
            special = bytes((self._escape, last))
            self._pairs = {
                byte: bytes((self._escape, byte & mask)) for byte in range(256) if byte | mask == last
            }
        self._originals = {pair: byte for byte, pair in self._pairs.items()}
        self.marks = self.start + special + self.end or b"\x1f\x7f\xff"

    def encode(self, body: bytes) -> bytes:
        return self.start + b"".join(self._pairs.get(byte, bytes((byte,))) for byte in body) + self.end

    def take(self, received: bytearray, measure: Measure) -> Taken | None:
        """Remove a message that must begin at once; a byte of the range that is not stuffed makes it junk."""
        check_start(received, self.start)
        found = self._body(bytes(received[len(self.start) :]), measure)
        if found is None:
            return None
        body, size = found
        position = len(self.start) + size
        whole = position + len(self.end)
        if len(received) < whole:
            return None
        if bytes(received[position:whole]) != self.end:
            raise ValueError(f"no end {self.end.hex()} after {len(body)} bytes")
        del received[:whole]
        return Taken(body)

    def _body(self, begun: bytes, measure: Measure) -> tuple[bytes, int] | None:
        """Return the body with which bytes begin, and the number of bytes that it takes; None if it is incomplete."""
        if not self._pairs:
            size = measure(begun)
            return None if size is None or len(begun) < size else (begun[:size], size)
        body, position = bytearray(), 0
        size = measure(b"")
        while size is None or len(body) < size:
            pair = begun[position : position + 2]
            if not pair or (pair[0] == self._escape and len(pair) < 2):
                return None
            if pair[0] in self._pairs and pair not in self._originals:
                raise ValueError(f"{pair[0]:02x} is not stuffed")
            body.append(self._originals.get(pair, pair[0]))
            position += 2 if pair in self._originals else 1
            size = measure(bytes(body)) if size is None else size
        return bytes(body), position
