"""Serial transport over a pseudo-terminal, with detection of peers on its slave side.

Unlike a wire, a pseudo-terminal stores bytes for an absent reader. The master reports a hang-up while no
process has the slave side open; if one peer closes it and another opens it immediately, only inotify reports the change.
"""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import errno
import os
import select
import struct
import termios
import tty
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from starhil.protocol.transports.base import TransportError
from starhil.protocol.transports.paced import PacedTransport, termios_as_os_error, write_fd

_LIBC: Final = ctypes.CDLL(None, use_errno=True)
_IN_CLOSE: Final = 0x08 | 0x10
_IN_OPEN: Final = 0x20
_EVENT: Final = struct.Struct("iIII")
_EVENTS_SIZE: Final = 256 * _EVENT.size


class PtyPeers:
    """Watches the slave side of a pseudo-terminal, a path that this process must not have open, by its master.

    Without inotify (if the system has no free instance), a peer that is replaced at once goes unnoticed.
    """

    def __init__(self, master: int, path: str) -> None:
        self._master = master
        self._path = path
        self._hang_up = select.poll()
        self._hang_up.register(master, 0)
        self._events = _watch(path)
        self._wake = select.epoll()
        self._wake.register(master, select.EPOLLIN | select.EPOLLET)  # a hang-up lasts: report it once
        if self._events >= 0:
            self._wake.register(self._events, select.EPOLLIN)
        self._present = self.present

    def fileno(self) -> int:
        """Return the descriptor that is readable when data are waiting or a peer came or left."""
        return self._wake.fileno()

    def acknowledge(self) -> None:
        """Acknowledge a wake-up, so that the next event causes another."""
        self._wake.poll(0)

    @property
    def present(self) -> bool:
        """Whether a peer has the slave side open now."""
        return not self._hang_up.poll(0)

    def all_left(self) -> bool:
        """Return whether all peers have left at some time since the last call."""
        before, self._present = self._present, self.present
        return _replaced(self._new_events()) or (before and not self._present)

    def discard_unread(self) -> None:
        """Drop the bytes written to the master that have not been read."""
        termios.tcflush(self._master, termios.TCOFLUSH)  # on the way to the line discipline
        with contextlib.suppress(PermissionError, BlockingIOError):
            slave = os.open(self._path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
            try:
                termios.tcflush(slave, termios.TCIFLUSH)  # in the line discipline
            finally:
                os.close(slave)
        for _ in (
            self._new_events()
        ):  # of this call, and of peers that came since, for whom no stale bytes are left
            pass
        self._present = self.present

    def close(self) -> None:
        self._wake.close()
        if self._events >= 0:
            os.close(self._events)
            self._events = -1

    def _new_events(self) -> Iterator[int]:
        """Yield the masks of the events since the last call, oldest first."""
        while self._events >= 0:
            try:
                data = os.read(self._events, _EVENTS_SIZE)
            except BlockingIOError:
                return
            for _, mask, _, _ in _EVENT.iter_unpack(data):  # events of a watched file carry no names
                yield mask


def _replaced(events: Iterator[int]) -> bool:
    """Return whether the file was opened after it had been closed."""
    closed = replaced = False
    for mask in events:
        closed |= bool(mask & _IN_CLOSE)
        replaced |= closed and bool(mask & _IN_OPEN)
    return replaced


def _watch(path: str) -> int:
    """Return an inotify descriptor that reports when a file is opened or closed, or -1 if none is free."""
    events = int(_LIBC.inotify_init1(os.O_NONBLOCK | os.O_CLOEXEC))
    if events >= 0 and _LIBC.inotify_add_watch(events, os.fsencode(path), _IN_OPEN | _IN_CLOSE) < 0:
        os.close(events)
        return -1
    return events


def _free_name(link: Path) -> None:
    """Remove a symlink that an earlier run has left, and check that another can be made in its place."""
    if link.exists() and not link.is_symlink():
        raise TransportError(f"serial: {link} exists and is not a symlink; choose another name")
    with _beside(link) as temporary:
        temporary.symlink_to(link.name)
    link.unlink(missing_ok=True)


@contextlib.contextmanager
def _beside(link: Path) -> Iterator[Path]:
    """Give the path of a temporary file in the folder of a symlink, and leave nothing there."""
    temporary = link.with_name(f".{link.name}.{os.getpid()}")
    try:
        yield temporary
    finally:
        temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def _symlink_errors(link: Path) -> Iterator[None]:
    """Report that a symlink cannot be made, such as one of another user in /tmp."""
    try:
        yield
    except OSError as error:
        raise TransportError(f"serial: cannot make the symlink {link}: {error.strerror}") from None


class PtyTransport(PacedTransport):
    """A new pseudo-terminal; peers open its slave side like any tty, as often as they want.

    As on a wire, bytes sent while no peer has the slave side open are lost; so are bytes that a peer has not
    read when it leaves. The symlink is made by `publish` and removed by `close`.
    """

    def __init__(self, pace: int | None, symlink: Path | None) -> None:
        super().__init__("pty", pace)
        self._symlink = symlink
        self._path = ""
        self._master = -1
        self._peers: PtyPeers | None = None
        self._next_read: asyncio.Handle | None = None
        """The next read, scheduled while data is waiting."""

    async def _open(self) -> None:
        try:
            self._master, slave = os.openpty()
        except OSError as error:
            raise TransportError(
                f"serial pty: no pseudo-terminal is available ({error.strerror}): mount devpts on /dev/pts, "
                "name a serial port, or do without it (--serial off)"
            ) from None
        try:
            with termios_as_os_error():
                tty.setraw(slave)
            os.set_blocking(self._master, False)
            self._path = os.ttyname(slave)
            if self._symlink is not None:
                with _symlink_errors(self._symlink):
                    _free_name(self._symlink)
        except (OSError, TransportError) as error:
            os.close(self._master)
            if isinstance(error, TransportError):
                raise
            raise TransportError(f"serial pty: cannot be set up: {error.strerror}; try again") from None
        finally:
            os.close(slave)  # the master reports a hang-up while no peer has it open
        self.description = str(self._symlink) if self._symlink is not None else self._path
        self._peers = PtyPeers(self._master, self._path)
        asyncio.get_running_loop().add_reader(self._peers.fileno(), self._woken)

    def publish(self) -> None:
        """Make the symlink, atomically."""
        if self._symlink is None:
            return
        with _symlink_errors(self._symlink), _beside(self._symlink) as temporary:
            temporary.symlink_to(self._path)
            temporary.replace(self._symlink)

    def _woken(self) -> None:
        """Note a wake-up; each write of a peer causes one, and stands for all waiting data."""
        if self._peers is not None:
            self._peers.acknowledge()
            if self._next_read is None:
                self._readable()

    def _readable(self) -> None:
        """Read once per turn of the loop while data is waiting, however often the peer writes."""
        self._next_read = None
        if self._peers is None:
            return
        self._drop_unread(self._peers)
        try:
            data = os.read(self._master, self.read_size)
        except BlockingIOError:
            return
        except OSError as error:
            if error.errno != errno.EIO:  # EIO: no peer has the slave side open
                self._report_error(f"serial {self.description}: {error.strerror}")
            return
        self._next_read = asyncio.get_running_loop().call_soon(self._readable)
        self._process_received(data)

    def _drop_unread(self, peers: PtyPeers) -> bool:
        """Drop bytes that a closed peer has not read, and bytes queued for it; return whether a peer has closed the port."""
        if peers.all_left():
            self._clear()
            peers.discard_unread()
            return True
        return False

    def _has_peer(self) -> bool:
        if self._peers is None:
            return False
        self._drop_unread(self._peers)
        return self._peers.present

    def _write(self, data: bytes) -> int:
        if self._peers is None or self._drop_unread(self._peers) or not self._peers.present:
            raise OSError(errno.ENOTCONN, "no peer")
        return write_fd(self._master, data)

    async def close(self) -> None:
        """Close the pseudo-terminal and remove the symlink if it still points to it."""
        if self._peers is None:
            return
        asyncio.get_running_loop().remove_reader(self._peers.fileno())
        self._clear()
        if self._symlink is not None:
            with contextlib.suppress(OSError):
                if str(self._symlink.readlink()) == self._path:
                    self._symlink.unlink()
        self._peers.close()
        self._peers = None
        os.close(self._master)
