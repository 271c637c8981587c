"""The traffic on the links of a head: reported as it passes, and decoded for display."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

from starhil.emulator.links.base import AnyLink
from starhil.emulator.links.canopen_trace import CanopenDecoder
from starhil.emulator.simulation.signal import Signal
from starhil.protocol.can.cubespace import REQUEST_KINDS, CanDeviceReceiver, CanHostReceiver, CanId
from starhil.protocol.can.frame import CanFrame
from starhil.protocol.canopen.device_dictionary import DeviceDictionary
from starhil.protocol.errors import ProtocolError
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.icd.codec import Row
from starhil.protocol.icd.values import Value
from starhil.protocol.messages import LinkFault, Reply, ReplyKind, Request, RequestKind
from starhil.protocol.serial.cubespace import Dialect
from starhil.protocol.serial.framings import Deframer
from starhil.protocol.serial.stack import HostReceiver, SerialStack
from starhil.protocol.transports.paced import SerialTransport

SHOWN_VALUES: Final = 8

CONSOLE_ADDRESS: Final = 253
"""CAN address of the OBC of console and recording, by which its own requests are recognised."""

CONSOLE_BUS: Final = "console"
"""Name of the line or bus that console and recording have to themselves."""

MAX_ADDRESSES: Final = 64
"""Maximum number of addresses whose segments are joined: a link fault can cause many random CAN IDs."""

_CANOPEN: Final = (
    (0x080, "SYNC or EMCY"), (0x180, "TPDO 1"), (0x200, "RPDO 1"), (0x280, "TPDO 2"), (0x300, "RPDO 2"),
    (0x380, "TPDO 3"), (0x400, "RPDO 3"), (0x480, "TPDO 4"), (0x500, "RPDO 4"), (0x580, "SDO reply"),
    (0x600, "SDO request"), (0x700, "heartbeat"),
)  # fmt: skip
"""Function codes of CANopen's predefined connection set."""


@dataclass(frozen=True, slots=True)
class WireItem:
    """Bytes or a CAN frame on a link."""

    at_s: float
    """Unix time."""
    bus: str
    """`serial`, `can`, or `console` for the line or bus that the console has to itself."""
    outgoing: bool
    item: bytes | CanFrame


class Traffic:
    """Reports each item on the links of a head, with the signal `passed`.

    On a CAN bus with two links, both receive the same frames, which are reported once.
    """

    def __init__(self) -> None:
        self.passed: Signal[WireItem] = Signal("traffic")
        self._buses: set[str] = set()

    def add(self, link: AnyLink, bus: str = "") -> None:
        """Report the items of a link, under the name of its bus or another one."""
        bus = bus or link.bus
        link.wire.listener = partial(self._report, bus, True)  # noqa: FBT003 (outgoing)
        if bus not in self._buses or isinstance(link.transport, SerialTransport):
            self._buses.add(bus)
            link.transport.listener = partial(self._report, bus, False)  # noqa: FBT003 (incoming)

    def _report(self, bus: str, outgoing: bool, item: bytes | CanFrame) -> None:
        if self.passed.observers:
            self.passed.emit(WireItem(time.time(), bus, outgoing, item))


