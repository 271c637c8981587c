"""The worker process: makes and solves frames for the emulator that started it, over an inherited socket."""

from __future__ import annotations

import os
import pickle
import signal
import socket
import sys
from typing import Any, Final

from starhil.emulator.parent_death_signal import end_with_parent
from starhil.emulator.pipeline.frames import LENGTH, Failure

NICE: Final = 5
"""How much the worker stands back where processors are short: the links of the emulator come first."""


def main() -> None:
    """Take the setup, then requests, until the emulator closes the socket."""
    end_with_parent()  # closing the socket ends it too, but not in the middle of a long compilation
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the emulator ends this process by closing the socket
    os.nice(NICE)
    link = socket.socket(fileno=int(sys.argv[1]))
    from starhil.emulator.pipeline.pipeline import make_picture  # while the emulator itself still starts

    setup = _receive(link)
    if setup is None:
        return
    made = make_picture(setup)
    if isinstance(made, Failure):
        _send(link, made)
        return
    picture, warm = made
    _send(link, warm)
    while (request := _receive(link)) is not None:
        _send(link, picture.handle(request))


def _receive(link: socket.socket) -> Any:
    """Return the next message, or None at the end."""
    head = _read(link, LENGTH.size)
    if head is None:
        return None
    data = _read(link, LENGTH.unpack(head)[0])
    return None if data is None else pickle.loads(data)  # noqa: S301 (from our own parent process)


def _read(link: socket.socket, size: int) -> bytes | None:
    parts: list[bytes] = []
    while size > 0:
        try:
            part = link.recv(min(size, 1 << 20))
        except ConnectionError:
            return None
        if not part:
            return None
        parts.append(part)
        size -= len(part)
    return b"".join(parts)


def _send(link: socket.socket, message: object) -> None:
    data = pickle.dumps(message, protocol=pickle.HIGHEST_PROTOCOL)
    try:
        link.sendall(LENGTH.pack(len(data)) + data)
    except ConnectionError:
        raise SystemExit(0) from None


if __name__ == "__main__":
    main()
