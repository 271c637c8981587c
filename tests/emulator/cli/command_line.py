"""The command line, run in the process of the tests."""

from __future__ import annotations

import contextlib
import io
import signal
import sys
from collections.abc import Iterator
from unittest import mock

import pytest

from starhil.emulator.cli import app as starhil
from starhil.emulator.cli.termination import ENDING
from starid.cli import app as starid


@contextlib.contextmanager
def signals_as_before() -> Iterator[None]:
    """Let the tests that follow get the signals that a command which has served ignores until its process ends."""
    handlers = {number: signal.getsignal(number) for number in ENDING}
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)


def run_command_line(
    *arguments: str, encoding: str = "utf-8", program: str = "starhil"
) -> tuple[int, str, str]:
    """Run `starhil` or `starid`; return exit status, standard output and standard error."""
    out, err = (io.TextIOWrapper(io.BytesIO(), encoding, write_through=True) for _ in range(2))
    with (
        signals_as_before(),
        mock.patch.object(sys, "argv", [program, *arguments]),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
        pytest.raises(SystemExit) as end,
    ):
        {"starhil": starhil, "starid": starid}[program].main()
    assert isinstance(end.value.code, int)
    return end.value.code, _text(out), _text(err)


def log_lines(errors: str) -> list[str]:
    """Lines on stderr, but for those of kernels that are not in the cache yet."""
    return [line for line in errors.splitlines() if not line.startswith(("starting:", "compiling:"))]


def _text(stream: io.TextIOWrapper) -> str:
    assert isinstance(stream.buffer, io.BytesIO)
    return stream.buffer.getvalue().decode(stream.encoding)
