"""The trace of the traffic for pages of the console, and telecommands as hexadecimal text."""

from __future__ import annotations

import itertools
import json
from collections import defaultdict, deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any, Final

from starhil.emulator.console.obc import json_value
from starhil.emulator.errors import EmulatorError
from starhil.emulator.links.traffic import CONSOLE_BUS, Decoder, Traffic, WireItem
from starhil.protocol.can.cubespace import encode_request_frames
from starhil.protocol.can.frame import CanFrame, bus_name, format_candump
from starhil.protocol.canopen.cob import SDO_RECEIVE
from starhil.protocol.canopen.device_dictionary import DeviceDictionary
from starhil.protocol.canopen.sdo_client import requests_of, row_transfer
from starhil.protocol.errors import ProtocolError
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.icd.codec import Row
from starhil.protocol.messages import Reply, Request
from starhil.protocol.serial.cubespace import Dialect
from starhil.protocol.serial.stack import SerialStack

KEPT_ITEMS: Final = 20_000
"""Number of items kept for export."""

DECODED_LINES: Final = 400
"""Number of latest items that are decoded; further items of a burst are only kept for export."""

DECODED_AT_ONCE: Final = 20
"""Number of items that are decoded at a time, so that the links are served in between."""

LEAD: Final = 64
"""Number of items before a message that are decoded with it, as it may consist of several."""


