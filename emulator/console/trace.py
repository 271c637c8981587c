"""Decoded trace of the traffic on the serial line and the CAN bus."""

from __future__ import annotations

import itertools
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Final

from starhil.emulator.console.obc import json_value
from starhil.emulator.links.base import Link
from starhil.protocol.can_framing import (
    CanDeviceReceiver,
    CanFrame,
    CanHostReceiver,
    CanId,
    MessageType,
    encode_request_frames,
)
from starhil.protocol.candump import bus_name, format_candump
from starhil.protocol.canopen.cob import SDO_RECEIVE
from starhil.protocol.canopen.device_dictionary import build_dictionary
from starhil.protocol.canopen.sdo_client import requests_of, row_transfer
from starhil.protocol.codec import Row
from starhil.protocol.definition import InterfaceDefinition
from starhil.protocol.errors import ProtocolError
from starhil.protocol.messages import LinkFault, Reply, ReplyKind, Request, RequestKind
from starhil.protocol.serial_interface import Dialect
from starhil.protocol.serial_stack import HostReceiver, build_serial_stack

KEPT_ITEMS: Final = 20_000
"""Number of items kept for export."""

DECODED_PER_TURN: Final = 200
"""Maximum number of items decoded at a time; further items of a burst are only kept for export."""

SHOWN_VALUES: Final = 8
"""Maximum number of values in a line."""

MAX_ADDRESSES: Final = 64
"""Maximum number of addresses whose segments are joined: a link fault can cause many random CAN IDs."""

_REQUEST_TYPES: Final = (
    MessageType.TELECOMMAND,
    MessageType.TELEMETRY_REQUEST,
    MessageType.TELECOMMAND_EXTENDED,
)

_CANOPEN: Final = (
    (0x080, "SYNC or EMCY"), (0x180, "TPDO 1"), (0x200, "RPDO 1"), (0x280, "TPDO 2"), (0x300, "RPDO 2"),
    (0x380, "TPDO 3"), (0x400, "RPDO 3"), (0x480, "TPDO 4"), (0x500, "RPDO 4"), (0x580, "SDO reply"),
    (0x600, "SDO request"), (0x700, "heartbeat"),
)  # fmt: skip
"""Function codes of CANopen's predefined connection set."""


@dataclass(frozen=True, slots=True)
class WireItem:
    """Bytes or a CAN frame on a link.

    Attributes
    ----------
    at_s
        Unix time.
    bus
        `serial` or `can`.
    outgoing
        True if the device sent it.
    item
        Bytes, or a CAN frame.
    number
        Number of the item in the trace.
    """

    at_s: float
    bus: str
    outgoing: bool
    item: bytes | CanFrame
    number: int = 0


class WireTrace:
    """Records the traffic on the device's links while a console page is open."""

    def __init__(
        self, icd: InterfaceDefinition, links: Sequence[Link], dialect: Callable[[], Dialect | None]
    ) -> None:
        self._links = links
        self._icd = icd
        self._dialect = dialect
        self._decoder = Decoder(icd, dialect)
        self._count = 0
        self._kept: deque[WireItem] = deque(maxlen=KEPT_ITEMS)
        self._new: deque[WireItem] = deque(maxlen=KEPT_ITEMS)
        self.listening = False

    def listen(self, wanted: bool) -> None:
        """Start or stop recording."""
        if wanted == self.listening:
            return
        self.listening = wanted
        seen: set[str] = set()
        for link in self._links:
            if link.bus in seen:  # two links on one bus receive the same frames
                continue
            seen.add(link.bus)
            link.transport.listener = partial(self._add, link.bus, False) if wanted else None  # noqa: FBT003
        for link in self._links:
            link.wire.listener = partial(self._add, link.bus, True) if wanted else None  # noqa: FBT003

    def _add(self, bus: str, outgoing: bool, item: bytes | CanFrame) -> None:
        entry = WireItem(time.time(), bus, outgoing, item, self._count)
        self._count += 1
        self._kept.append(entry)
        self._new.append(entry)

    def drain(self) -> tuple[list[dict[str, Any]], int]:
        """Return the new items, decoded, and the number of items skipped."""
        left_out = max(0, len(self._new) - DECODED_PER_TURN)
        for _ in range(left_out):
            self._new.popleft()
        lines = [self._decoder.line(item) for item in self._new]
        self._new.clear()
        return lines, left_out

    def recent(self) -> list[dict[str, Any]]:
        """Return the latest items, decoded, for a page that subscribes."""
        decoder = Decoder(self._icd, self._dialect)
        first = max(0, len(self._kept) - DECODED_PER_TURN)
        return [decoder.line(item) for item in itertools.islice(self._kept, first, None)]

    def discard(self) -> None:
        """Drop undecoded items, because no page shows the trace."""
        self._new.clear()

    def candump(self) -> str:
        """Return the recorded CAN frames as a candump log with the name of their bus."""
        channels = (link.transport.description for link in self._links if link.bus == "can")
        name = bus_name(next(channels, ""))
        return "".join(
            format_candump(replace(entry.item, timestamp=entry.at_s), name) + "\n"
            for entry in self._kept
            if isinstance(entry.item, CanFrame)
        )


