"""The Unix socket of a control channel, which is private to its user and removed at the end."""

from __future__ import annotations

import contextlib
import os
import socket
import stat
import tempfile
from itertools import islice
from pathlib import Path
from typing import Final

from starhil.emulator.errors import EmulatorError, explained
from starhil.emulator.links.name_lock import LockError, lock_name

PRIVATE_FOLDER: Final = 0o700
PRIVATE_SOCKET: Final = 0o600
PREFIX: Final = "control-"
"""Begin of the name of a default socket, before the process ID."""
MAX_STALE: Final = 1000
"""Number of sockets of killed emulators that a start removes."""


class ControlSocket:
    """A listening socket and its file."""

    def __init__(self, path: Path) -> None:
        if not path.is_absolute() or any(character.isspace() or character == "\0" for character in str(path)):
            raise EmulatorError(f"--control unix:{path}: must be an absolute path without spaces")
        self.path = path
        try:
            self._lock = _lock(path)
        except LockError as error:
            raise EmulatorError(f"control channel unix:{path}: {error}; choose another path") from None
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._file: os.stat_result | None = None
        what = f"control channel unix:{path}: cannot listen"
        try:
            with explained(what, "choose another path", errors=(OSError, ValueError)):
                _remove_stale(path)
                self.socket.bind(str(path))
                path.chmod(PRIVATE_SOCKET)  # no client can connect before it listens
                self._file = path.lstat()
                self.socket.listen()
        except EmulatorError:
            self.close()
            raise

    def close(self) -> None:
        """Stop listening, and remove the file if it still belongs to this socket."""
        self.socket.close()
        self._lock.close()
        if self._file is not None:
            with contextlib.suppress(OSError):
                if os.path.samestat(self.path.lstat(), self._file):
                    self.path.unlink()
            self._file = None


def automatic_path() -> Path:
    """Return the default socket path of this process, in a folder private to its user; remove those of killed emulators."""
    base = Path(os.environ.get("XDG_RUNTIME_DIR") or "/nonexistent")
    folder = (
        base / "starhil" if _is_own_folder(base) else Path(tempfile.gettempdir()) / f"starhil-{os.geteuid()}"
    )
    with explained(f"control channel: {folder} cannot be used", "give --control unix:/PATH"):
        folder.mkdir(mode=PRIVATE_FOLDER, exist_ok=True)
        if not _is_own_folder(folder):
            raise EmulatorError(
                f"control channel: {folder} belongs to another user; give --control unix:/PATH"
            )
        folder.chmod(PRIVATE_FOLDER)
    for path in islice(folder.glob(f"{PREFIX}*"), MAX_STALE):
        with (
            contextlib.suppress(OSError, EmulatorError),
            _lock(path),
        ):  # whoever has the lock is about to listen
            _remove_stale(path)
    return folder / f"{PREFIX}{os.getpid()}"


def _lock(path: Path) -> socket.socket:
    return lock_name("control", os.fsencode(path.parent.resolve() / path.name))


def _remove_stale(path: Path) -> None:
    """Remove the socket that a killed emulator left behind; EmulatorError if a path is something else."""
    try:
        mode = path.lstat().st_mode
    except FileNotFoundError:
        return
    if not stat.S_ISSOCK(mode):
        raise EmulatorError(f"control channel unix:{path}: is not a socket; choose another path")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.setblocking(False)  # noqa: FBT003 (the call of the library)
        try:
            probe.connect(str(path))
        except ConnectionRefusedError:
            path.unlink()
            return
        except BlockingIOError:
            pass  # another program listens, and is busy
    raise EmulatorError(f"control channel unix:{path}: in use by another program; choose another path")


def _is_own_folder(folder: Path) -> bool:
    try:
        status = folder.lstat()
    except OSError:
        return False
    return stat.S_ISDIR(status.st_mode) and status.st_uid == os.geteuid()
