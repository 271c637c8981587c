"""Who has the slave side of a pseudo-terminal open.

A wire keeps nothing for a reader that is not there, a pseudo-terminal does. Its master hangs up while nobody has the
slave side open; a peer that leaves while another comes at once is seen by the openings and closings that inotify reports.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import select
import struct
import termios
from collections.abc import Iterator
from typing import Final

_LIBC: Final = ctypes.CDLL(None, use_errno=True)
_IN_CLOSE: Final = 0x08 | 0x10
_IN_OPEN: Final = 0x20
_EVENT: Final = struct.Struct("iIII")
_EVENTS_SIZE: Final = 256 * _EVENT.size


class PtyPeers:
    """Watches the slave side of a pseudo-terminal that this process does not hold open itself.

    Parameters
    ----------
    master
        File descriptor of the master side.
    path
        Path of the slave side.

    Without inotify (the system's instances are used up) only a peer that leaves and is not replaced at once is noticed.
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
        """File descriptor that is readable when there is something to read, or peers came or left."""
        return self._wake.fileno()

    def acknowledge(self) -> None:
        """Take note of the wake-up: the next one comes when there is more."""
        self._wake.poll(0)

    @property
    def present(self) -> bool:
        """Whether anybody has the slave side open now."""
        return not self._hang_up.poll(0)

    def all_left(self) -> bool:
        """Whether all peers have left since the last call, if only for a moment."""
        before, self._present = self._present, self.present
        return _replaced(self._new_events()) or (before and not self._present)

    def discard_unread(self) -> None:
        """Drop what was written to the master and not read."""
        termios.tcflush(self._master, termios.TCOFLUSH)  # what is on its way to the line discipline
        with contextlib.suppress(PermissionError, BlockingIOError):
            slave = os.open(self._path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
            try:
                termios.tcflush(slave, termios.TCIFLUSH)  # what the line discipline holds
            finally:
                os.close(slave)
        for _ in self._new_events():  # this visit, and whoever came since: nothing stale is left for them
            pass
        self._present = self.present

    def close(self) -> None:
        """Give the descriptors back."""
        self._wake.close()
        if self._events >= 0:
            os.close(self._events)
            self._events = -1

    def _new_events(self) -> Iterator[int]:
        """Masks of the events since the last call, oldest first."""
        while self._events >= 0:
            try:
                data = os.read(self._events, _EVENTS_SIZE)
            except BlockingIOError:
                return
            for _, mask, _, _ in _EVENT.iter_unpack(data):  # a file by itself: events carry no names
                yield mask


def _replaced(events: Iterator[int]) -> bool:
    """Whether somebody opened the file after somebody had closed it."""
    closed = replaced = False
    for mask in events:
        closed |= bool(mask & _IN_CLOSE)
        replaced |= closed and bool(mask & _IN_OPEN)
    return replaced


def _watch(path: str) -> int:
    """File descriptor of the openings and closings of a file, or -1 where the system gives none."""
    events = int(_LIBC.inotify_init1(os.O_NONBLOCK | os.O_CLOEXEC))
    if events >= 0 and _LIBC.inotify_add_watch(events, os.fsencode(path), _IN_OPEN | _IN_CLOSE) < 0:
        os.close(events)
        return -1
    return events
