"""Selection of the serial transport by specification, and the transports over a tty and over TCP."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import os
import select
from abc import abstractmethod
from pathlib import Path
from typing import ClassVar, Final
from urllib.parse import urlsplit

import serial

from starhil.protocol.errors import reason
from starhil.protocol.flow import TURN, TurnProtocol, detect_lost_peer
from starhil.protocol.transports.base import ReconnectingTransport, TransportError
from starhil.protocol.transports.paced import (
    PacedTransport,
    SerialTransport,
    termios_as_os_error,
    write_fd,
)
from starhil.protocol.transports.pty import PtyTransport

STREAM_LIMIT: Final = 65536
"""Maximum number of bytes that wait in a TCP connection for a peer that does not read."""
DEFAULT_BAUD: Final = 115200
RATE_RETRY_S: Final = 0.002
"""Interval at which the kernel's buffer is checked before the bit rate changes."""


def open_serial(
    spec: str = "auto", baud: int = DEFAULT_BAUD, *, symlink: Path | None = None, paced: bool | None = None
) -> SerialTransport:
    """Return the serial transport that a specification names; `start` opens it.

    Parameters
    ----------
    spec:
        `auto` or `pty` for a new pseudo-terminal, the path of a tty, `socket://HOST:PORT` to connect, or
        `listen://HOST:PORT` to wait for one peer (with port 0, a free port is chosen and given in
        `description`).
    baud:
        Bit rate, 8N1, for the pacing and for the hardware of a real tty.
    symlink:
        Path of a symlink to the pseudo-terminal; created atomically, removed on close.
    paced:
        Whether a message is passed on, whole, only when its last byte would have arrived at the bit rate; true
        by default, except for a real tty, which is paced by its hardware.

    Raises TransportError: the specification is invalid.
    """
    if baud <= 0:
        raise TransportError(f"serial {spec}: bit rate {baud} must be positive")
    pace = baud if paced is None or paced else None
    if spec in ("auto", "pty"):
        return PtyTransport(pace, symlink)
    if symlink is not None:
        raise TransportError(f"serial {spec}: a symlink needs a pseudo-terminal (auto)")
    if spec.startswith(("socket://", "listen://")):
        host, port = _host_and_port(spec)
        transport = _ConnectTransport if spec.startswith("socket") else _ListenTransport
        return transport(host, port, pace)
    if "://" in spec:
        raise TransportError(
            f"serial {spec}: must be auto, a tty's path, socket://HOST:PORT or listen://HOST:PORT"
        )
    if paced is None and not os.path.realpath(spec).startswith("/dev/pts/"):
        pace = None
    return TtyTransport(spec, baud, pace)


def _host_and_port(spec: str) -> tuple[str, int]:
    try:
        parts = urlsplit(spec)
        host, port = parts.hostname, parts.port
    except ValueError:
        host, port = None, None
    if not host or port is None:
        raise TransportError(f"serial {spec}: must be {spec.partition(':')[0]}://HOST:PORT")
    return host, port


class _ReconnectingSerial(PacedTransport, ReconnectingTransport[bytes]):
    """A serial port that may disappear."""

    kind = "serial"

    async def _connect(self) -> None:
        await self._attach()
        self._make_writer()

    def _disconnect(self) -> None:
        self._detach()
        self._drop_writer()

    @abstractmethod
    async def _attach(self) -> None:
        """Open the port or raise TransportError."""

    @abstractmethod
    def _detach(self) -> None:
        """Release the port, in any state."""


class TtyTransport(_ReconnectingSerial):
    """A tty opened by its path, through pyserial."""

    def __init__(self, path: str, baud: int, pace: int | None) -> None:
        super().__init__(path, pace)
        self._path = path
        self._baud = baud
        self._port: serial.Serial | None = None

    async def _attach(self) -> None:
        path = Path(self._path)
        if path.exists() and not path.is_char_device():
            raise TransportError(
                f"serial {self._path}: is not a tty; name a serial port such as /dev/ttyUSB0, or auto for a pseudo-terminal"
            )
        try:
            with termios_as_os_error():
                self._port = serial.Serial(self._path, self._baud, timeout=0, write_timeout=0, exclusive=True)
            asyncio.get_running_loop().add_reader(self._port.fileno(), self._readable)
        except (OSError, ValueError) as error:
            self._detach()
            raise TransportError(_tty_problem(self._path, self._baud, error)) from None

    def _readable(self) -> None:
        if self._port is None:
            return
        try:
            data = os.read(self._port.fileno(), TURN)
        except BlockingIOError:
            return
        except OSError as error:
            self._lost(error.strerror or str(error))
            return
        if data:
            self._process_received(data)
        elif _hung_up(self._port.fileno()):
            self._lost("hung up")

    def _change_rate(self, baud: int) -> None:
        lost = ""
        if self._port is not None:
            try:
                with termios_as_os_error():
                    if self._port.out_waiting:  # the kernel still sends its buffer at the old rate
                        asyncio.get_running_loop().call_later(RATE_RETRY_S, self.set_baud, baud)
                        return
                    self._port.baudrate = baud
            except (OSError, ValueError) as error:
                if isinstance(error, ValueError) or error.errno == errno.EINVAL:
                    self._report_error(
                        f"serial {self._path}: bit rate {baud} is not possible here; {self._baud} stays in use"
                    )
                    return
                lost = error.strerror or str(error)
        self._baud = baud
        super()._change_rate(baud)
        if lost:  # it reopens at the new rate
            self._lost(lost)

    def _write(self, data: bytes) -> int:
        if self._port is None:
            raise OSError(errno.EIO, "port is closed")
        try:
            return write_fd(self._port.fileno(), data)
        except OSError as error:
            self._lost(error.strerror or str(error))
            raise

    def _detach(self) -> None:
        if self._port is not None:
            asyncio.get_running_loop().remove_reader(self._port.fileno())
            with contextlib.suppress(OSError):
                self._port.close()
            self._port = None


