"""The socketcand text protocol, sans-I/O: commands `< … >` cut out of a stream, frames to text and back.

One addition of ours: after `< remote >` (answered `< ok >`) a client may send, and is sent, remote frames; their
identifier has eight digits with the kernel's flags 40000000 (remote) and 80000000 (29-bit). Clients that have not
asked never see remote frames, because the plain protocol cannot tell them from data frames.
"""

from __future__ import annotations

import math
import re
from typing import Final

from starhil.protocol.can_framing import MAX_EXTENDED_ID, MAX_STANDARD_ID, CanFrame
from starhil.protocol.errors import ProtocolError

EXTENDED_FLAG: Final = 0x80000000
REMOTE_FLAG: Final = 0x40000000

MAX_COMMAND: Final = 256
"""Longest command that is taken; a frame needs at most 60 characters."""

_SEND: Final = re.compile(rb"send +([0-9A-Fa-f]{1,8}) +([0-8])((?: +[0-9A-Fa-f]{1,2})*) *")


class CommandError(ProtocolError):
    """Text that is not a command of the socketcand protocol."""


class CommandSplitter:
    """Cut a stream of bytes into commands; text outside `< >` and overlong commands come out as None."""

    def __init__(self) -> None:
        self._rest = b""

    def feed(self, data: bytes) -> list[bytes | None]:
        """Take bytes and return the commands they complete, without brackets and outer spaces."""
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
    """Read `send ID LEN B B …`. Raises CommandError naming what is wrong."""
    match = _SEND.fullmatch(command)
    if match is None:
        raise CommandError("malformed send: must be send ID LENGTH BYTES, all in hexadecimal")
    identifier, length, digits = match[1], int(match[2]), match[3].split()
    if len(digits) != length:
        raise CommandError(f"send with length {length} has {len(digits)} bytes")
    data = b"".join(digits)
    if len(data) != 2 * length:
        data = b"".join(digit.zfill(2) for digit in digits)
    extended, remote, number = parse_identifier(identifier)
    return CanFrame(number, bytes.fromhex(data.decode()), extended, remote)


def parse_identifier(digits: bytes) -> tuple[bool, bool, int]:
    """Read an identifier: up to three digits for 11 bits, eight for 29; return extended, remote, number."""
    number = int(digits, 16)
    extended, remote = len(digits) == 8, False
    if extended and number > MAX_EXTENDED_ID:
        if number & REMOTE_FLAG:
            extended, remote = bool(number & EXTENDED_FLAG), True
        number &= MAX_EXTENDED_ID
    if len(digits) not in (1, 2, 3, 8) or (not extended and number > MAX_STANDARD_ID):
        raise CommandError(f"identifier {digits.decode()} has neither up to 3 digits (11-bit) nor 8 (29-bit)")
    return extended, remote, number


def format_identifier(frame: CanFrame) -> bytes:
    """Write an identifier: three digits for 11 bits, eight for 29 and for remote frames."""
    if frame.remote:
        return b"%08X" % (frame.id | REMOTE_FLAG | (EXTENDED_FLAG if frame.extended else 0))
    return b"%08X" % frame.id if frame.extended else b"%03X" % frame.id


def format_send(frame: CanFrame) -> bytes:
    """Write the command that sends a frame."""
    data = frame.data
    return b"< send %b %d %b >" % (format_identifier(frame), len(data), data.hex(" ").encode())


def format_frame(frame: CanFrame, stamp: bytes) -> bytes:
    """Write a frame as a server tells it to clients; `stamp` is the time, as `seconds.microseconds`."""
    return b"< frame %b %b %b >" % (format_identifier(frame), stamp, frame.data.hex().upper().encode())


def parse_frame(command: bytes) -> CanFrame:
    """Read `frame ID TIME HEX` as a client gets it. Raises CommandError."""
    words = command.split()
    if len(words) not in (3, 4) or words[0] != b"frame":
        raise CommandError(f"not a frame: {command[:40].decode(errors='replace')}")
    try:
        extended, remote, number = parse_identifier(words[1])
        data = bytes.fromhex(words[3].decode()) if len(words) == 4 else b""
        seconds = float(words[2])
        if not math.isfinite(seconds):
            raise CommandError("time stamp is no number")
        return CanFrame(number, data, extended, remote, seconds)
    except (ValueError, ProtocolError):
        raise CommandError(f"malformed frame: {command[:40].decode(errors='replace')}") from None
