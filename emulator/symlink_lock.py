"""Locks on symlinks and other names, each held by one running emulator.

The lock is an abstract Unix socket named after it. The kernel releases it when the process ends, and
reports the process ID to another process that connects to it.
"""

from __future__ import annotations

import hashlib
import os
import socket
import struct
from pathlib import Path
from typing import Final

from starhil.emulator.errors import EmulatorError

_PEER: Final = struct.Struct("3i")
"""Process, user and group at the other end of a local socket."""


def lock_symlink(path: Path) -> socket.socket:
    """Lock the path of a symlink to a pseudo-terminal until the socket is closed.

    Raises
    ------
    EmulatorError
        Another emulator uses it, or the existing symlink was not made by an emulator.
    """
    if path.is_symlink() and not str(path.readlink()).startswith("/dev/pts/"):
        raise EmulatorError(
            f"symlink {path}: points to {path.readlink()}, so no emulator made it; choose another name"
        )
    try:
        return lock_name("symlink", os.fsencode(path.parent.resolve() / path.name))
    except NameTakenError as error:
        raise EmulatorError(
            f"symlink {path}: in use by another emulator, process {error.owner}; end that one, or choose another name"
        ) from None


class NameTakenError(EmulatorError):
    """Another emulator uses the name; `owner` is its process ID."""

    def __init__(self, owner: str) -> None:
        super().__init__(f"in use by another emulator, process {owner}")
        self.owner = owner


def lock_name(kind: str, name: bytes) -> socket.socket:
    """Lock a name of some kind on this machine until the socket is closed.

    Raises
    ------
    NameTakenError
        Another emulator uses it.
    """
    address = f"\0starhil-{kind}-{hashlib.sha256(name).hexdigest()}".encode()
    lock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        lock.bind(address)
        lock.listen()
    except OSError:
        lock.close()
        raise NameTakenError(_owner(address)) from None
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
