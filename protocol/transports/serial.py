"""Selection of the serial transport by specification, and the transports over a tty and over TCP."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import os
import select
from pathlib import Path
from typing import ClassVar, Final, cast
from urllib.parse import urlsplit

import serial

from starhil.protocol.errors import reason
from starhil.protocol.transports.base import ReconnectingTransport, TransportError
from starhil.protocol.transports.connections import Listener, TurnProtocol, detect_lost_peer, listen
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
        Path of a symlink to the pseudo-terminal; `publish` makes it, `close` removes it.
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


class TtyTransport(PacedTransport, ReconnectingTransport[bytes]):
    """A tty opened by its path, through pyserial."""

    kind = "serial"

    def __init__(self, path: str, baud: int, pace: int | None) -> None:
        super().__init__(path, pace)
        self._path = path
        self._baud = baud
        self._port: serial.Serial | None = None

    async def _open(self) -> None:
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
            self._disconnect()
            raise TransportError(_tty_problem(self._path, self._baud, error)) from None

    def _readable(self) -> None:
        if self._port is None:
            return
        try:
            data = os.read(self._port.fileno(), self.read_size)
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

    def _has_peer(self) -> bool:
        return self._port is not None

    def _write(self, data: bytes) -> int:
        if self._port is None:
            raise OSError(errno.EIO, "port is closed")
        try:
            return write_fd(self._port.fileno(), data)
        except OSError as error:
            self._lost(error.strerror or str(error))
            raise

    def _disconnect(self) -> None:
        if self._port is not None:
            asyncio.get_running_loop().remove_reader(self._port.fileno())
            with contextlib.suppress(OSError):
                self._port.close()
            self._port = None
        self._clear()


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
        return (
            f"serial {path}: no such port; plug the adapter in, wait for the ready line of the emulator, or name another "
            "(auto makes a pseudo-terminal)"
        )
    if number == errno.EACCES:
        return f"serial {path}: no permission; join the group that owns it (often dialout)"
    return f"serial {path}: cannot open: {os.strerror(number) if number else error}"


class _TcpTransport(TurnProtocol, PacedTransport, ReconnectingTransport[bytes]):
    """A TCP connection; the protocol of its connection, of which there is one at a time."""

    kind = "serial"
    scheme: ClassVar[str]

    def __init__(self, host: str, port: int, pace: int | None) -> None:
        super().__init__(f"{self.scheme}://{host}:{port}", pace)
        self._host = host
        self._port = port
        self._stream: asyncio.Transport | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        stream = cast("asyncio.Transport", transport)
        if self._stream is not None:
            _abandon(stream)
            return
        detect_lost_peer(stream)
        self._stream = stream

    def data_received(self, data: bytes) -> None:
        self._process_received(data)

    def connection_lost(self, exc: Exception | None) -> None:
        self._stream = None
        self._peer_gone(str(exc) if exc else "closed by the peer")

    def _peer_gone(self, why: str) -> None:
        """Handle the end of the connection."""
        self._lost(why)

    def _has_peer(self) -> bool:
        return self._stream is not None

    def _write(self, data: bytes) -> int:
        if self._stream is None:
            raise OSError(errno.ENOTCONN, "no peer")
        if self._stream.get_write_buffer_size() > STREAM_LIMIT:
            return 0
        self._stream.write(data)
        return len(data)

    def _disconnect(self) -> None:
        if self._stream is not None:
            _abandon(self._stream)
            self._stream = None
        self._clear()


def _abandon(stream: asyncio.Transport) -> None:
    """Close a connection whose end is not reported."""
    stream.set_protocol(asyncio.Protocol())
    stream.abort()


class _ConnectTransport(_TcpTransport):
    """A TCP connection to a serial server."""

    scheme = "socket"

    async def _open(self) -> None:
        loop = asyncio.get_running_loop()
        try:
            await loop.create_connection(lambda: self, self._host, self._port)
        except (OSError, ValueError) as error:  # an invalid host name raises ValueError
            raise TransportError(
                f"serial {self.description}: cannot connect: {reason(error)}; start the peer first"
            ) from None


class _ListenTransport(_TcpTransport):
    """A TCP port for one peer at a time, which rejects a second one; without a peer, bytes are lost as on an open line."""

    scheme = "listen"
    _listener: Listener | None = None

    async def _open(self) -> None:
        try:
            self._listener = await listen(lambda: self, self._host, self._port)
        except (OSError, ValueError) as error:
            raise TransportError(
                f"serial {self.description}: cannot listen: {reason(error)}; choose another host or port"
            ) from None
        self._port = self._listener.address[1]
        self.description = f"socket://{self._host}:{self._port}"

    def _peer_gone(self, why: str) -> None:  # noqa: ARG002 (the peer may come and go)
        self._clear()

    def _disconnect(self) -> None:
        if self._listener is not None:
            self._listener.close()
            self._listener = None
        super()._disconnect()
