"""Output of the commands of `starhil`: what they compile, files and documents."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import ParamSpec, TypeVar

from starhil.emulator.errors import explained
from starid.cli.output import compiling_reported, prepare_output

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


def compiles(command: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Let a command that compiles kernels report it; those that start an emulator do so by themselves."""

    @functools.wraps(command)
    def reporting(*args: Parameters.args, **options: Parameters.kwargs) -> Result:
        with compiling_reported():
            return command(*args, **options)

    return reporting


@contextmanager
def writing(path: Path, sources: Iterable[Path | None] = ()) -> Iterator[None]:
    """Write the file of an option -o, which is none of the sources, and whose folder is made; a failure is one line."""
    from starid.storage.files import removing_new_folders_on_error

    with removing_new_folders_on_error(path.parent):
        prepare_output(path, "-o", sources)
        with explained(f"{path}: cannot be written", "choose another file with -o"):
            yield


def print_text(text: str) -> None:
    """Print a document as UTF-8 in any locale."""
    sys.stdout.flush()
    sys.stdout.buffer.write(text.encode())
    sys.stdout.buffer.flush()
