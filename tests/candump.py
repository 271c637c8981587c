"""Candump logs, read by python-can."""

from __future__ import annotations

import io
from pathlib import Path

import can

from starhil.protocol.can.frame import CanFrame


def read_candump(log: Path | io.StringIO) -> list[tuple[str, CanFrame]]:
    """Return channel and frame of each line."""
    return [
        (
            str(message.channel),
            CanFrame(
                message.arbitration_id,
                bytes(message.data),
                message.is_extended_id,
                message.is_remote_frame,
                message.timestamp,
            ),
        )
        for message in can.CanutilsLogReader(log)
    ]


def parse_candump(line: str) -> tuple[str, CanFrame]:
    """Return channel and frame of a line."""
    (found,) = read_candump(io.StringIO(line))
    return found