def _hung_up(fd: int) -> bool:
    poll = select.poll()
    poll.register(fd, select.POLLIN)
    return any(event & (select.POLLHUP | select.POLLERR | select.POLLNVAL) for _, event in poll.poll(0))


def _tty_problem(path: str, baud: int, error: Exception) -> str:
    number = getattr(error, "errno", None)
    if isinstance(error, ValueError):
        return f"serial {path}: bit rate {baud} is not possible here"
    if number in (errno.EBUSY, errno.EAGAIN):
        return f"serial {path}: busy: another program has it open; close that program"
    if number == errno.ENOENT:
        return f"serial {path}: no such port; plug the adapter in, or name another (auto makes a pseudo-terminal)"
    if number == errno.EACCES:
        return f"serial {path}: no permission; join the group that owns it (often dialout)"
    return f"serial {path}: cannot open: {os.strerror(number) if number else error}"


class _StreamProtocol(TurnProtocol):
    """Passes the data of a TCP connection to its transport."""

    def __init__(self, owner: _TcpTransport) -> None:
        super().__init__()
        self._owner = owner

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        if isinstance(transport, asyncio.Transport):
            detect_lost_peer(transport)
            self._owner.attach(self, transport)

    def data_received(self, data: bytes) -> None:
        self._owner.process(self, data)

    def connection_lost(self, exc: Exception | None) -> None:
        self._owner.on_lost(self, exc)


class _TcpTransport(_ReconnectingSerial):
    """Base of both TCP transports."""

    scheme: ClassVar[str]

    def __init__(self, host: str, port: int, pace: int | None) -> None:
        super().__init__(f"{self.scheme}://{host}:{port}", pace)
        self._host = host
        self._port = port
        self._stream: asyncio.Transport | None = None
        self._protocol: _StreamProtocol | None = None

    def attach(self, protocol: _StreamProtocol, stream: asyncio.Transport) -> None:
        """Use a connection; a second one is rejected."""
        if self._stream is not None:
            stream.abort()
            return
        self._stream, self._protocol = stream, protocol

    def process(self, protocol: _StreamProtocol, data: bytes) -> None:
        """Process bytes of the connection in use."""
        if protocol is self._protocol:
            self._process_received(data)

    def on_lost(self, protocol: _StreamProtocol, error: Exception | None) -> None:
        """Handle the end of a connection."""
        if protocol is self._protocol:
            self._stream = self._protocol = None
            self._peer_gone(str(error) if error else "closed by the peer")

    @abstractmethod
    def _peer_gone(self, why: str) -> None:
        """Handle the loss of the peer."""

    def _write(self, data: bytes) -> int:
        if self._stream is None:
            raise OSError(errno.ENOTCONN, "no peer")
        if self._stream.get_write_buffer_size() > STREAM_LIMIT:
            return 0
        self._stream.write(data)
        return len(data)

    def _detach(self) -> None:
        if self._stream is not None:
            self._stream.abort()
            self._stream = self._protocol = None


class _ConnectTransport(_TcpTransport):
    """A TCP connection to a serial server."""

    scheme = "socket"

    async def _attach(self) -> None:
        loop = asyncio.get_running_loop()
        try:
            await loop.create_connection(lambda: _StreamProtocol(self), self._host, self._port)
        except (OSError, ValueError) as error:  # an invalid host name raises ValueError
            raise TransportError(
                f"serial {self.description}: cannot connect: {reason(error)}; start the peer first"
            ) from None

    def _peer_gone(self, why: str) -> None:
        self._lost(why)


class _ListenTransport(_TcpTransport):
    """A TCP port for one peer at a time; without a peer, bytes are lost as on an open line."""

    scheme = "listen"
    _server: asyncio.Server | None = None

    async def _attach(self) -> None:
        loop = asyncio.get_running_loop()
        try:
            self._server = await loop.create_server(lambda: _StreamProtocol(self), self._host, self._port)
        except (OSError, ValueError) as error:
            raise TransportError(
                f"serial {self.description}: cannot listen: {reason(error)}; choose another host or port"
            ) from None
        self._port = self._server.sockets[0].getsockname()[1]
        self.description = f"socket://{self._host}:{self._port}"

    def _peer_gone(self, why: str) -> None:  # noqa: ARG002 (the peer may come and go)
        if self._writer is not None:
            self._writer.clear()

    def _detach(self) -> None:
        if self._server is not None:
            self._server.close()
            self._server = None
        super()._detach()
