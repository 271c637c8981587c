"""Timestamped logs of every byte on a link: text for serial, candump format for CAN."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from pathlib import Path
from typing import Self

from starhil.protocol.can_framing import CanFrame
from starhil.protocol.candump import format_candump


class WireLog(ABC):
    """A text log of sent and received items, written line by line.

    An existing file is replaced; `now` returns seconds since 1970-01-01 UTC.
    """

    def __init__(self, path: Path, *, now: Callable[[], float] = time.time) -> None:
        self._now = now
        self._file = path.open("w", encoding="utf-8", buffering=1)

    @abstractmethod
    def _line(self, time_s: float, direction: str, item: bytes | CanFrame) -> str:
        """Format one line, without the newline."""

    def _write(self, line: str) -> None:
        if not self._file.closed:
            self._file.write(line + "\n")

    def sent(self, item: bytes | CanFrame) -> None:
        """Log an item that is passed to the transport."""
        self._write(self._line(self._now(), "TX", item))

    def received(self, item: bytes | CanFrame) -> None:
        """Log an item that the transport has received."""
        self._write(self._line(self._now(), "RX", item))

    @abstractmethod
    def note(self, text: str) -> None:
        """Write a comment line, if the format has any."""

    def close(self) -> None:
        """Close the file; later items are not logged."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()


class SerialLog(WireLog):
    """A readable log of a serial line: time, direction, bytes in hexadecimal.

    There is one line for each chunk that is sent or received, for example `(1760000000.123456) TX 1F 7F 80 1F
    FF`. Lines that start with `#` are notes.
    """

    def __init__(self, path: Path, *, now: Callable[[], float] = time.time) -> None:
        super().__init__(path, now=now)
        self._file.write("# (seconds since 1970-01-01 UTC) TX = to the device, RX = from the device\n")

    def note(self, text: str) -> None:
        """Write a comment line."""
        self._write(f"# ({self._now():.6f}) {text}")

    def _line(self, time_s: float, direction: str, item: bytes | CanFrame) -> str:
        data = item.data if isinstance(item, CanFrame) else item
        return f"({time_s:.6f}) {direction} {data.hex(' ').upper()}"


class CandumpLog(WireLog):
    """A CAN log in the format of `candump -L`, which can-utils, tshark and others can read."""

    def __init__(self, path: Path, bus: str, *, now: Callable[[], float] = time.time) -> None:
        super().__init__(path, now=now)
        self._bus = bus

    def note(self, text: str) -> None:
        """Drop a comment: the format has none."""

    def _line(self, time_s: float, direction: str, item: bytes | CanFrame) -> str:  # noqa: ARG002 -- not in the format
        frame = item if isinstance(item, CanFrame) else CanFrame(0, item)
        return format_candump(CanFrame(frame.id, frame.data, frame.extended, frame.remote, time_s), self._bus)
