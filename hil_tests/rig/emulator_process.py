"""The emulator as a process: start, ready line, end and exit status."""

from __future__ import annotations

import contextlib
import os
import queue
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from itertools import chain
from pathlib import Path
from typing import IO, Final, Self
from urllib.parse import unquote

from starhil.hil_tests.attitude import Quaternion
from starhil.hil_tests.errors import BenchError, EmulatorProcessError
from starhil.protocol.errors import OneLineError
from starhil.protocol.files.bundled import DEFAULT_UNIT

READY_WITHIN_S: Final = 300.0
"""The first start on a machine compiles for minutes; later ones take about 3 s."""
STOP_WITHIN_S: Final = 60.0
"""It takes a moment, and much longer on a machine that is busy with everything else."""
PROGRESS: Final = "starting:"
"""Begin of the lines on stderr that report the progress of a slow start."""
SHOWN: Final = (PROGRESS, "note:")
"""Begins of the lines on stderr that are shown as they come: they are no errors."""
BAD_INPUT: Final = 2
"""Exit status of an emulator that rejects an option, its profile or its unit."""
REJECTED: Final = "starhil: "
"""Beginning of the lines of stderr that name the reasons."""
SHOWN_LINES: Final = 5
"""Number of last lines of the emulator's stderr in an error message."""


def emulator_command(
    *,
    profile: str | None = None,
    unit: str | None = None,
    serial: str = "auto",
    can: str = "off",
    dialect: str | None = None,
    seed: int | None = None,
    settings: Sequence[str] = (),
    state_dir: Path | None = None,
    truth_log: Path | None = None,
    extra: Sequence[str] = (),
) -> list[str]:
    """Return the command line for an emulator that ends with this process."""
    options = {
        "--unit": unit,
        "--serial": serial,
        "--can": can,
        "--dialect": dialect,
        "--seed": seed,
        "--state-dir": state_dir,
        "--truth-log": truth_log,
    }
    given = [(name, str(value)) for name, value in options.items() if value is not None]
    given += [("--set", setting) for setting in settings]
    command = [*_starhil_command(), "run", *([] if profile is None else [profile]), *chain(*given)]
    return [*command, *([] if truth_log is None else ["--overwrite"]), *extra]


def pointed(attitude: Quaternion | None, settings: Sequence[str]) -> list[str]:
    """Return settings that also point an emulator at an attitude, unless they have keys of `truth`."""
    if attitude is None or any(setting.strip().startswith("truth.") for setting in settings):
        return [*settings]
    return ["truth.kind=fixed", f"truth.attitude={{ quaternion_xyzw = {list(attitude)} }}", *settings]


def hub_command() -> list[str]:
    """Return the command line for a CAN hub on a free port that ends with this process."""
    return [*_starhil_command(), "hub", "--port", "0"]


def installed_command() -> str:
    """Return the path of the command `starhil`: beside the Python interpreter, or else on PATH.

    Raises EmulatorProcessError: the command is not installed.
    """
    beside_python = Path(sys.executable).with_name("starhil")
    if os.access(beside_python, os.X_OK):
        return str(beside_python)
    command = shutil.which("starhil")
    if command is None:
        raise EmulatorProcessError(
            f"the command starhil is neither beside {sys.executable} nor on PATH; install it with pip install starhil"
        )
    return command


def _starhil_command() -> list[str]:
    """Return the beginning of a command line for a `starhil` that ends with this process."""
    return [
        sys.executable,
        "-P",
        "-m",
        "starhil.hil_tests.rig.end_with_parent",
        str(os.getpid()),
        installed_command(),
    ]


def parse_ready_line(line: str) -> dict[str, str]:
    """Return the `key=value` fields of a ready line.

    Raises EmulatorProcessError: not a ready line.
    """
    fields = line.split()
    if not fields or fields[0] != "ready":
        raise EmulatorProcessError(f"not a ready line: {line.strip()!r}")
    return dict(field.split("=", 1) for field in fields[1:] if "=" in field)


