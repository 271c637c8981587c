"""Truth and orbit files are read in a process of their own, unless they are small text.

Whoever makes such a file decides how long it takes to read, how much memory that needs, and what SPICE, a library in C,
does with it. Here none of this delays a reply, keeps the run from its end, or ends it: the process has half of the
machine's memory and a low priority, and ends with the one that has started it, or when nobody waits for the file any more.

It writes one line of JSON, either the problems, or what is not an array and the number of arrays; and then the arrays,
as `numpy.save` does.
"""

from __future__ import annotations

import json
import logging
import os
import resource
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import astuple
from pathlib import Path
from types import SimpleNamespace
from typing import IO, Any, Final, Literal, TypeAlias, TypeVar

import numpy as np

from starhil.emulator.errors import EmulatorError
from starhil.emulator.simulation.parent_death_signal import end_with_parent
from starhil.emulator.simulation.threads import call_within, is_abandoned
from starhil.emulator.truth.file import read_orbit_file, read_truth_file
from starhil.emulator.truth.spice_file import META_KERNEL
from starhil.emulator.truth.table import Attitudes, FileTruth, Orbits, OrbitTable, Span
from starhil.protocol.files.user_file import open_user_file
from starid.errors import StaridError

log = logging.getLogger("starhil.truth")

AT_ONCE_BYTES: Final = 500_000
"""Size up to which a text is read in the process of the run, which takes a thread of it half a second."""

LONGEST_S: Final = 3600
"""Longest time for which a file is read, seconds: SPICE may never end."""

SILENT_S: Final = 30
"""Time for which nothing of a file is read, seconds, after which it never will be: it names a pipe, or its folder is on a
network whose server does not answer."""

LOOK_S: Final = 0.1
"""Interval at which a process is looked at, seconds."""

MAX_PROCESSES: Final = 4
"""Number of processes that read at a time; those that nobody waits for any more make room within `LOOK_S`."""

_ROOM: Final = threading.BoundedSemaphore(MAX_PROCESSES)

NICER: Final = 15
"""By how much the process is nicer than the run, so that the bus and the pipeline are served first."""

NICEST: Final = 19
"""Lowest priority of a process."""

Kind: TypeAlias = Literal["truth", "orbit"]
Content = TypeVar("Content")


def read_truth(path: Path) -> FileTruth:
    """Read a truth file, as `file.read_truth_file` does."""
    small = _read_at_once("truth", path, lambda: read_truth_file(path))
    if small is not None:
        return small
    content, (times, quaternions, *others) = _read_apart("truth", path)
    rates, states = (others.pop(0) if content[name] else None for name in ("has_rates", "has_orbit"))
    return FileTruth(
        times,
        Attitudes(quaternions),
        rates,
        None if states is None else Orbits(states),
        spans=_spans(content),
        smooth=content["smooth"],
        start_unix_s=content["start_unix_s"],
    )


def read_orbit(path: Path) -> OrbitTable:
    """Read an orbit file, as `file.read_orbit_file` does."""
    small = _read_at_once("orbit", path, lambda: read_orbit_file(path))
    if small is not None:
        return small
    content, (times, states) = _read_apart("orbit", path)
    return OrbitTable(path, times, Orbits(states), _spans(content))


def _read_at_once(kind: Kind, path: Path, read: Callable[[], Content]) -> Content | None:
    """Return what a small text contains; None if the file is not one."""
    try:
        return call_within(SILENT_S, lambda: read() if _is_small_text(path) else None)
    except TimeoutError:
        raise EmulatorError(f"{kind} file {path}: cannot be read ({_silent()})") from None


def _is_small_text(path: Path) -> bool:
    """Return whether a file can be read in this process, or not at all, so that reading it says why."""
    try:
        return path.stat().st_size <= AT_ONCE_BYTES and not _begins_as_kernel(path)
    except (OSError, ValueError):
        return True


def _begins_as_kernel(path: Path) -> bool:
    with open_user_file(path) as file:
        return META_KERNEL.encode() in (file.read(2 * len(META_KERNEL)) or b"")


def _spans(content: dict[str, Any]) -> list[Span]:
    return [Span(*values) for values in content["spans"]]


