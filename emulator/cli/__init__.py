"""The command line; `main` is its entry point."""

from __future__ import annotations

import gc
import signal
import sys
from contextlib import suppress
from pathlib import Path

from starid.errors import StaridError
from starid.storage.working_folder import check_working_folder


def main() -> None:
    """Run the command line; Ctrl-C during imports ends it without a traceback."""
    if sys.maxsize < 2**32:
        raise SystemExit("starhil: needs a 64-bit system: x86-64 or arm64")
    try:
        check_working_folder()
    except StaridError as error:
        raise SystemExit(f"starhil: {error}") from None
    try:
        if sys.argv[1:2] == ["run"] and "--help" not in sys.argv:
            for number in (signal.SIGTERM, signal.SIGHUP):
                if signal.getsignal(number) is not signal.SIG_IGN:  # as under nohup
                    signal.signal(number, _end)
            if not any(map(_names_worker, sys.argv[2:])):
                from starhil.emulator.sensor.pipeline.worker_process import start_ahead

                start_ahead()  # the worker takes longest to start, so it is started before the imports of this process
            gc.disable()  # until the emulator is ready: imports make many objects and little garbage
        from starhil.emulator.cli.app import main as run
    except KeyboardInterrupt:
        raise SystemExit(130) from None
    run()


def _names_worker(word: str) -> bool:
    """Whether a word of the command line, or the profile that it names, may choose a run without a worker process."""
    if not word.endswith(".toml"):
        return "run.worker=" in word
    with suppress(OSError):
        return Path(word).is_file() and b"worker" in Path(word).read_bytes()
    return False  # the profile is read later, with an error that names it


def _end(_number: int, _frame: object) -> None:
    """End a run that starts with the status of one that is ended later, when the event loop has the signals."""
    raise SystemExit(0)
