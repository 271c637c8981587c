"""Output of a run: each output fails on its own, with one warning, and the device continues without it."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import io
import logging
import os
import stat
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

from starhil.emulator.errors import EmulatorError, one_line
from starid.storage.files import open_output

log: Final = logging.getLogger("starhil.output")


class Output:
    """Something that a run writes."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.failed = False
        """Whether something could not be written; the run then exits with status 1."""

    def fail(self, why: str) -> None:
        """Report a failure: the first is logged as a warning."""
        if not self.failed:
            self.failed = True
            log.warning("%s; the run continues and will exit with status 1", why)

    @contextlib.contextmanager
    def guarded(self) -> Iterator[None]:
        """Report an exception as a failure instead of raising it."""
        try:
            yield
        except Exception as error:  # noqa: BLE001 (whatever it is, the device goes on)
            why = error.strerror if isinstance(error, OSError) else None
            self.fail(f"{self.name}: cannot be written ({why or one_line(error)}); it ends here")


class OutputFile:
    """A file of complete, unbuffered records; only one emulator at a time can write to it. If it is rejected, it is unchanged.

    The name says what it is, for messages: `truth log`. It may be part of a larger output, of which nothing is
    written after a failure. The file ends with `tail` after each record, so that it is complete however the run ends.
    """

    def __init__(
        self,
        name: str,
        path: Path,
        *,
        header: bytes = b"",
        tail: bytes = b"",
        overwrite: bool = False,
        output: Output | None = None,
    ) -> None:
        self.path = path
        self._name = f"{name} {path}"
        self.output = Output(self._name) if output is None else output
        self._size = 0
        """Size without the tail, bytes."""
        self._tail = b""
        file: io.FileIO | None = None
        try:
            self.stream = file = self._open(overwrite=overwrite)
            self._tail = tail
            self._append(header)
        except OSError as error:
            if file is not None:
                file.close()
            raise EmulatorError(
                f"{self._name}: cannot be written ({error.strerror}); choose another file"
            ) from None

    def append(self, record: Callable[[], bytes]) -> None:
        """Write the record that a function returns completely or not at all, unless the output has failed."""
        if not self.output.failed:
            with self.output.guarded():
                if data := record():
                    self._append(data)

    def append_last(self, record: Callable[[], bytes]) -> None:
        """Write the record that ends the file in place of the tail, as `append` does."""
        if not self.output.failed:
            with self.output.guarded():
                self._append(record(), last=True)

    def _append(self, record: bytes, *, last: bool = False) -> None:
        regular = stat.S_ISREG(os.fstat(self.stream.fileno()).st_mode)
        try:
            self._write(record if last else record + self._tail, regular=regular)
        except OSError:
            if regular:  # the room of the tail is its own
                self._write(self._tail, regular=True)
                self.stream.truncate(self._size + len(self._tail))
            raise
        self._size += len(record)

    def _write(self, data: bytes, *, regular: bool) -> None:
        """Write data where the tail begins."""
        if regular:
            self.stream.seek(self._size)
        rest = memoryview(data)
        while rest:
            written: int | None = self.stream.write(rest)
            if written is None:  # a character device that would block
                raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))
            rest = rest[written:]

    def close(self) -> None:
        self.stream.close()

    def discard(self) -> None:
        """Remove the file, unless it is a device."""
        self.close()
        with contextlib.suppress(OSError):
            if self.path.is_file():
                self.path.unlink()

    def _open(self, *, overwrite: bool) -> io.FileIO:
        """Open and empty the file for one writer; a pipe is rejected, as its reader could block the emulator.

        So is a link of another user.
        """
        flags = os.O_WRONLY | os.O_CREAT | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC
        file = os.fdopen(open_output(self.path, flags), "wb", buffering=0)
        try:
            self._lock_and_empty(file, overwrite=overwrite)
        except (EmulatorError, OSError):
            file.close()
            raise
        return file

    def _lock_and_empty(self, file: io.FileIO, *, overwrite: bool) -> None:
        """Lock the file for this process and empty it; a character device such as /dev/null is not locked."""
        mode = os.fstat(file.fileno()).st_mode
        if stat.S_ISCHR(mode):
            return
        if not stat.S_ISREG(mode):
            raise EmulatorError(f"{self._name}: not a regular file; choose another file")
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise EmulatorError(f"{self._name}: in use by another emulator; choose another file") from None
        if os.fstat(file.fileno()).st_size and not overwrite:
            raise EmulatorError(
                f"{self._name}: exists and is not empty; choose another file, or replace it with --overwrite"
            )
        file.truncate()
