"""Output of the commands of `starhil`: the progress of a slow start, and documents."""

from __future__ import annotations

import asyncio
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from starhil.emulator.errors import explained
from starid.cli.output import prepare_output

PROGRESS_S: Final = 5.0
"""Time after which the progress of a slow start is reported, and between reports, seconds."""
PIPELINE: Final = "starhil.emulator.sensor.pipeline.pipeline"
"""The module whose kernels every start compiles."""


async def report_slow_start(algorithms: Iterable[str]) -> None:
    """Report the progress of a start with some algorithms on stderr every `PROGRESS_S`, until cancelled."""
    from starid.identification.options import ALGORITHMS
    from starid.kernels.compile_progress import CompileProgress
    from starid.storage.cache import kernels_written_since

    begin_s, begin_unix_s = time.monotonic(), time.time()
    await asyncio.sleep(PROGRESS_S)
    progress = CompileProgress([PIPELINE, *(ALGORITHMS[name].module for name in algorithms)])
    at_most = len(progress.kernels)  # some options need fewer
    while True:
        reason = ""
        if kernels_written_since(begin_unix_s):
            reason = f", {progress.compiled()} of at most {at_most} kernels compiled; later starts use them"
        print(f"starting: {time.monotonic() - begin_s:.0f} s{reason}", file=sys.stderr, flush=True)
        await asyncio.sleep(PROGRESS_S)


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
