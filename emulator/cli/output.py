"""Output of commands: files, and text for any terminal."""

from __future__ import annotations

import asyncio
import codecs
import io
import sys
import time
from pathlib import Path
from typing import Final, TextIO

from starhil.emulator.errors import EmulatorError

_PLAIN: Final = {
    "°": " deg",
    "″": '"',
    "′": "'",
    "×": "x",
    "±": "+/-",
    "÷": "/",
    "−": "-",
    "–": "-",
    "—": "-",
    "…": "...",
    "·": "*",
    "≤": "<=",
    "≥": ">=",
    "→": "->",
    "²": "^2",
    "⁻": "^-",
    "√": "sqrt",
    "σ": "sigma",
    "κ": "kappa",
    "μ": "mu",
    "µ": "u",
    "π": "parallax",
}
"""Replacements for characters that the encoding of an output lacks."""

_HANDLER: Final = "starhil-plain"

PROGRESS_S: Final = 5.0
"""Time after which the progress of a slow start is reported, and between reports, seconds."""


def output_help(what: str) -> str:
    """Return the help of an option that names an output file."""
    return f"{what} Missing folders are created; /dev/stdout is standard output."


def prepare_output(path: Path, option: str) -> Path:
    """Create the folder of an output file, so that an invalid path fails before the work starts.

    Raises
    ------
    EmulatorError
        The folder cannot be created, or the path is a folder.
    """
    if path.is_dir():
        raise EmulatorError(f"{path}: is a folder; name a file with {option}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise EmulatorError(
            f"{path}: its folder cannot be created ({error.strerror}); choose another file with {option}"
        ) from None
    return path


def report_stream(output: Path | None) -> TextIO:
    """Return the stream for the report of a command: stderr if its output file is stdout, or else stdout."""
    from starid.files import is_stdout

    return sys.stderr if output is not None and is_stdout(output) else sys.stdout


async def report_slow_start() -> None:
    """Report the progress of a start on stderr every `PROGRESS_S`, until cancelled."""
    from starid.cache import kernels_written_since

    begin_s = time.time()
    while True:
        await asyncio.sleep(PROGRESS_S)
        compiled = kernels_written_since(begin_s)
        reason = f", {compiled} kernels compiled; later starts use them" if compiled else ""
        print(f"starting: {time.time() - begin_s:.0f} s{reason}", file=sys.stderr, flush=True)


def print_text(text: str) -> None:
    """Print a document as UTF-8 in any locale."""
    sys.stdout.flush()
    sys.stdout.buffer.write(text.encode())
    sys.stdout.buffer.flush()


def show_every_character() -> None:
    """Make stdout and stderr replace characters that their encoding lacks."""
    codecs.register_error(_HANDLER, _spell_out)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors=_HANDLER)


def _spell_out(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    missing = error.object[error.start : error.end]
    return "".join(
        _PLAIN.get(c) or c.encode("ascii", "backslashreplace").decode() for c in missing
    ), error.end