class Decoder:
    """Decodes the items of a trace, in order; CANopen by names and values if the dictionary of `objects` is given."""

    def __init__(
        self,
        icd: InterfaceDefinition,
        dialect: Callable[[], Dialect | None],
        objects: DeviceDictionary | None = None,
    ) -> None:
        self._icd = icd
        self._dialect = dialect
        self._canopen = None if objects is None else CanopenDecoder(objects)
        self._stack = SerialStack(icd) if icd.link.serial is not None else None
        self._to_device: dict[str, Deframer[Request]] = {}
        """Receivers of requests by the name of the line."""
        self._from_device: dict[str, tuple[Dialect | None, HostReceiver]] = {}
        self._can: dict[tuple[bool, int], CanDeviceReceiver | CanHostReceiver] = {}

    def line(self, entry: WireItem) -> dict[str, Any]:
        """Decode one item to a line of the trace, as JSON data."""
        events, item, own = self.events(entry), entry.item, entry.bus == CONSOLE_BUS
        found = [self._text(event) for event in events] or [self._part(item)]
        kind, text = found[-1][0], "; ".join(text for _, text in found)
        if isinstance(item, CanFrame):
            raw = str(item)
            if item.extended and self._icd.link.can is not None:
                can_id = CanId.unpack(item.id)
                text = f"{can_id.source}→{can_id.destination} {text}"
                own = CONSOLE_ADDRESS in (can_id.source, can_id.destination)
        else:
            raw = item.hex(" ").upper()
        return {
            "t": entry.at_s,
            "bus": entry.bus,
            "out": entry.outgoing,
            "raw": raw,
            "kind": kind,
            "text": text,
            "own": own,
        }

    def events(self, entry: WireItem) -> Sequence[Request | Reply | LinkFault]:
        """Return the messages that are complete with an item; none in 11-bit CAN frames."""
        if isinstance(entry.item, CanFrame):
            return self._can_events(entry.item, entry.at_s)
        return self._serial_events(entry, entry.item)

    def _serial_events(self, entry: WireItem, data: bytes) -> Sequence[Request | Reply | LinkFault]:
        stack, line, now = self._stack, entry.bus, entry.at_s
        if stack is None:
            return ()
        dialect = self._dialect()
        if line not in self._from_device or self._from_device[line][0] is not dialect:
            self._from_device[line] = (dialect, stack.host(dialect))
        host = self._from_device[line][1]
        if entry.outgoing:
            return host.feed(data, now)
        if line not in self._to_device:
            self._to_device[line] = stack.device()
        requests = self._to_device[line].feed(data, now)
        for event in requests:
            if isinstance(event, Request):
                host.overhear(event)
        return requests

    def _can_events(self, frame: CanFrame, now: float) -> Sequence[Request | Reply | LinkFault]:
        if not frame.extended or self._icd.link.can is None:
            return ()
        can_id = CanId.unpack(frame.id)
        request = can_id.type in REQUEST_KINDS
        key = (request, can_id.destination)
        if key not in self._can:
            if len(self._can) >= MAX_ADDRESSES:
                self._can.clear()
            self._can[key] = (CanDeviceReceiver if request else CanHostReceiver)(can_id.destination)
        return self._can[key].feed(frame, now)

    def _part(self, item: bytes | CanFrame) -> tuple[str, str]:
        """Return kind and text of an item without a complete message."""
        if not isinstance(item, CanFrame):
            return "part", "bytes" if self._stack is None else "part of a message"
        if not item.extended:
            return ("canopen", canopen_text(item)) if self._canopen is None else self._canopen.line(item)
        if self._icd.link.can is None:
            return "part", "29-bit frame"
        number = CanId.unpack(item.id).id
        row = self._icd.row(number)
        return "part", f"segment of {row.name if row is not None else number}"

    def row_of(self, message: Request | Reply) -> Row | None:
        """Return the row of a message by class and ID, or by ID alone if it has no class."""
        return None if message.id is None else self._icd.row(message.id, message.message_class)

    def row_named(self, name: str) -> Row | None:
        return next((row for row in self._icd.rows if row.name == name), None)

    def _text(self, event: Request | Reply | LinkFault) -> tuple[str, str]:
        if isinstance(event, LinkFault):
            return "fault", f"{event.kind.value}: {event.detail}"
        row = self.row_of(event)
        name = row.name if row is not None else f"id {event.id}"
        if isinstance(event, Request):
            if event.kind is RequestKind.TELEMETRY:
                return "telemetry", f"{name}?"
            return "telecommand", f"{name}{values_text(row, event.data)}"
        if event.kind is ReplyKind.NACK:
            return "nack", f"{name} refused: {self._icd.error_name(int(event.code))}"
        if event.kind is ReplyKind.ACK:
            return "ack", f"{name} accepted"
        return "reply", f"{name}{values_text(row, event.data)}"


def values_text(row: Row | None, data: bytes) -> str:
    if row is None or not data:
        return ""
    try:
        values = list(row.decode(data, check=False).items())
    except ProtocolError as error:
        return f" {error}"
    text = " ".join(f"{name}={short(value)}" for name, value in values[:SHOWN_VALUES])
    return f" {text}{' …' if len(values) > SHOWN_VALUES else ''}"


def short(value: Value) -> str:
    """Format a value: a float with six digits, or all before the point and six after it."""
    if isinstance(value, bytes):
        return value.hex(" ").upper()
    if not isinstance(value, float):
        return str(value)
    return f"{value:.6f}".rstrip("0").rstrip(".") if 1e6 <= abs(value) < 1e15 else f"{value:.6g}"


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
