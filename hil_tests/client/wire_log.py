"""Timestamped logs of every byte on a link: text for serial, candump format for CAN."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Self

from starhil.protocol.can.frame import CanFrame, format_candump
from starid.storage.files import open_output


class WireLog:
    """A log of a link, written line by line.

    Of a CAN bus, given by its name, it has the frames in the format of `candump -L`, which can-utils, tshark and others
    can read. Of a serial line it has one line for each chunk that is sent or received, for example
    `(1760000000.123456) TX 1F 7F 80 1F FF`, and notes, which start with `#`.

    An existing file is replaced; `now` returns seconds since 1970-01-01 UTC.
    """

    def __init__(self, path: Path, bus: str = "", *, now: Callable[[], float] = time.time) -> None:
        self._bus = bus
        self._now = now
        self._file = open(path, "w", encoding="utf-8", buffering=1, opener=open_output)  # noqa: SIM115
        if not bus:
            self._write("# (seconds since 1970-01-01 UTC) TX = to the device, RX = from the device")

    def sent(self, item: bytes | CanFrame) -> None:
        """Log an item that is passed to the transport."""
        self._log("TX", item)

    def received(self, item: bytes | CanFrame) -> None:
        """Log an item that the transport has received."""
        self._log("RX", item)

    def note(self, text: str) -> None:
        """Write a comment line, which the log of a CAN bus cannot have."""
        if not self._bus:
            self._write(f"# ({self._now():.6f}) {text}")

    def _log(self, direction: str, item: bytes | CanFrame) -> None:
        if isinstance(item, CanFrame):
            self._write(format_candump(replace(item, timestamp=self._now()), self._bus))
        else:
            self._write(f"({self._now():.6f}) {direction} {item.hex(' ').upper()}")

    def _write(self, line: str) -> None:
        if not self._file.closed:
            self._file.write(line + "\n")

    def close(self) -> None:
        """Close the file; later items are not logged."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()
