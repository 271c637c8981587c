"""The socketcand text protocol, sans-I/O: split a stream into commands `< … >`, convert frames to text and back.

There is one extension: after `< remote >` (answered by `< ok >`), a client may send and receive remote frames.
Their CAN ID has eight digits with the kernel's flags 40000000 (remote) and 80000000 (29-bit). Other clients do
not receive remote frames, because the plain protocol cannot distinguish them from data frames.
"""

from __future__ import annotations

import math
import re
from typing import Final

from starhil.protocol.can.frame import MAX_EXTENDED_ID, MAX_STANDARD_ID, CanFrame
from starhil.protocol.errors import ProtocolError

EXTENDED_FLAG: Final = 0x80000000
REMOTE_FLAG: Final = 0x40000000

MAX_COMMAND: Final = 256
"""Longest accepted command; a frame needs at most 60 characters."""

_SEND: Final = re.compile(rb"send +([0-9A-Fa-f]{1,8}) +([0-8])((?: +[0-9A-Fa-f]{1,2})*) *")


class CommandError(ProtocolError):
    """Text that is not a valid command of the socketcand protocol."""


class CommandSplitter:
    """Split a stream of bytes into commands.

    Text outside `< >` and overlong commands yield None.
    """

    def __init__(self) -> None:
        self._rest = b""

    def feed(self, data: bytes) -> list[bytes | None]:
        """Return the commands that these bytes complete, without brackets and outer spaces."""
        pieces = (self._rest + data).split(b">")
        self._rest = pieces.pop()
        commands: list[bytes | None] = []
        for piece in pieces:
            before, bracket, command = piece.rpartition(b"<")
            if not bracket or before.strip() or len(command) > MAX_COMMAND:
                commands.append(None)
            if bracket and len(command) <= MAX_COMMAND:
                commands.append(command.strip())
        if len(self._rest) > MAX_COMMAND:
            self._rest = b""
            commands.append(None)
        return commands


def parse_send(command: bytes) -> CanFrame:
    """Parse `send ID LENGTH B B …`. Raises CommandError."""
    match = _SEND.fullmatch(command)
    if match is None:
        raise CommandError("malformed send: must be send ID LENGTH BYTES, all in hexadecimal")
    can_id, length, digits = match[1], int(match[2]), match[3].split()
    if len(digits) != length:
        raise CommandError(f"send with length {length} has {len(digits)} bytes")
    data = b"".join(digits)
    if len(data) != 2 * length:
        data = b"".join(digit.zfill(2) for digit in digits)
    extended, remote, number = parse_can_id(can_id)
    return CanFrame(number, bytes.fromhex(data.decode()), extended, remote)


def parse_can_id(digits: bytes) -> tuple[bool, bool, int]:
    """Parse a CAN ID of up to three digits (11-bit) or eight digits (29-bit).

    Returns whether it is extended, whether the frame is remote, and the number.
    """
    number = int(digits, 16)
    extended, remote = len(digits) == 8, False
    if extended and number > MAX_EXTENDED_ID:
        if number & REMOTE_FLAG:
            extended, remote = bool(number & EXTENDED_FLAG), True
        number &= MAX_EXTENDED_ID
    if len(digits) not in (1, 2, 3, 8) or (not extended and number > MAX_STANDARD_ID):
        raise CommandError(f"CAN ID {digits.decode()} has neither up to 3 digits (11-bit) nor 8 (29-bit)")
    return extended, remote, number


def format_can_id(frame: CanFrame) -> bytes:
    """Format a CAN ID: three digits for 11 bits, eight for 29 bits and for remote frames."""
    if frame.remote:
        return b"%08X" % (frame.id | REMOTE_FLAG | (EXTENDED_FLAG if frame.extended else 0))
    return b"%08X" % frame.id if frame.extended else b"%03X" % frame.id


def format_send(frame: CanFrame) -> bytes:
    """Format the command by which a client sends a frame."""
    data = frame.data
    return b"< send %b %d %b >" % (format_can_id(frame), len(data), data.hex(" ").encode())


def format_frame(frame: CanFrame, stamp: bytes) -> bytes:
    """Format a frame as a server sends it to clients.

    `stamp` is the time as `seconds.microseconds`.
    """
    return b"< frame %b %b %b >" % (format_can_id(frame), stamp, frame.data.hex().upper().encode())


def parse_frame(command: bytes) -> CanFrame:
    """Parse `frame ID TIME HEX` as a client receives it. Raises CommandError."""
    fields = command.split()
    if len(fields) not in (3, 4) or fields[0] != b"frame":
        raise CommandError(f"not a frame: {command[:40].decode(errors='replace')}")
    try:
        extended, remote, number = parse_can_id(fields[1])
        data = bytes.fromhex(fields[3].decode()) if len(fields) == 4 else b""
        seconds = float(fields[2])
        if not math.isfinite(seconds):
            raise CommandError("timestamp is not a number")
        return CanFrame(number, data, extended, remote, seconds)
    except (ValueError, ProtocolError):
        raise CommandError(f"malformed frame: {command[:40].decode(errors='replace')}") from None
