"""Output of commands: files, tables, and text for any terminal."""

from __future__ import annotations

import codecs
import io
import itertools
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Protocol, TextIO, TypeAlias

from starid.errors import StaridError
from starid.storage.files import check_links, is_stdout

if TYPE_CHECKING:
    from rich.console import Console


class ShowProgress(Protocol):
    """Shows how much is done of how much, and what is being done."""

    def __call__(self, done: float, total: float, name: str = ...) -> None: ...


Column: TypeAlias = tuple[str, Callable[[Any], str]]
"""Heading of a column, and the function that formats a row for it."""

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
"""Time after which the progress of compiling is reported, and between reports on a terminal, seconds."""

LOG_S: Final = 30.0
"""Time between reports if stderr is no terminal, so that they do not fill a log, seconds."""

COMPILED_S: Final = 120.0
"""Time without a new kernel after which the cache is no longer searched for more, as that would disturb a benchmark, seconds."""


@contextmanager
def compiling_reported(*, start: bool = False) -> Iterator[None]:
    """Meanwhile, report on stderr how many kernels were added to the cache, by this process or another, whenever there are more.

    Of a `start`, the time that it takes is reported too, also if nothing is compiled.
    """
    ended = threading.Event()

    def report() -> None:
        begin_s, begin_unix_s = time.monotonic(), time.time()
        if ended.wait(PROGRESS_S):
            return
        from starid.storage import cache

        written, reported, compiled, grown_s, due_s = 0, 0, "", begin_s, begin_s
        while True:
            before, written = written, cache.kernels_written_since(begin_unix_s)
            now_s = time.monotonic()
            if written > before:
                grown_s = now_s
                compiled = f", kernels added to the cache: {written}; later runs use them"
            if now_s >= due_s and (start or written > reported):
                what = "starting" if start else "compiling"
                print(f"{what}: {now_s - begin_s:.0f} s{compiled}", file=sys.stderr, flush=True)
                reported, due_s = written, now_s + (0.0 if sys.stderr.isatty() else LOG_S)
            done = not start and now_s - grown_s > COMPILED_S
            if done or ended.wait(PROGRESS_S):
                return

    threading.Thread(target=report, daemon=True).start()
    try:
        yield
    finally:
        ended.set()


def output_help(what: str) -> str:
    """Return the help of an option that names an output file."""
    return f"{what} Missing folders are created; /dev/stdout is standard output."


def prepare_output(path: Path, option: str, sources: Iterable[Path | None] = ()) -> Path:
    """Create the folder of an output file, so that an invalid path fails before the work starts.

    Raises
    ------
    StaridError
        The folder cannot be created, or the path is a folder, or a link of another user, or one of the sources, the files that
        are read.
    """
    if path.is_dir():
        raise StaridError(f"{path}: is a folder; name a file with {option}")
    if path.is_file() and any(
        source is not None and source.exists() and path.samefile(source) for source in sources
    ):
        raise StaridError(f"{path}: is a file that is read; name another one with {option}")
    try:
        check_links(path)
    except PermissionError as error:
        raise StaridError(
            f"{path}: cannot be written ({error.strerror}); choose another file with {option}"
        ) from None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StaridError(
            f"{path}: its folder cannot be created ({error.strerror}); choose another file with {option}"
        ) from None
    return path


def prepare_folder(path: Path, option: str) -> None:
    """Create a folder for results, so that an invalid path fails before the work starts.

    Raises
    ------
    StaridError
        The folder cannot be created, or the path is a file.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise StaridError(f"{path}: is not a folder; name one with {option}") from None
    except OSError as error:
        raise StaridError(
            f"{path}: cannot be created ({error.strerror}); choose another folder with {option}"
        ) from None


def report_stream(output: Path | None) -> TextIO:
    """Return the stream for the report of a command: stderr if its output file is stdout, or else stdout."""
    return sys.stderr if output is not None and is_stdout(output) else sys.stdout


@contextmanager
def progress_shown(work: str, console: Console | None = None) -> Iterator[ShowProgress]:
    """Show how much of some work is done: by a bar on a terminal, otherwise by a line on stderr every `LOG_S`.

    Gives a function of what is done, how much there is, and, if this changes, the name of what is being done. The bar is on
    stderr, or on the console that the results are printed on.
    """
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    console = console or Console(stderr=True)
    if not console.is_terminal:
        begin_s = reported_s = time.monotonic()

        def print_line(done: float, total: float, name: str = work) -> None:
            nonlocal reported_s
            now_s = time.monotonic()
            if now_s - reported_s >= LOG_S:
                reported_s = now_s
                print(
                    f"{name}: {done:.0f} of {total:.0f} after {now_s - begin_s:.0f} s",
                    file=sys.stderr,
                    flush=True,
                )

        yield print_line
        return
    columns = (
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.description}", markup=False),
    )
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(work, total=None)
        yield lambda done, total, name=work: bar.update(task, completed=done, total=total, description=name)


@contextmanager
def steps_shown(work: str, total: int, console: Console | None = None) -> Iterator[Callable[..., None]]:
    """Show how many of some steps are done, as `progress_shown` does; gives a function to call after each, with its name if it has one."""
    done = itertools.count(1)
    with progress_shown(work, console) as show:
        yield lambda name=work: show(next(done), total, name)


def progress() -> Callable[[str], None]:
    """Return a function that prints progress to stderr."""
    from rich.console import Console

    return Console(stderr=True).print


def print_table(columns: Sequence[Column], rows: Iterable[Any]) -> None:
    """Print a table in full width, even in a narrower terminal."""
    from rich.box import SIMPLE
    from rich.console import Console
    from rich.table import Table

    table = Table(*(heading for heading, _ in columns), box=SIMPLE)
    for row in rows:
        table.add_row(*(show(row) for _, show in columns))
    console = Console()
    console.width = max(console.width, Console(width=1000).measure(table).maximum)
    console.print(table)


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
