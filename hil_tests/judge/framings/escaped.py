"""Framing with an escape byte before both marks (ANSI X3.28 DLE framing; CubeSpace with other bytes).

    | ESC START | body, each ESC doubled | ESC END |
       10   02                             10  03       DLE STX … DLE ETX
       1F   7F                             1F  FF       CubeSpace (AlbertaSat adcs_io.c, RADSAT, libCubeObc)

In CubeSpace's generation 2 the start byte names the kind of the message: 07, 0F, 2F, 4F (libCubeObc).
"""

from __future__ import annotations

from starhil.hil_tests.judge.framings import Measure, Taken


class Escaped:
    """`escape start … escape end`; requests have the first of the starts, answers any of them."""

    def __init__(self, escape: int, starts: tuple[int, ...], end: int) -> None:
        self._escape, self._starts, self._end = escape, starts, end
        self.start, self.end = bytes((escape, starts[0])), bytes((escape, end))
        self.marks = bytes((escape, starts[0], end))

    def encode(self, body: bytes, start: int | None = None) -> bytes:
        line = bytearray((self._escape, self._starts[0] if start is None else start))
        for byte in body:
            line += bytes((byte,)) * (2 if byte == self._escape else 1)
        return bytes(line) + bytes((self._escape, self._end))

    def take(self, received: bytearray, measure: Measure) -> Taken | None:  # noqa: ARG002 -- the end is marked
        """Remove a message that must begin at once."""
        if received[0] != self._escape or (len(received) > 1 and received[1] not in self._starts):
            raise ValueError(f"begins with {bytes(received[:2]).hex()}")
        body, position = bytearray(), 2
        while position < len(received):
            byte = received[position]
            if byte == self._escape:
                position += 1
                if position == len(received):
                    return None
                if received[position] == self._end:
                    start = received[1]
                    del received[: position + 1]
                    return Taken(bytes(body), start)
                if received[position] != self._escape:
                    raise ValueError(f"{self._escape:02x} before {received[position]:02x}")
            body.append(byte)
            position += 1
        return None
