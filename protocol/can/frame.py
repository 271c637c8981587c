"""A CAN frame, and its line in a candump log."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Final

from starhil.protocol.errors import ProtocolError

MAX_STANDARD_ID: Final = 0x7FF


MAX_EXTENDED_ID: Final = 0x1FFFFFFF


MAX_FRAME_DATA: Final = 8


@dataclass(frozen=True, slots=True)
class CanFrame:
    """One classic CAN data or remote frame; frames with the same content are equal, whenever they came."""

    id: int
    """CAN ID, 11 or 29 bits."""
    data: bytes = b""
    extended: bool = True
    remote: bool = False
    timestamp: float | None = field(default=None, compare=False)
    """Time of reception, seconds since 1970, or None."""

    def __post_init__(self) -> None:
        """Reject a frame that cannot exist on a CAN bus."""
        if not 0 <= self.id <= (MAX_EXTENDED_ID if self.extended else MAX_STANDARD_ID):
            kind = "a 29-bit" if self.extended else "an 11-bit"
            raise ProtocolError(f"{self.id:#x} is not {kind} CAN ID")
        if len(self.data) > MAX_FRAME_DATA:
            raise ProtocolError(f"CAN frame with {len(self.data)} bytes, at most {MAX_FRAME_DATA}")
        if self.remote and self.data:
            raise ProtocolError("CAN remote frame with data")

    def __str__(self) -> str:
        """Return the frame as an argument of `cansend`: `123#DEAD`, `06000104#R`."""
        can_id = f"{self.id:08X}" if self.extended else f"{self.id:03X}"
        return f"{can_id}#{'R' if self.remote else self.data.hex().upper()}"


def format_candump(frame: CanFrame, channel: str) -> str:
    """Format a frame as a line of a candump log; a frame without a timestamp gets 0."""
    return f"({frame.timestamp or 0.0:017.6f}) {channel} {frame}"


def bus_name(channel: str) -> str:
    """Return the bus name in a channel, as in a candump log: `vcan0` for `socketcand:127.0.0.1:29536/vcan0`."""
    return re.split("[/:]", channel)[-1]