class EmulatorProcess:
    """A running emulator; it also ends with the thread that called `start`.

    A context manager that on exit raises `EmulatorProcessError` if the emulator does not end cleanly, or if it has ended
    by itself, which may have caused the error of the bench that ends the context.

    The command line is that of `emulator_command`; `ready` has the fields of the ready line: serial, can, control, seed …
    """

    def __init__(self, command: Sequence[str], *, ready_within_s: float = READY_WITHIN_S) -> None:
        self.command = list(command)
        self.ready: dict[str, str] = {}
        self.errors: list[str] = []
        self._ready_within_s = ready_within_s
        self._process: subprocess.Popen[str] | None = None
        self._ended = False
        """Whether the process was ended by `stop` or `kill`, which have reported how."""
        self._lines: queue.Queue[str | None] = queue.Queue()
        self._readers: list[threading.Thread] = []
        """Threads that have started to read the process's output."""

    @property
    def unit(self) -> str:
        """Name or folder of the emulator's unit."""
        return unquote(self.ready.get("unit", DEFAULT_UNIT))

    def check_unit(self, unit: str | None) -> None:
        """Check that emulator and bench have the same unit.

        Raises BenchError: the emulator has another unit, selected in its profile.
        """
        if unit is None and self.unit != DEFAULT_UNIT:
            raise BenchError(f"the profile's unit is {self.unit}: add --unit {self.unit}")

    def start(self) -> Self:
        """Start the process and wait for its ready line.

        Raises EmulatorProcessError: the process ended or was not ready in time; the text quotes the last
        lines of stderr.
        """
        self._lines = queue.Queue()
        self.errors = []
        try:
            process = subprocess.Popen(  # noqa: S603 -- our own command line
                self.command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
                start_new_session=True,
            )
        except OSError as error:
            raise EmulatorProcessError(f"{self.command[0]}: cannot be started: {error.strerror}") from None
        self._process, self._ended = process, False
        try:
            self._readers = []
            for read, stream in ((self._read_output, process.stdout), (self._read_errors, process.stderr)):
                reader = threading.Thread(target=read, args=(stream,), daemon=True)
                reader.start()
                self._readers.append(reader)
            self.ready = self._wait_for_ready()
        except (
            BaseException
        ):  # on interruption too: the process has its own session, so it receives no signal
            self.kill()
            raise
        return self

    def _wait_for_ready(self) -> dict[str, str]:
        deadline, compiled = time.monotonic() + self._ready_within_s, ""
        while True:
            try:
                line = self._lines.get(timeout=max(0.0, deadline - time.monotonic()))
            except queue.Empty:
                text = f"the emulator was not ready within {self._ready_within_s:g} s{self._last_errors()}"
                raise EmulatorProcessError(text) from None
            if line is None:
                status, last = self.process.wait(), self._last_errors()
                rejected = [line.removeprefix(REJECTED) for line in self.errors if line.startswith(REJECTED)]
                if status == BAD_INPUT and rejected:
                    raise EmulatorProcessError(*rejected)
                raise EmulatorProcessError(
                    f"the emulator ended with status {status} before it was ready{last}"
                )
            if line.startswith("ready"):
                return parse_ready_line(line)
            if line.startswith(PROGRESS) and line.partition(",")[2] != compiled:
                # a slow machine compiles kernels for longer than that, at the first start
                deadline, compiled = time.monotonic() + self._ready_within_s, line.partition(",")[2]

    def _read_output(self, stream: IO[str]) -> None:
        for line in stream:
            self._lines.put(line)
        self._lines.put(None)

    def _read_errors(self, stream: IO[str]) -> None:
        for line in stream:
            if line.startswith(SHOWN):
                print(line.rstrip(), file=sys.stderr, flush=True)
                self._lines.put(line)
            else:
                self.errors.append(line.rstrip())

    def _last_errors(self) -> str:
        for reader in self._readers:
            reader.join(timeout=0.5)
        return ": " + " | ".join(self.errors[-SHOWN_LINES:]) if self.errors else ""

    @property
    def process(self) -> subprocess.Popen[str]:
        """The process itself.

        Raises EmulatorProcessError: the process has not been started.
        """
        if self._process is None:
            raise EmulatorProcessError("the emulator has not been started")
        return self._process

    @property
    def running(self) -> bool:
        return self._process is not None and self._process.poll() is None

    def stop(self) -> None:
        """End the process by SIGTERM and check that it ends with status 0.

        Raises EmulatorProcessError: the process had already ended, does not end, or ends with another
        status.
        """
        process = self.process
        if process.poll() is not None:
            self.kill()
            raise EmulatorProcessError(
                f"the emulator ended unexpectedly with status {process.returncode}{self._last_errors()}"
            )
        process.terminate()
        try:
            status = process.wait(timeout=STOP_WITHIN_S)
        except subprocess.TimeoutExpired:
            self.kill()
            raise EmulatorProcessError(f"the emulator did not end within {STOP_WITHIN_S:g} s") from None
        errors = self._last_errors()
        self.kill()
        if status != 0:
            raise EmulatorProcessError(f"the emulator ended with status {status}{errors}")

    def kill(self) -> None:
        """Kill the process and its workers (SIGKILL) and release the resources."""
        process = self.process
        self._ended = True
        with contextlib.suppress(ProcessLookupError):  # the whole group has ended
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        for reader in self._readers:
            reader.join(timeout=1.0)
        for stream in (process.stdout, process.stderr):
            if stream is not None:
                stream.close()

    def restart(self, number: signal.Signals = signal.SIGTERM) -> None:
        """End the process by SIGTERM or SIGKILL and start it again with the same command."""
        if number is signal.SIGKILL:
            self.kill()
        else:
            self.stop()
        self.start()

    def memory_bytes(self) -> int:
        """Return the resident memory of the process and its workers in bytes."""
        group = self.process.pid
        return sum(_resident(folder, group) for folder in Path("/proc").iterdir() if folder.name.isdigit())

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(self, kind: type[BaseException] | None, *_error: object) -> None:
        if self._ended:
            return
        caused_by_emulator = kind is not None and issubclass(kind, OneLineError) and not self.running
        if kind is None or caused_by_emulator:
            self.stop()
        else:
            self.kill()


def _resident(folder: Path, group: int) -> int:
    """Return the resident memory of a process of the group in bytes, 0 for any other process."""
    try:
        fields = (folder / "stat").read_text().rsplit(")", 1)[1].split()
    except (FileNotFoundError, ProcessLookupError):
        return 0
    if int(fields[2]) != group:
        return 0
    return int(fields[21]) * os.sysconf("SC_PAGE_SIZE")