class Decoder:
    """Decodes the items of a trace, in order."""

    def __init__(self, icd: InterfaceDefinition, dialect: Callable[[], Dialect | None]) -> None:
        self._icd = icd
        self._dialect = dialect
        self._stack = build_serial_stack(icd) if icd.link.serial is not None else None
        self._to_device = self._stack.device() if self._stack is not None else None
        self._from_device: tuple[Dialect | None, HostReceiver] | None = None
        self._can: dict[tuple[bool, int], CanDeviceReceiver | CanHostReceiver] = {}

    def line(self, entry: WireItem) -> dict[str, Any]:
        """Decode one item to a line of the trace, as JSON data."""
        if isinstance(entry.item, CanFrame):
            frame = entry.item
            kind, text = self._can_text(frame, entry.at_s)
            raw = cansend(frame)
        else:
            kind, text = self._serial_text(entry.item, entry.at_s, outgoing=entry.outgoing)
            raw = entry.item.hex(" ").upper()
        return {
            "n": entry.number,
            "t": entry.at_s,
            "bus": entry.bus,
            "out": entry.outgoing,
            "raw": raw,
            "kind": kind,
            "text": text,
        }

    def _serial_text(self, data: bytes, now: float, *, outgoing: bool) -> tuple[str, str]:
        if self._stack is None or self._to_device is None:
            return "part", "bytes"
        dialect = self._dialect()
        if self._from_device is None or self._from_device[0] is not dialect:
            self._from_device = (dialect, self._stack.host(dialect))
        host = self._from_device[1]
        if outgoing:
            return self._texts(host.feed(data, now), "part of a message")
        requests = self._to_device.feed(data, now)
        for event in requests:
            if isinstance(event, Request):
                row = self._row(event)
                telemetry = row is not None and row.kind == "telemetry"
                host.expect(event, row.size if row is not None and telemetry else 0)
        return self._texts(requests, "part of a message")

    def _can_text(self, frame: CanFrame, now: float) -> tuple[str, str]:
        if not frame.extended:
            return "canopen", canopen_text(frame)
        if self._icd.link.can is None:
            return "part", "29-bit frame"
        can_id = CanId.unpack(frame.id)
        request = can_id.type in _REQUEST_TYPES
        key = (request, can_id.destination)
        if key not in self._can:
            if len(self._can) >= MAX_ADDRESSES:
                self._can.clear()
            self._can[key] = (CanDeviceReceiver if request else CanHostReceiver)(can_id.destination)
        row = self._icd.row_by_id(can_id.id)
        name = row.name if row is not None else str(can_id.id)
        kind, text = self._texts(self._can[key].feed(frame, now), f"segment of {name}")
        return kind, f"{can_id.source}→{can_id.destination} {text}"

    def _texts(self, events: Sequence[Request | Reply | LinkFault], if_none: str) -> tuple[str, str]:
        found = [self._text(event) for event in events]
        if not found:
            return "part", if_none
        return found[-1][0], "; ".join(text for _, text in found)

    def _row(self, message: Request | Reply) -> Row | None:
        """Return the row of a message by class and ID, or else by ID alone."""
        if message.id is None:
            return None
        return self._icd.rows_by_key.get((message.klass, message.id)) or self._icd.row_by_id(message.id)

    def _text(self, event: Request | Reply | LinkFault) -> tuple[str, str]:
        if isinstance(event, LinkFault):
            return "fault", f"{event.kind.value}: {event.detail}"
        row = self._row(event)
        name = row.name if row is not None else f"id {event.id}"
        if isinstance(event, Request):
            if event.kind is RequestKind.TELEMETRY:
                return "telemetry", f"{name}?"
            return "telecommand", f"{name}{_values(row, event.data)}"
        if event.kind is ReplyKind.NACK:
            return "nack", f"{name} refused: {self._icd.error_name(int(event.code))}"
        if event.kind is ReplyKind.ACK:
            return "ack", f"{name} accepted"
        return "reply", f"{name}{_values(row, event.data)}"


def _values(row: Row | None, data: bytes) -> str:
    """Format the first values of a row."""
    if row is None or not data:
        return ""
    try:
        values = list(row.decode(data, check=False).items())
    except ProtocolError as error:
        return f" {error}"
    text = " ".join(f"{name}={short(json_value(value))}" for name, value in values[:SHOWN_VALUES])
    return f" {text}{' …' if len(values) > SHOWN_VALUES else ''}"


def short(value: Any) -> str:
    """Format a value."""
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def canopen_text(frame: CanFrame) -> str:
    """Return the meaning of an 11-bit frame in CANopen."""
    if frame.id == 0:
        return "NMT command"
    if frame.id in (0x7E4, 0x7E5):
        return "LSS reply" if frame.id == 0x7E4 else "LSS request"
    node, function = frame.id & 0x7F, frame.id & 0x780
    for code, name in _CANOPEN:
        if code == function:
            if name == "SYNC or EMCY":
                return "SYNC" if node == 0 else f"node {node} EMCY"
            return f"node {node} {name}"
    return f"COB-ID {frame.id:03X}"


class RequestEncoder:
    """Encodes telecommands for the links of a unit."""

    def __init__(self, icd: InterfaceDefinition) -> None:
        self._icd = icd
        self._stack = build_serial_stack(icd) if icd.link.serial is not None else None
        self._objects = build_dictionary(icd) if icd.canopen_only else None

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
            "cansend": [cansend(frame) for frame in frames],
        }


def cansend(frame: CanFrame) -> str:
    """Return a frame as an argument of cansend."""
    number = f"{frame.id:08X}" if frame.extended else f"{frame.id:03X}"
    return f"{number}#{'R' if frame.remote else frame.data.hex().upper()}"
