"""Recorded traffic as a pcapng file, which Wireshark opens: CAN as SocketCAN, serial bytes as they came."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from typing import Final

from starhil.emulator.links.traffic import WireItem
from starhil.protocol.can.frame import CanFrame

SECTION: Final = 0x0A0D0D0A
INTERFACE: Final = 1
PACKET: Final = 6
BYTE_ORDER: Final = 0x1A2B3C4D
CAN_SOCKETCAN: Final = 227
"""Link type of SocketCAN frames (tcpdump.org, link-layer header types)."""
USER: Final = 147
"""Link type without a defined content, for serial bytes."""
EXTENDED: Final = 1 << 31
REMOTE: Final = 1 << 30
NAME, FLAGS = 2, 2
"""Options: name of an interface, flags of a packet."""
INBOUND, OUTBOUND = 1, 2
"""Directions in the flags, as the device sees them."""


def pcapng(items: Iterable[WireItem]) -> bytes:
    """Return items as a pcapng file, with an interface for each bus; times are Unix times in microseconds."""
    blocks = [_block(SECTION, struct.pack("<IHHq", BYTE_ORDER, 1, 0, -1))]
    interfaces: dict[tuple[str, int], int] = {}
    for item in items:
        kind = CAN_SOCKETCAN if isinstance(item.item, CanFrame) else USER
        key = item.bus, kind
        if key not in interfaces:
            interfaces[key] = len(interfaces)
            options = _option(NAME, item.bus.encode()) + _option(0, b"")
            blocks.append(_block(INTERFACE, struct.pack("<HHI", kind, 0, 0) + options))
        data = _socketcan(item.item) if isinstance(item.item, CanFrame) else item.item
        high, low = divmod(round(item.at_s * 1e6), 1 << 32)
        flags = _option(FLAGS, struct.pack("<I", OUTBOUND if item.outgoing else INBOUND)) + _option(0, b"")
        head = struct.pack("<IIIII", interfaces[key], high, low, len(data), len(data))
        blocks.append(_block(PACKET, head + _padded(data) + flags))
    return b"".join(blocks)


def _socketcan(frame: CanFrame) -> bytes:
    number = frame.id | (EXTENDED if frame.extended else 0) | (REMOTE if frame.remote else 0)
    return struct.pack(">IB3x", number, len(frame.data)) + frame.data


def _padded(data: bytes) -> bytes:
    return data + bytes(-len(data) % 4)


def _option(code: int, value: bytes) -> bytes:
    return struct.pack("<HH", code, len(value)) + _padded(value)


def _block(kind: int, body: bytes) -> bytes:
    size = struct.pack("<I", len(body) + 12)
    return struct.pack("<I", kind) + size + body + size
