"""SLIP (RFC 1055), and HDLC's variant of it with an XOR mask (ISO 13239, 4.5.2.2).

    | END | body, END as ESC ESC_END, ESC as ESC ESC_ESC | END |
       C0                 DB DC          DB DD              C0

The first END may be missing, and several may stand between two messages.
"""

from __future__ import annotations

from typing import Any

from starhil.hil_tests.judge.framings import Measure, Taken


class Slip:
    """Messages between END bytes."""

    def __init__(self, model: Any) -> None:
        self._end, self._escape, self._leads = model.end, model.escape, model.leading_end
        if model.xor is None:
            end, escape = model.substitutes or (0xDC, 0xDD)
        else:
            end, escape = model.end ^ model.xor, model.escape ^ model.xor
        self._written = {self._end: end, self._escape: escape}
        self.start, self.end = b"", bytes((model.end,))
        self.marks = bytes((self._end, self._escape, end, escape))

    def encode(self, body: bytes) -> bytes:
        """Return the body between END bytes."""
        line = bytearray((self._end,) if self._leads else ())
        for byte in body:
            line += bytes((self._escape, self._written[byte])) if byte in self._written else bytes((byte,))
        return bytes(line) + bytes((self._end,))

    def take(self, received: bytearray, measure: Measure) -> Taken | None:  # noqa: ARG002 -- END ends a message
        """Remove the bytes up to the next END that ends a message."""
        while received and received[0] == self._end:
            del received[0]
        if self._end not in received:
            return None
        size = received.index(self._end)
        line = bytes(received[:size])
        del received[: size + 1]
        body, read = bytearray(), {written: byte for byte, written in self._written.items()}
        following = iter(line)
        for byte in following:
            if byte == self._escape:
                original = read.get(next(following, -1))
                if original is None:
                    return Taken(line, junk=True)
                body.append(original)
            else:
                body.append(byte)
        return Taken(bytes(body))