class WireTrace:
    """Keeps the traffic from the start of the run, numbered, and decodes it for pages that show it.

    Parameters
    ----------
    channel
        Returns the CAN bus, as the transport describes it; empty if there is none.
    objects
        Object dictionary with which CANopen is decoded; None without a CANopen link.
    """

    def __init__(
        self,
        icd: InterfaceDefinition,
        traffic: Traffic,
        dialect: Callable[[], Dialect | None],
        channel: Callable[[], str],
        objects: DeviceDictionary | None = None,
    ) -> None:
        self._passed = traffic.passed
        self._channel = channel
        self._icd = icd
        self._dialect = dialect
        self._objects = objects
        self._count = 0
        self._kept: deque[WireItem] = deque(maxlen=KEPT_ITEMS)
        self._decoder = Decoder(icd, dialect, objects)
        self._decoded_end = 0
        self._lines: deque[tuple[int, str]] = deque(maxlen=DECODED_LINES)
        """The latest items that are decoded, as JSON, each with its number."""
        self._passed.connect(self._add)

    def close(self) -> None:
        self._passed.disconnect(self._add)

    def _add(self, item: WireItem) -> None:
        self._kept.append(item)
        self._count += 1

    @property
    def start(self) -> int:
        """Number of the first item that can be decoded: not of those that were passed over."""
        return self._lines[0][0] if self._lines else self._decoded_end

    @property
    def end(self) -> int:
        """Number of the item after the last one that is decoded."""
        return self._decoded_end

    def decode(self) -> bool:
        """Decode some further items; return whether there are more."""
        if self._count - self._decoded_end > DECODED_LINES:  # nobody has looked, or a burst
            self._decoder = Decoder(self._icd, self._dialect, self._objects)
            self._lines.clear()
            self._decoded_end = self._count - DECODED_LINES
        for number, item in self._items(range(self._decoded_end, self._decoded_end + DECODED_AT_ONCE)):
            self._lines.append((number, json.dumps({"n": number, **self._decoder.line(item)})))
            self._decoded_end = number + 1
        return self._decoded_end < self._count

    def texts(self, numbers: range) -> list[str]:
        """Return decoded items as JSON."""
        return [text for number, text in self._lines if number in numbers]

    def _items(self, numbers: range) -> Iterator[tuple[int, WireItem]]:
        """Yield those of the items that are kept, with their numbers."""
        first = self._count - len(self._kept)
        low, high = max(numbers.start, first), min(numbers.stop, self._count)
        return zip(
            range(low, high), itertools.islice(self._kept, low - first, max(low, high) - first), strict=False
        )

    def message(self, number: int) -> dict[str, Any]:
        """Return the message that is complete with an item: its bytes and fields, and how to send it again.

        Raises
        ------
        EmulatorError
            The item is no longer kept.
        """
        if not self._count - len(self._kept) <= number < self._count:
            raise EmulatorError(f"item {number} of the trace is no longer kept")
        decoder = Decoder(self._icd, self._dialect, self._objects)
        parts: defaultdict[tuple[str, bool, int], list[bytes | CanFrame]] = defaultdict(list)
        """Items of messages that are not complete, by bus, direction and CAN ID."""
        message: Request | Reply | None = None
        pieces: list[bytes | CanFrame] = []
        for at, item in self._items(range(number - LEAD, number + 1)):
            key = item.bus, item.outgoing, item.item.id if isinstance(item.item, CanFrame) else 0
            parts[key].append(item.item)
            events = decoder.events(item)
            if events or at == number:
                pieces = parts.pop(key)
            if at == number and events and isinstance(events[-1], (Request, Reply)):
                message = events[-1]
        frames = [str(piece) for piece in pieces if isinstance(piece, CanFrame)]
        raw = frames or [piece.hex(" ").upper() for piece in pieces if isinstance(piece, bytes)]
        content: dict[str, Any] = {"n": number, "raw": raw, "cansend": frames}
        content |= {"row": "", "data": "", "fields": [], "python": ""}
        row = None if message is None else decoder.row_of(message)
        if message is not None and row is not None:
            fields = fields_of(row, message.data) if message.data else []
            content |= {"row": row.name, "data": message.data.hex(" ").upper(), "fields": fields}
            if isinstance(message, Request):
                content["python"] = _python(row, fields)
        return content

    def candump(self, items: Sequence[WireItem]) -> str:
        """Return the CAN frames of recorded items as a candump log with the name of their bus."""
        name = bus_name(self._channel())
        return "".join(
            format_candump(replace(entry.item, timestamp=entry.at_s), name) + "\n"
            for entry in items
            if isinstance(entry.item, CanFrame) and entry.bus != CONSOLE_BUS
        )

    def text(self, items: Sequence[WireItem]) -> str:
        """Return recorded items of all links, decoded, one a line."""
        decoder = Decoder(self._icd, self._dialect, self._objects)
        lines = []
        for item in items:
            line = decoder.line(item)
            way = "device→" if item.outgoing else "→device"
            lines.append(f"{item.at_s:.6f}  {item.bus:<7}  {way}  {line['text']}  [{line['raw']}]\n")
        return "".join(lines)

    def items(self) -> list[WireItem]:
        """Return the recorded items, oldest first: a list that traffic does not change while a thread reads it."""
        return list(self._kept)


def _python(row: Row, fields: list[dict[str, Any]]) -> str:
    """Return the call of an `ObcClient` that sends a request."""
    if row.kind == "telemetry":
        return f"client.telemetry({row.name!r})"
    values = "".join(f", {field['name']}={field['value']!r}" for field in fields)
    return f"client.command({row.name!r}{values})"


def fields_of(row: Row, data: bytes) -> list[dict[str, Any]]:
    """Return name, value, unit and place (bytes from `start` to before `end`) of each field of a message."""
    try:
        values = row.decode(data, check=False)
    except ProtocolError:
        return []
    return [
        {
            "name": field.name,
            "value": json_value(values[field.name]),
            "unit": field.unit,
            "start": field.slot.offset,
            "end": field.slot.offset + field.slot.size,
        }
        for field in row.named_fields.values()
        if field.name in values
    ]


class RequestEncoder:
    """Encodes telecommands for the links of a unit."""

    def __init__(self, icd: InterfaceDefinition, objects: DeviceDictionary | None) -> None:
        self._icd = icd
        self._stack = SerialStack(icd) if icd.link.serial is not None else None
        self._objects = objects if icd.canopen_only else None

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
