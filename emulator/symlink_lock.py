"""A symlink, or any name, as the property of one running emulator.

An abstract socket named after it stands for the claim: it ends with its process, however that ends, and tells the
number of the process to whoever asks for the same name.
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


def claim_symlink(path: Path) -> socket.socket:
    """Claim a path for the symlink to a pseudo-terminal; the claim holds until the socket is closed.

    Raises
    ------
    EmulatorError
        Another emulator has it, or what is there was not made by one.
    """
    if path.is_symlink() and not str(path.readlink()).startswith("/dev/pts/"):
        raise EmulatorError(
            f"symlink {path}: leads to {path.readlink()}, so no emulator made it; choose another name"
        )
    place = path.parent.resolve() / path.name
    try:
        return claim_name("symlink", os.fsencode(place))
    except NameTakenError as error:
        raise EmulatorError(
            f"symlink {path}: in use by another emulator, process {error.owner}; end that one, or choose another name"
        ) from None


class NameTakenError(EmulatorError):
    """Another emulator has the name; `owner` is its process."""

    def __init__(self, owner: str) -> None:
        super().__init__(f"in use by another emulator, process {owner}")
        self.owner = owner


def claim_name(kind: str, name: bytes) -> socket.socket:
    """Claim a name of some kind on this machine; the claim holds until the socket is closed.

    Raises
    ------
    NameTakenError
        Another emulator has it.
    """
    address = f"\0starhil-{kind}-{hashlib.sha256(name).hexdigest()}".encode()
    claim = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        claim.bind(address)
        claim.listen()
    except OSError:
        claim.close()
        raise NameTakenError(_owner(address)) from None
    return claim


def _owner(name: bytes) -> str:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as asking:
        asking.setblocking(False)  # noqa: FBT003 (the call of the library)
        try:
            asking.connect(name)
        except OSError as error:
            return f"unknown ({error.strerror})"
        peer = asking.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _PEER.size)
        return str(_PEER.unpack(peer)[0])