def _read_apart(kind: Kind, path: Path) -> tuple[dict[str, Any], list[Any]]:
    """Return what another process reads of a file."""
    with _process(kind, path) as process:
        if process.stdout is None:
            raise RuntimeError("no pipe")
        why = ""
        try:
            why = _wait_for_content(process.pid, process.stdout)
            content = json.loads(b"" if why else process.stdout.readline())
            if "problems" not in content:
                for text in content["warnings"]:
                    log.warning("%s", text)
                # a file would be asked for its position
                pipe: Any = SimpleNamespace(read=process.stdout.read)
                arrays = [
                    np.lib.format.read_array(pipe, allow_pickle=False) for _ in range(content["arrays"])
                ]
                return content, arrays
        except ValueError:  # it has ended before the end
            content = None
        finally:
            process.kill()
    if content is not None:
        raise EmulatorError(*content["problems"])
    code = process.returncode
    how = f"by {signal.Signals(-code).name}" if code < 0 else f"with status {code}"
    why = why or f"the process that reads it has ended {how}"
    raise EmulatorError(f"{kind} file {path}: cannot be read ({why})")


@contextmanager
def _process(kind: Kind, path: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Start a process that reads a file, at a low priority, when there is room for one."""
    begin_s = time.monotonic()
    while not _ROOM.acquire(timeout=LOOK_S):
        if is_abandoned() or time.monotonic() - begin_s > SILENT_S:
            raise EmulatorError(
                f"{kind} file {path}: cannot be read ({MAX_PROCESSES} files are being read already)"
            )
    try:
        command = [sys.executable, "-P", "-m", __name__, kind, str(path), str(os.getpid())]
        with subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE) as process:  # noqa: S603
            niceness = min(NICEST, os.getpriority(os.PRIO_PROCESS, 0) + NICER)
            os.setpriority(os.PRIO_PROCESS, process.pid, niceness)
            yield process
    finally:
        _ROOM.release()


def _silent() -> str:
    return f"nothing of it has arrived for {SILENT_S} s; does it name a pipe, or is the server of its folder out of reach?"


def _wait_for_content(reader: int, out: IO[bytes]) -> str:
    """Wait until a process has read a file; return why it is not waited for any longer, if it has not."""
    poll = select.poll()
    poll.register(out, select.POLLIN)
    begin_s = silent_since_s = time.monotonic()
    work: tuple[str, ...] = ()
    while not poll.poll(1e3 * LOOK_S):
        now_s, (state, *done) = time.monotonic(), _work_of(reader)
        if is_abandoned():
            return "nobody waits for it any more"
        if now_s - begin_s > LONGEST_S:
            return f"it takes longer than {LONGEST_S} s"
        if state == "R" or tuple(done) != work:  # running, or waiting for a processor
            work, silent_since_s = tuple(done), now_s
        elif now_s - silent_since_s > SILENT_S:
            return _silent()
    return ""


def _work_of(process: int) -> tuple[str, str, str]:
    """Return the state of a process, and its times as user and in the kernel."""
    try:
        state, *fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    except OSError:  # it has ended
        return "R", "", ""
    return state, fields[10], fields[11]


# --- the other process ---


class _Warnings(logging.Handler):
    """Collects warnings about a file."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.texts: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.texts.append(record.getMessage())


def main(kind: str, path: Path, out: IO[bytes]) -> None:
    """Read a file, and write what it contains."""
    warnings = _Warnings()
    log.addHandler(warnings)
    log.propagate = False
    arrays: Sequence[Any] = ()
    try:
        content, arrays = _truth_of(path) if kind == "truth" else _orbit_of(path)
        content |= {"warnings": warnings.texts, "arrays": len(arrays)}
    except (EmulatorError, StaridError) as error:
        content = {"problems": list(getattr(error, "problems", (str(error),)))}
    except MemoryError:
        content = {"problems": [f"{kind} file {path}: cannot be read (not enough memory)"]}
    out.write(json.dumps(content).encode() + b"\n")
    pipe: Any = SimpleNamespace(write=out.write)  # a file would be asked for its position
    for array in arrays:
        np.lib.format.write_array(pipe, array, allow_pickle=False)
    out.flush()


def _truth_of(path: Path) -> tuple[dict[str, Any], list[Any]]:
    truth = read_truth_file(path)
    optional = [truth.rates_rad_s, None if truth.orbit is None else Orbits.array_of(truth.orbit)]
    content = {
        "spans": [astuple(span) for span in truth.spans],
        "smooth": truth.smooth,
        "start_unix_s": truth.start_unix_s,
        "has_rates": optional[0] is not None,
        "has_orbit": optional[1] is not None,
    }
    arrays = [truth.times_s, Attitudes.array_of(truth.attitudes), *optional]
    return content, [array for array in arrays if array is not None]


def _orbit_of(path: Path) -> tuple[dict[str, Any], list[Any]]:
    table = read_orbit_file(path)
    return {"spans": [astuple(span) for span in table.spans]}, [
        table.times_unix_s,
        Orbits.array_of(table.states),
    ]


if __name__ == "__main__":
    end_with_parent(int(sys.argv[3]))
    limit = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    main(sys.argv[1], Path(sys.argv[2]), sys.stdout.buffer)
