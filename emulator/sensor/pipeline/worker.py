"""The pipeline worker: renders and solves frames for the emulator over a socket, in a process or a thread."""

from __future__ import annotations

import gc
import os
import pickle
import signal
import socket
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final

from starhil.emulator.errors import one_line
from starhil.emulator.sensor.pipeline.messages import LENGTH, Failure, with_length
from starhil.emulator.sensor.pipeline.precompile import start_helper
from starhil.emulator.simulation.parent_death_signal import end_with_parent

if TYPE_CHECKING:
    from starhil.emulator.sensor.pipeline.pipeline import Pipeline

NICE: Final = 5
"""Niceness of the worker, so that the links have priority on a busy machine."""


def main() -> None:
    """Serve the emulator over an inherited socket."""
    end_with_parent(int(sys.argv[2]))  # a closed socket is not noticed during a long compilation
    for number in (signal.SIGHUP, signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)  # the emulator ends this process by closing the socket
    os.nice(NICE)
    serve(socket.socket(fileno=int(sys.argv[1])), started=gc.freeze)  # what was imported is never garbage


def call_first_kernel() -> None:
    """Call a kernel while SciPy's linear algebra cannot be imported, for which numba looks once, but which no kernel calls.

    It would take 15 MB and a tenth of the start of the worker. Nothing is done if it has been imported, as by an earlier kernel, or
    could be by another thread.
    """
    if "scipy.linalg" in sys.modules or threading.active_count() > 1:
        return
    from starid.camera import Camera

    sys.modules["scipy.linalg"] = None  # type: ignore[assignment]
    try:
        Camera.from_fov().back_project([[0.0, 0.0]])
    finally:
        del sys.modules["scipy.linalg"]


def serve_in_thread(link: socket.socket) -> None:
    """Serve the emulator, and report an unexpected end."""
    with link, suppress(SystemExit):  # with which `_send` ends once the emulator has closed the socket
        try:
            serve(link)
        except BaseException as error:  # noqa: BLE001 (its pending requests must fail)
            _send(link, f"pipeline thread: ended: {one_line(error)}")


def serve(link: socket.socket, started: Callable[[], None] = lambda: None) -> None:
    """Receive the setup, then requests, until the emulator closes the socket; `started` is called when the pipeline is ready."""
    gc.disable()  # imports and compiling make many objects and little garbage
    try:
        pipeline = _start(link)
        started()
    finally:
        gc.enable()
    if pipeline is None:
        return
    while (request := _receive(link)) is not None:
        _send(link, pipeline.handle(request))


def _start(link: socket.socket) -> Pipeline | None:
    """Make the pipeline of the setup that is received, and report it; return None if there is none."""
    helper = start_helper()
    call_first_kernel()
    from starhil.emulator.sensor.pipeline.pipeline import make_pipeline  # imported while the emulator starts

    setup = _receive(link)
    if setup is None:
        return None
    made = make_pipeline(setup, helper)
    if isinstance(made, Failure):
        _send(link, made)
        return None
    pipeline, warm = made
    _send(link, warm)
    return pipeline


def _receive(link: socket.socket) -> Any:
    """Return the next message, or None once the socket is closed."""
    head = _read(link, LENGTH.size)
    if head is None:
        return None
    data = _read(link, LENGTH.unpack(head)[0])
    return None if data is None else pickle.loads(data)  # noqa: S301 (from our own parent process)


def _read(link: socket.socket, size: int) -> bytes | None:
    chunks: list[bytes] = []
    while size > 0:
        try:
            chunk = link.recv(min(size, 1 << 20))
        except ConnectionError:
            return None
        if not chunk:
            return None
        chunks.append(chunk)
        size -= len(chunk)
    return b"".join(chunks)


def _send(link: socket.socket, message: object) -> None:
    try:
        link.sendall(with_length(message))
    except ConnectionError:
        raise SystemExit(0) from None


if __name__ == "__main__":
    main()
