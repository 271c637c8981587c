"""Serial transports: an own pseudo-terminal, a real tty, and TCP sockets in place of one."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import os
import select
import termios
import tty
from abc import abstractmethod
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Final
from urllib.parse import urlsplit

import serial

from starhil.protocol.errors import reason
from starhil.protocol.flow import TURN, TurnProtocol
from starhil.protocol.keepalive import notice_a_lost_peer
from starhil.protocol.serial_framing import PacingSchedule
from starhil.protocol.transports.base import ReturningTransport, Transport, TransportError
from starhil.protocol.transports.paced_writer import PacedWriter
from starhil.protocol.transports.pty_peers import PtyPeers

STREAM_LIMIT: Final = 65536
"""Bytes that wait in a TCP connection for a peer that does not read, above which no more are written."""
DEFAULT_BAUD: Final = 115200
RATE_RETRY_S: Final = 0.002
"""Time until the next look whether the kernel has sent all, before the bit rate changes."""


class SerialTransport(Transport[bytes]):
    """A serial port."""

    @abstractmethod
    def set_baud(self, baud: int) -> None:
        """Go on at another bit rate as soon as all that was queued has left."""


def open_serial(
    spec: str = "auto", baud: int = DEFAULT_BAUD, *, symlink: Path | None = None, paced: bool | None = None
) -> SerialTransport:
    """Make the serial transport that a specification names; it is opened by `start`.

    Parameters
    ----------
    spec:
        `auto` or `pty` for an own pseudo-terminal, the path of a tty, `socket://HOST:PORT` to connect, or
        `listen://HOST:PORT` to wait for one peer (port 0: a free one, told by `description`).
    baud:
        Bit rate, 8N1. It sets the pace of what is sent, and a real tty's hardware.
    symlink:
        Path that shall lead to the pseudo-terminal; made in one step, removed at close.
    paced:
        Whether bytes leave no faster than the bit rate. By default yes, except on a real tty, which does it itself.

    Raises
    ------
    TransportError
        The specification is none of these.
    """
    schedule = PacingSchedule(baud)
    pace = schedule if paced is None or paced else None
    if spec in ("auto", "pty"):
        return PtyTransport(pace, symlink)
    if symlink is not None:
        raise TransportError(f"serial {spec}: a symlink goes only with a pseudo-terminal (auto)")
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


class _PacedTransport(SerialTransport):
    """Common part: the paced writer in front of the port."""

    def __init__(self, description: str, schedule: PacingSchedule | None) -> None:
        super().__init__(description)
        self._schedule = schedule
        self._writer: PacedWriter | None = None

    def set_baud(self, baud: int) -> None:
        if self._writer is None:
            self._change_rate(baud)
        else:
            self._writer.when_idle(partial(self._change_rate, baud))

    def _change_rate(self, baud: int) -> None:
        """Take another bit rate into use; nothing is queued."""
        if self._schedule is not None:
            self._schedule = PacingSchedule(baud)
            if self._writer is not None:
                self._writer.schedule = self._schedule

    @abstractmethod
    def _write(self, data: bytes) -> int:
        """Write without blocking; return how many bytes were taken."""

    def _make_writer(self) -> None:
        self._writer = PacedWriter(self._write, self._schedule, self.statistics)

    def send(self, item: bytes) -> bool:
        if self._writer is None:
            self.statistics.dropped += len(item)
            return False
        return self._writer.send(item)

    async def drain(self) -> None:
        if self._writer is not None:
            await self._writer.drain()

    def _drop_writer(self) -> None:
        if self._writer is not None:
            self._writer.clear()
            self._writer = None

    def _take(self, data: bytes) -> None:
        self.statistics.received += len(data)
        self._receive(data)


def _write_fd(fd: int, data: bytes) -> int:
    try:
        return os.write(fd, data)
    except BlockingIOError:
        return 0


class PtyTransport(_PacedTransport):
    """An own pseudo-terminal; the peer opens its slave side like any tty, as often as it wants.

    As on a wire, what is sent while nobody has the slave side open is lost, and so is what a peer has left unread.
    """

    def __init__(self, schedule: PacingSchedule | None, symlink: Path | None) -> None:
        super().__init__("pty", schedule)
        self._symlink = symlink
        self._path = ""
        self._master = -1
        self._peers: PtyPeers | None = None

    async def _open(self) -> None:
        try:
            self._master, slave = os.openpty()
        except OSError as error:
            raise TransportError(
                f"serial pty: the system gives no pseudo-terminal: {error.strerror}"
            ) from None
        try:
            with _termios_as_os_error():
                tty.setraw(slave)
            os.set_blocking(self._master, False)
            self._path = os.ttyname(slave)
            if self._symlink is not None:
                self._link(self._symlink, self._path)
        except OSError as error:
            self._close_master()
            raise TransportError(f"serial pty: cannot be set up: {error.strerror}; try again") from None
        except TransportError:
            self._close_master()
            raise
        finally:
            os.close(slave)  # the master hangs up while no peer has it open
        self.description = str(self._symlink) if self._symlink is not None else self._path
        self._make_writer()
        self._peers = PtyPeers(self._master, self._path)
        asyncio.get_running_loop().add_reader(self._peers.fileno(), self._readable)

    def _link(self, link: Path, path: str) -> None:
        try:
            if link.exists() and not link.is_symlink():
                raise TransportError(f"serial: {link} exists and is no symlink; choose another name")
            fresh = link.with_name(f".{link.name}.{os.getpid()}")
            fresh.symlink_to(path)
            fresh.replace(link)
        except OSError as error:
            raise TransportError(f"serial: cannot make the symlink {link}: {error.strerror}") from None

    def _readable(self) -> None:
        if self._peers is None:
            return
        self._peers.acknowledge()
        self._lose_unread(self._peers)
        try:
            data = os.read(self._master, TURN)
        except BlockingIOError:
            return
        except OSError as error:
            if error.errno != errno.EIO:  # that is: nobody has the slave side open
                self._complain(f"serial {self.description}: {error.strerror}")
            return
        asyncio.get_running_loop().call_soon(self._readable)  # the wake-up came once for all there is
        self._take(data)

    def _lose_unread(self, peers: PtyPeers) -> None:
        """Drop what a peer that left has not read, and what was still to be sent to it."""
        if peers.all_left():
            if self._writer is not None:
                self._writer.clear()
            peers.discard_unread()

    def send(self, item: bytes) -> bool:
        """Queue a message, whole or not at all; without a peer it is lost."""
        if self._peers is not None:
            self._lose_unread(self._peers)
            if not self._peers.present:
                self.statistics.dropped += len(item)
                return False
        return super().send(item)

    def _write(self, data: bytes) -> int:
        if self._peers is None:
            raise OSError(errno.EBADF, "port is closed")
        if self._peers.all_left():
            self._peers.discard_unread()
            raise OSError(errno.ENOTCONN, "the peer left")  # the writer drops what was to be sent to it
        if not self._peers.present:
            raise OSError(errno.ENOTCONN, "no peer")
        return _write_fd(self._master, data)

    async def close(self) -> None:
        """Give the pseudo-terminal back and take away the symlink, if it still leads here."""
        if self._peers is None:
            return
        asyncio.get_running_loop().remove_reader(self._peers.fileno())
        self._drop_writer()
        if self._symlink is not None:
            with contextlib.suppress(OSError):
                if str(self._symlink.readlink()) == self._path:
                    self._symlink.unlink()
        self._peers.close()
        self._peers = None
        self._close_master()

    def _close_master(self) -> None:
        os.close(self._master)
        self._master = -1


class _ReturningSerial(_PacedTransport, ReturningTransport[bytes]):
    """A serial port that may vanish."""

    what = "serial"

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
        """Let go of the port, whatever its state."""


class TtyTransport(_ReturningSerial):
    """A tty opened by its path, through pyserial."""

    def __init__(self, path: str, baud: int, schedule: PacingSchedule | None) -> None:
        super().__init__(path, schedule)
        self._path = path
        self._baud = baud
        self._port: serial.Serial | None = None

    async def _attach(self) -> None:
        path = Path(self._path)
        if path.exists() and not path.is_char_device():
            raise TransportError(
                f"serial {self._path}: is no tty; name a serial port such as /dev/ttyUSB0, or auto for a pseudo-terminal"
            )
        try:
            with _termios_as_os_error():
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
            self._take(data)
        elif _hung_up(self._port.fileno()):
            self._lost("hung up")

    def _change_rate(self, baud: int) -> None:
        lost = ""
        if self._port is not None:
            try:
                with _termios_as_os_error():
                    if self._port.out_waiting:  # the kernel's buffer still leaves at the old rate
                        asyncio.get_running_loop().call_later(RATE_RETRY_S, self.set_baud, baud)
                        return
                    self._port.baudrate = baud
            except (OSError, ValueError) as error:
                if isinstance(error, ValueError) or error.errno == errno.EINVAL:
                    self._complain(
                        f"serial {self._path}: bit rate {baud} is not possible here; {self._baud} is kept"
                    )
                    return
                lost = error.strerror or str(error)
        self._baud = baud
        super()._change_rate(baud)
        if lost:  # the port comes back at the new rate
            self._lost(lost)

    def _write(self, data: bytes) -> int:
        if self._port is None:
            raise OSError(errno.EIO, "port is closed")
        try:
            return _write_fd(self._port.fileno(), data)
        except OSError as error:
            self._lost(error.strerror or str(error))
            raise

    def _detach(self) -> None:
        if self._port is not None:
            asyncio.get_running_loop().remove_reader(self._port.fileno())
            with contextlib.suppress(OSError):
                self._port.close()
            self._port = None


@contextlib.contextmanager
def _termios_as_os_error() -> Iterator[None]:
    """Raise what the terminal settings refuse as the OSError that it is, which `termios.error` does not derive from."""
    try:
        yield
    except termios.error as error:
        raise OSError(*error.args) from None


def _hung_up(fd: int) -> bool:
    poll = select.poll()
    poll.register(fd, select.POLLIN)
    return any(event & (select.POLLHUP | select.POLLERR | select.POLLNVAL) for _, event in poll.poll(0))


def _tty_problem(path: str, baud: int, error: Exception) -> str:
    number = getattr(error, "errno", None)
    if isinstance(error, ValueError):
        return f"serial {path}: bit rate {baud} is not possible here"
    if number in (errno.EBUSY, errno.EAGAIN):
        return f"serial {path}: busy, another program holds it; close that one"
    if number == errno.ENOENT:
        return f"serial {path}: no such port; plug the adapter in, or name another (auto makes a pseudo-terminal)"
    if number == errno.EACCES:
        return f"serial {path}: no permission; join the group that owns it (often dialout)"
    return f"serial {path}: cannot open: {os.strerror(number) if number else error}"


class _StreamProtocol(TurnProtocol):
    """Hands what a TCP connection brings to its transport."""

    def __init__(self, owner: _TcpTransport) -> None:
        super().__init__()
        self._owner = owner

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        if isinstance(transport, asyncio.Transport):
            notice_a_lost_peer(transport)
            self._owner.attach(self, transport)

    def data_received(self, data: bytes) -> None:
        self._owner.take(self, data)

    def connection_lost(self, exc: Exception | None) -> None:
        self._owner.ended(self, exc)


class _TcpTransport(_ReturningSerial):
    """Common part of both TCP forms."""

    def __init__(self, scheme: str, host: str, port: int, schedule: PacingSchedule | None) -> None:
        super().__init__(f"{scheme}://{host}:{port}", schedule)
        self._host = host
        self._port = port
        self._stream: asyncio.Transport | None = None
        self._protocol: _StreamProtocol | None = None

    def attach(self, protocol: _StreamProtocol, stream: asyncio.Transport) -> None:
        """Take a connection into use; a second one beside it is refused."""
        if self._stream is not None:
            stream.abort()
            return
        self._stream, self._protocol = stream, protocol

    def take(self, protocol: _StreamProtocol, data: bytes) -> None:
        """Take bytes of the connection in use."""
        if protocol is self._protocol:
            self._take(data)

    def ended(self, protocol: _StreamProtocol, error: Exception | None) -> None:
        """Note that a connection has ended."""
        if protocol is self._protocol:
            self._stream = self._protocol = None
            self._peer_gone(str(error) if error else "closed by the peer")

    @abstractmethod
    def _peer_gone(self, why: str) -> None:
        """React to the end of the connection."""

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

    def __init__(self, host: str, port: int, schedule: PacingSchedule | None) -> None:
        super().__init__("socket", host, port, schedule)

    async def _attach(self) -> None:
        loop = asyncio.get_running_loop()
        try:
            await loop.create_connection(lambda: _StreamProtocol(self), self._host, self._port)
        except (OSError, ValueError) as error:  # a name that cannot be a host's is a ValueError
            raise TransportError(
                f"serial {self.description}: cannot connect: {reason(error)}; start the peer first"
            ) from None

    def _peer_gone(self, why: str) -> None:
        self._lost(why)


class _ListenTransport(_TcpTransport):
    """A TCP port that one peer at a time may connect to; without a peer, bytes vanish as on an open line."""

    def __init__(self, host: str, port: int, schedule: PacingSchedule | None) -> None:
        super().__init__("listen", host, port, schedule)
        self._server: asyncio.Server | None = None

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
