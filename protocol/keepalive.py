"""TCP connections that notice when the other machine is gone without a word (power cut, cable pulled)."""

from __future__ import annotations

import asyncio
import socket
from typing import Final

IDLE_S: Final = 5
"""Silence after which the other end is asked whether it is there."""
EVERY_S: Final = 2
PROBES: Final = 3
GONE_AFTER_MS: Final = 10_000
"""Time that sent data may stay untaken until a server counts as lost."""


def notice_a_lost_peer(transport: asyncio.BaseTransport, *, must_read: bool = False) -> None:
    """Let a silent connection end by itself within about ten seconds of the other machine's disappearance.

    With `must_read` also one on which data is under way; then a peer that is alive but reads nothing for that long is
    lost too, which is right for a server but not for a program that somebody has halted in a debugger.
    """
    connection: socket.socket | None = transport.get_extra_info("socket")
    if connection is None or connection.family not in (socket.AF_INET, socket.AF_INET6):
        return
    options = {socket.TCP_KEEPIDLE: IDLE_S, socket.TCP_KEEPINTVL: EVERY_S, socket.TCP_KEEPCNT: PROBES}
    if must_read:
        options[socket.TCP_USER_TIMEOUT] = GONE_AFTER_MS
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in options.items():
        connection.setsockopt(socket.IPPROTO_TCP, option, value)
