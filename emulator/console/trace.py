"""The trace of the traffic for pages of the console, and telecommands as hexadecimal text."""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Final

from starhil.emulator.links.traffic import Decoder, Traffic, WireItem
from starhil.protocol.can.cubespace import encode_request_frames
from starhil.protocol.can.frame import CanFrame, bus_name, format_candump
from starhil.protocol.canopen.cob import SDO_RECEIVE
from starhil.protocol.canopen.device_dictionary import DeviceDictionary
from starhil.protocol.canopen.sdo_client import requests_of, row_transfer
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.icd.codec import Row
from starhil.protocol.serial.cubespace import Dialect
from starhil.protocol.serial.stack import SerialStack

KEPT_ITEMS: Final = 20_000
"""Number of items kept for export."""

DECODED_PER_TURN: Final = 200
"""Maximum number of items decoded at a time; further items of a burst are only kept for export."""


class WireTrace:
    """Keeps the traffic while a console page is open.

    Parameters
    ----------
    channel
        Returns the CAN bus, as the transport describes it; empty if there is none.
    """

    def __init__(
        self,
        icd: InterfaceDefinition,
        traffic: Traffic,
        dialect: Callable[[], Dialect | None],
        channel: Callable[[], str],
    ) -> None:
        self._passed = traffic.passed
        self._channel = channel
        self._icd = icd
        self._dialect = dialect
        self._decoder = Decoder(icd, dialect)
        self._count = 0
        self._recent: deque[dict[str, Any]] = deque(maxlen=DECODED_PER_TURN)
        self._recent_end = 0
        self._recent_decoder = self._decoder
        self._kept: deque[tuple[int, WireItem]] = deque(maxlen=KEPT_ITEMS)
        self._new: deque[tuple[int, WireItem]] = deque(maxlen=KEPT_ITEMS)
        """Items, each with its number, that no page has got yet."""
        self.listening = False

    def listen(self, wanted: bool) -> None:
        """Start or stop recording."""
        if wanted == self.listening:
            return
        self.listening = wanted
        if wanted:
            self._passed.connect(self._add)
        else:
            self._passed.disconnect(self._add)

    def _add(self, item: WireItem) -> None:
        self._kept.append((self._count, item))
        self._new.append((self._count, item))
        self._count += 1

    def drain(self) -> tuple[list[dict[str, Any]], int]:
        """Return the new items, decoded, and the number of items skipped."""
        left_out = max(0, len(self._new) - DECODED_PER_TURN)
        for _ in range(left_out):
            self._new.popleft()
        lines = [{"n": number, **self._decoder.line(item)} for number, item in self._new]
        self._new.clear()
        return lines, left_out

    def recent(self, start: int) -> list[dict[str, Any]]:
        """Return the latest items from a number on, decoded, for a page that subscribes; each item is decoded once."""
        new = min(self._count - self._recent_end, DECODED_PER_TURN)
        if self._count - self._recent_end > new or not self._recent:
            self._recent_decoder = Decoder(self._icd, self._dialect)
        first = max(0, len(self._kept) - new)
        for number, item in itertools.islice(self._kept, first, None):
            self._recent.append({"n": number, **self._recent_decoder.line(item)})
        self._recent_end = self._count
        return [line for line in self._recent if line["n"] >= start]

    def discard(self) -> None:
        """Drop undecoded items, because no page shows the trace."""
        self._new.clear()

    def candump(self) -> str:
        """Return the recorded CAN frames as a candump log with the name of their bus."""
        name = bus_name(self._channel())
        return "".join(
            format_candump(replace(entry.item, timestamp=entry.at_s), name) + "\n"
            for _, entry in self._kept
            if isinstance(entry.item, CanFrame)
        )


class RequestEncoder:
    """Encodes telecommands for the links of a unit."""

    def __init__(self, icd: InterfaceDefinition) -> None:
        self._icd = icd
        self._stack = SerialStack(icd) if icd.link.serial is not None else None
        self._objects = DeviceDictionary(icd) if icd.canopen_only else None

    def encode(self, row: Row, data: bytes, host: int, device: int) -> dict[str, Any]:
        """Return a request as data and serial bytes in hexadecimal, and as arguments of cansend.

        Raises
        ------
        IcdError
            The object dictionary does not hold the telecommand.
        """
        request = self._icd.request(row, data, host)
        frames = encode_request_frames(request, host, device) if self._icd.link.can is not None else []
        if self._objects is not None:
            requests = requests_of(row_transfer(self._objects, row, data))
            frames = [CanFrame(SDO_RECEIVE + device, each, extended=False) for each in requests]
        return {
            "data": data.hex(" ").upper(),
            "serial": "" if self._stack is None else self._stack.encode_request(request).hex(" ").upper(),
            "cansend": [str(frame) for frame in frames],
        }
