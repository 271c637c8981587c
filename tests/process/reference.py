"""An oracle for the replies of the emulator, written from the published wire rules alone."""

from __future__ import annotations

from dataclasses import dataclass, field

from starhil.protocol.icd.values import MessageError
from starhil.protocol.unit import load_unit

ICD = load_unit()
MAX_MESSAGE = 512
OK_OR_STATE = frozenset({0, 6, 7})
"""Codes of a well-formed telecommand: done, busy, or not in this state."""

STATE_CHANGING = frozenset(
    {"reset", "set_parameter", "set_unsolicited", "set_mode", "set_update_rate", "set_star_config", "clear_counters",
     "save_image", "default_parameters", "restore_parameters"}
)  # fmt: skip
UNANSWERED = frozenset({1, 101, 119})
"""Telecommands that are not answered on a serial line."""
"""Telecommands that, if they were accepted, would change how the device answers.

The fuzzers leave them out.
"""


@dataclass(frozen=True)
class Expected:
    """The answer to one request: the codes that a telecommand may get, or the size of the telemetry."""

    identifier: int
    codes: frozenset[int] = frozenset()
    size: int | None = None
    source: int = 0

    def fits(self, body: bytes) -> bool:
        """Return whether a reply body (data or the code) is right."""
        if self.size is not None:
            return len(body) == self.size
        return len(body) == 1 and body[0] in self.codes


def answer_to(identifier: int, data: bytes, source: int = 0) -> Expected:
    """Say what a request is answered by."""
    if identifier >= 128:
        row = ICD.row(identifier)
        if row is None:
            return Expected(identifier, frozenset({1}), source=source)
        if data:
            return Expected(identifier, frozenset({2}), source=source)
        return Expected(identifier, size=row.size, source=source)
    row = ICD.row(identifier)
    if row is None:
        return Expected(identifier, frozenset({1}), source=source)
    if len(data) == row.size + 1:
        if crc8(data[:-1]) != data[-1]:
            return Expected(identifier, frozenset({4}), source=source)
        data = data[:-1]
    if len(data) != row.size:
        return Expected(identifier, frozenset({2}), source=source)
    try:
        row.decode(data)
    except MessageError:
        return Expected(identifier, frozenset({3}), source=source)
    return Expected(identifier, OK_OR_STATE | {3}, source=source)


def crc8(data: bytes) -> int:
    """The CRC-8 that may follow a telecommand: reflected, polynomial 12h; FFh for no data."""
    crc = 0
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ 0x48 if crc & 1 else crc >> 1
    return crc if data else 0xFF


def is_dangerous(identifier: int, data: bytes) -> bool:
    """Return whether a request might be accepted and change how the device answers."""
    row = ICD.row(identifier)
    return row is not None and row.name in STATE_CHANGING and answer_to(identifier, data).codes >= OK_OR_STATE


def frame_request(identifier: int, data: bytes = b"") -> bytes:
    """Frame a request: 1F 7F, identifier and data with 1F doubled, 1F FF."""
    return b"\x1f\x7f" + (bytes([identifier]) + data).replace(b"\x1f", b"\x1f\x1f") + b"\x1f\xff"


def requests_in(stream: bytes) -> list[tuple[int, bytes]]:
    """Find the requests in a stream of bytes, whatever else is in it.

    Outside a message everything but `1F 7F` is passed over. Inside, `1F 1F` is a byte 1F, `1F FF`
    the end, `1F 7F` the start of another message, and `1F` before anything else ends the message
    without effect, save that an identifier 1F may stand alone.
    """
    values = []
    position = 0
    while (start := stream.find(b"\x1f\x7f", position)) >= 0:
        position = start + 2
        body = bytearray()
        while position < len(stream):
            byte = stream[position]
            if byte != 0x1F:
                body.append(byte)
                position += 1
            elif position + 1 >= len(stream):
                return values
            else:
                follower = stream[position + 1]
                if follower == 0x1F:
                    body.append(0x1F)
                elif follower == 0x7F:
                    break
                elif follower == 0xFF:
                    position += 2
                    if body:
                        values.append((body[0], bytes(body[1:])))
                    break
                elif body:
                    position += 2
                    break
                else:
                    body += bytes((0x1F, follower))
                position += 2
            if len(body) > MAX_MESSAGE:
                break
    return values


def bodies_in(stream: bytes) -> list[bytes]:
    """Find the replies of dialect b in a stream that holds nothing else; anything else raises."""
    bodies = []
    position = 0
    while position < len(stream):
        assert stream[position : position + 2] == b"\x1f\x7f", (
            f"junk in replies: {stream[position : position + 16].hex()}"
        )
        position += 2
        body = bytearray()
        while True:
            if stream[position] != 0x1F:
                body.append(stream[position])
                position += 1
            elif stream[position + 1] == 0x1F:
                body.append(0x1F)
                position += 2
            else:
                assert stream[position + 1] == 0xFF, (
                    f"byte {stream[position + 1]:02X} after an escape in a reply"
                )
                position += 2
                break
        bodies.append(bytes(body))
    return bodies


@dataclass
class CanOracle:
    """Says which requests a sequence of frames makes at a device address."""

    address: int = 4
    _open: dict[int, tuple[int, int, bytes]] = field(default_factory=dict)

    @property
    def unfinished(self) -> list[int]:
        """Identifiers of the segmented messages that are under way."""
        return list(self._open)

    def take(
        self, identifier: int, data: bytes, *, extended: bool, remote: bool
    ) -> tuple[int, bytes, int] | None:
        """Take a frame; return identifier, data and asker of the request that it completes."""
        if not extended or remote or identifier & 0xFF != self.address:
            return None
        kind, number, source = identifier >> 24, identifier >> 16 & 0xFF, identifier >> 8 & 0xFF
        if kind == 1 and number < 128:
            self._open.pop(0x07 << 24 | identifier & 0xFFFFFF, None)
            return number, data, source
        if kind == 4 and number >= 128:
            return number, data, source
        if kind == 7 and number < 128:
            return self._segment(identifier, number, source, data)
        return None

    def _segment(self, key: int, number: int, source: int, data: bytes) -> tuple[int, bytes, int] | None:
        if not data:
            self._open.pop(key, None)
            return None
        part, left = data[:-1], data[-1]
        first, expected, gathered = self._open.get(key, (0, -1, b""))
        if left == expected and (left == 0 or len(part) == 7):
            if left == 0:
                del self._open[key]
                return number, gathered + part, source
            self._open[key] = (first, left - 1, gathered + part)
        elif len(part) == 7 and left > 0 and left >= first:
            self._open[key] = (left, left - 1, part)
        elif left == 0:
            self._open.pop(key, None)
        elif key in self._open:
            self._open[key] = (first, -1, b"")
        return None
