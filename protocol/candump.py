"""Read and write CAN logs in the format of `candump -L`."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from starhil.protocol.can_framing import CanFrame
from starhil.protocol.errors import ProtocolError

_LINE: Final = re.compile(
    r"\((?P<time>\d+\.\d+)\)\s+(?P<channel>\S+)\s+(?P<id>[0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})#(?P<data>R\d?|[0-9A-Fa-f.]*)"
    r"(?:\s+[TR])?\s*$"
)


def format_candump(frame: CanFrame, channel: str) -> str:
    """Format a frame as a line of a candump log; a frame without a timestamp gets 0."""
    can_id = f"{frame.id:08X}" if frame.extended else f"{frame.id:03X}"
    data = "R" if frame.remote else frame.data.hex().upper()
    return f"({frame.timestamp or 0.0:017.6f}) {channel} {can_id}#{data}"


def bus_name(channel: str) -> str:
    """Return the bus name in a channel, as in a candump log: `vcan0` for `socketcand:127.0.0.1:29536/vcan0`."""
    return re.split("[/:]", channel)[-1]


def parse_candump(line: str) -> tuple[str, CanFrame]:
    """Parse a line of a candump log; return the channel and the frame.

    Raises ProtocolError for any other line.
    """
    match = _LINE.match(line.strip())
    if match is None:
        raise ProtocolError(f"not a line of a candump log: {line.strip()[:60]!r}")
    text = match["data"]
    remote = text.startswith("R")
    try:
        data = b"" if remote else bytes.fromhex(text.replace(".", ""))
    except ValueError:
        raise ProtocolError(f"odd number of data digits in candump line: {line.strip()[:60]!r}") from None
    extended = len(match["id"]) == 8
    return match["channel"], CanFrame(int(match["id"], 16), data, extended, remote, float(match["time"]))


def read_candump(path: Path) -> Iterator[tuple[str, CanFrame]]:
    """Yield channel and frame of each line of a candump log; skip empty lines.

    An error names file and line.
    """
    try:
        with path.open(encoding="ascii", errors="replace") as stream:
            for number, line in enumerate(stream, 1):
                if line.strip():
                    try:
                        yield parse_candump(line)
                    except ProtocolError as error:
                        raise ProtocolError(f"{path}:{number}: {error}") from None
    except OSError as error:
        raise ProtocolError(f"{path}: cannot read the log: {error.strerror}") from None
