"""CAN logs in the format of `candump -L`."""

from __future__ import annotations

import re

from starhil.protocol.can_framing import CanFrame


def format_candump(frame: CanFrame, channel: str) -> str:
    """Format a frame as a line of a candump log; a frame without a timestamp gets 0."""
    return f"({frame.timestamp or 0.0:017.6f}) {channel} {frame}"


def bus_name(channel: str) -> str:
    """Return the bus name in a channel, as in a candump log: `vcan0` for `socketcand:127.0.0.1:29536/vcan0`."""
    return re.split("[/:]", channel)[-1]
