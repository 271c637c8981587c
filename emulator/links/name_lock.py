"""Locks on symlinks and other names, held by one running emulator each.

A lock is an abstract Unix socket. The kernel releases it when the process ends, and reports the process ID to another
process that connects to it. Abstract sockets belong to a network namespace, so emulators in different containers
do not share locks.
"""

from __future__ import annotations

import errno
import hashlib
import os
import socket
import struct
from pathlib import Path
from typing import Final

from starhil.emulator.errors import EmulatorError

_PEER: Final = struct.Struct("3i")
"""Process, user and group of the peer of a local socket."""


def lock_symlink(path: Path) -> socket.socket:
    """Lock the path of a symlink to a pseudo-terminal until the socket is closed."""
    if path.is_symlink() and not str(path.readlink()).startswith("/dev/pts/"):
        raise EmulatorError(
            f"symlink {path}: points to {path.readlink()}, so it was not made by an emulator; choose another name"
        )
    try:
        return lock_name("symlink", os.fsencode(path.parent.resolve() / path.name))
    except LockError as error:
        raise EmulatorError(f"symlink {path}: {error}; choose another name") from None


class LockError(EmulatorError):
    """A name cannot be locked; the text gives the reason, usually another emulator with its process ID."""


class InUseError(LockError):
    """Another emulator has the lock."""


def lock_name(kind: str, name: bytes) -> socket.socket:
    """Lock a name of some kind in this network namespace until the socket is closed.

    InUseError if another emulator uses the name, another LockError if the operating system cannot make the lock.
    """
    address = f"\0starhil-{kind}-{hashlib.sha256(name).hexdigest()}".encode()
    lock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        lock.bind(address)
        lock.listen()
    except OSError as error:
        lock.close()
        if error.errno == errno.EADDRINUSE:
            raise InUseError(f"in use by another emulator, process {_owner(address)}") from None
        raise LockError(f"cannot be locked ({error.strerror})") from None
    return lock


def _owner(name: bytes) -> str:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.setblocking(False)  # noqa: FBT003 (the call of the library)
        try:
            probe.connect(name)
        except OSError as error:
            return f"unknown ({error.strerror})"
        peer = probe.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _PEER.size)
        return str(_PEER.unpack(peer)[0])
