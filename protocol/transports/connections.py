"""Fair sharing of an event loop by many connections, a limit of their number, and socket options for TCP.

Each connection reads a bounded amount per turn of the loop. Without a limit on their number, connections could use up all
file descriptors of the process, and links could not be reopened.
"""

from __future__ import annotations

import asyncio
import logging
import resource
import socket
from abc import abstractmethod
from typing import Final, cast

log: Final = logging.getLogger("starhil.connections")

TURN: Final = 4 * 1024
"""Maximum number of bytes that a connection of a server reads per turn of the loop: about 100 CAN frames as text."""

WINDOW: Final = 16 * 1024
"""Size of each buffer of a connection, bytes; buffered bytes delay later ones."""


KEEPALIVE: Final = {socket.TCP_KEEPIDLE: 5, socket.TCP_KEEPINTVL: 2, socket.TCP_KEEPCNT: 3}
"""Probe a connection after 5 s of silence, then every 2 s; it is lost after 3 probes without an
answer."""

UNREAD_LIMIT_MS: Final = 10_000
"""A server that has not acknowledged sent data for this time is lost."""

MAX_CONNECTIONS: Final = 64
"""Maximum number of connections of a server."""

SHARE_OF_DESCRIPTORS: Final = 8
"""A server uses at most one in this many of the file descriptors that the process may open."""


class ConnectionLimit:
    """Rejects connections of a server that has too many, with `refusal`; the first rejection is logged."""

    def __init__(self, server: str, refusal: bytes = b"") -> None:
        self._server = server
        self._refusal = refusal
        self._logged = False
        descriptors, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
        unlimited = descriptors == resource.RLIM_INFINITY
        share = MAX_CONNECTIONS if unlimited else descriptors // SHARE_OF_DESCRIPTORS
        self.size = max(1, min(MAX_CONNECTIONS, share))
        """Maximum number; as `backlog` of the server it also limits what asyncio accepts in one turn of the loop."""

    def admits(self, transport: asyncio.BaseTransport, connected: int) -> bool:
        """Return whether there is room besides the connected peers; close the connection if not."""
        if connected < self.size:
            return True
        if not self._logged:
            self._logged = True
            log.warning(
                "%s: %d connections are open, the maximum; further ones are closed, and not logged again",
                self._server,
                self.size,
            )
        stream = cast("asyncio.WriteTransport", transport)
        stream.write(self._refusal)
        stream.close()
        return False


class TurnProtocol(asyncio.BufferedProtocol):
    """A connection that reads at most `read_size` bytes before the loop serves other connections."""

    read_size: int = TURN
    _buffer: bytearray

    def get_buffer(self, sizehint: int) -> bytearray:  # noqa: ARG002 (asyncio's signature)
        """Return the buffer for the next bytes."""
        self._buffer = bytearray(self.read_size)
        return self._buffer

    def buffer_updated(self, nbytes: int) -> None:
        """Pass the bytes that were read to `data_received`."""
        self.data_received(bytes(self._buffer[:nbytes]))

    @abstractmethod
    def data_received(self, data: bytes) -> None:
        """Process bytes that were read."""


def limit_buffers(transport: asyncio.BaseTransport) -> None:
    """Limit the kernel buffers of a TCP connection, which hold megabytes by default."""
    for option in (socket.SO_SNDBUF, socket.SO_RCVBUF):
        transport.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, option, WINDOW)


def detect_lost_peer(transport: asyncio.BaseTransport, *, must_read: bool = False) -> None:
    """Close a silent TCP connection within about ten seconds after the other machine has disappeared.

    With `must_read`, a peer that is alive but reads nothing for that long is lost too. Use it for servers,
    but not for clients, which may be halted in a debugger.
    """
    connection = transport.get_extra_info("socket")
    options = KEEPALIVE | {socket.TCP_USER_TIMEOUT: UNREAD_LIMIT_MS} if must_read else KEEPALIVE
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in options.items():
        connection.setsockopt(socket.IPPROTO_TCP, option, value)
