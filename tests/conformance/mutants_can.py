"""Mutants of the CAN link."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

from starhil.protocol.can.cubespace import CanDeviceReceiver, CanId
from starhil.protocol.can.frame import CanFrame
from starhil.protocol.messages import FaultKind, LinkFault, Request, RequestKind
from tests.conformance.mutant_seams import (
    enter,
    events,
    incoming,
    mutant,
    outgoing,
)
from tests.conformance.simulated import SimulatedUnit


def _identified(**changes: Callable[[CanId], int]) -> Callable[[CanFrame], list[CanFrame]]:
    def change(frame: CanFrame) -> list[CanFrame]:
        old = CanId.unpack(frame.id)
        new = dataclasses.replace(old, **{name: value(old) for name, value in changes.items()})
        return [CanFrame(new.pack(), frame.data)]

    return change


enter(
    "replies do not exchange the addresses",
    "can",
    "frames.telemetry",
    outgoing(_identified(source=lambda i: i.destination, destination=lambda i: i.source)),
)
enter(
    "replies go to address 1 whoever asks",
    "can",
    "frames.askers",
    outgoing(_identified(destination=lambda _i: 1)),
)
enter(
    "replies carry another identifier",
    "can",
    "frames.telemetry",
    outgoing(_identified(id=lambda i: i.id ^ 1)),
)
enter(
    "acknowledges have the type of telemetry",
    "can",
    "frames.ack",
    outgoing(_identified(type=lambda i: 5 if i.type == 2 else i.type)),
)
enter(
    "telemetry is refused with the type of telecommands",
    "can",
    "frames.unknown-telemetry",
    outgoing(_identified(type=lambda i: 3 if i.type == 6 else i.type)),
)
enter(
    "acknowledges carry a byte",
    "can",
    "frames.ack",
    outgoing(lambda f: [CanFrame(f.id, b"\0") if f.id >> 24 == 2 else f]),
)
enter(
    "frames are padded to 8 bytes",
    "can",
    "frames.telemetry-6",
    outgoing(lambda f: [CanFrame(f.id, f.data.ljust(8, b"\0"))]),
)
enter(
    "segments count up",
    "can",
    "segments.reply",
    outgoing(
        lambda f: [
            CanFrame(f.id, f.data[:-1] + bytes([7 - f.data[-1]])) if f.id >> 24 == 8 and f.data[-1] < 8 else f
        ]
    ),
)
enter(
    "the last segment is padded",
    "can",
    "segments.reply",
    outgoing(lambda f: [CanFrame(f.id, f.data[:-1].ljust(7, b"\0") + f.data[-1:]) if f.id >> 24 == 8 else f]),
)
enter(
    "segments have the type of single frames",
    "can",
    "segments.reply",
    outgoing(_identified(type=lambda i: 5 if i.type == 8 else i.type)),
)
enter(
    "a segment of the reply is lost",
    "can",
    "segments.reply",
    outgoing(lambda f: [] if f.id >> 24 == 8 and f.data[-1] == 3 else [f]),
)
enter(
    "frames for other addresses are answered",
    "can",
    "frames.other-device",
    incoming(lambda f: [CanFrame(f.id & ~0xFF | 4, f.data) if f.extended and not f.remote else f]),
)
enter(
    "11-bit frames are answered",
    "can",
    "frames.standard",
    incoming(lambda f: [f] if f.extended else [CanFrame(0x04000104 | 0x80 << 16)]),
)
enter(
    "remote frames are answered",
    "can",
    "frames.remote",
    incoming(lambda f: [CanFrame(f.id)] if f.remote else [f]),
)
enter(
    "replies of others are taken for requests",
    "can",
    "frames.type-5",
    incoming(lambda f: [CanFrame(f.id & ~(0x1F << 24) | 4 << 24)] if f.extended and f.id >> 24 == 5 else [f]),
)
enter(
    "unknown types are taken for requests",
    "can",
    "frames.type-31",
    incoming(
        lambda f: [CanFrame(f.id & ~(0x1F << 24) | 4 << 24)] if f.extended and f.id >> 24 == 31 else [f]
    ),
)
enter(
    "faults are not flagged",
    "can",
    "errors.sequence",
    events(lambda event: [] if isinstance(event, LinkFault) else [event]),
)
enter(
    "faults are flagged as those of the serial line",
    "can",
    "errors.type",
    events(
        lambda event: [LinkFault(FaultKind.UART_PROTOCOL, "")] if isinstance(event, LinkFault) else [event]
    ),
)
enter(
    "a type that is no request counts as a request",
    "can",
    "errors.type",
    events(
        lambda event: (
            [event, Request(RequestKind.TELECOMMAND, 103)][::-1] if isinstance(event, LinkFault) else [event]
        )
    ),
)


@mutant("segments of two hosts are mixed", "can", "segments.two-hosts")
def mixed_hosts(unit: SimulatedUnit) -> None:
    incoming(lambda f: [CanFrame(f.id & ~0xFF00 | 0x0100, f.data) if f.extended and f.id >> 24 == 7 else f])(
        unit
    )


@mutant("incomplete messages never time out", "can", "segments.half")
def can_never_given_up(unit: SimulatedUnit) -> None:
    unit.link._receiver = CanDeviceReceiver(4, timeout_s=1e9)


@mutant("segments must follow within 50 ms", "can", "segments.pause")
def can_given_up_early(unit: SimulatedUnit) -> None:
    unit.link._receiver = CanDeviceReceiver(4, timeout_s=0.05)


@mutant("long messages are not taken", "can", "segments.long")
def can_short_buffer(unit: SimulatedUnit) -> None:
    unit.link._receiver = CanDeviceReceiver(4, max_size=100)


@mutant("the order of segments is not checked", "can", "segments.swapped")
def unordered(unit: SimulatedUnit) -> None:
    waiting: dict[int, list[bytes]] = {}

    def change(frame: CanFrame) -> list[CanFrame]:
        if not frame.extended or frame.id >> 24 != 7 or not frame.data:
            return [frame]
        parts = waiting.setdefault(frame.id, [])
        parts.append(frame.data[:-1])
        if frame.data[-1]:
            return []
        del waiting[frame.id]
        return [
            CanFrame(frame.id, part.ljust(7, b"\0")[:7] + bytes([len(parts) - 1 - n]))
            for n, part in enumerate(parts)
        ]

    incoming(change)(unit)


@mutant("each segment is answered", "can", "frames.segmented-unknown")
def each_segment_answered(unit: SimulatedUnit) -> None:
    def change(frame: CanFrame) -> list[CanFrame]:
        if frame.extended and frame.id >> 24 == 7 and frame.data and frame.data[-1]:
            unit.link.wire.send(CanFrame(0x02000401 | frame.id & 0xFF0000))
        return [frame]

    incoming(change)(unit)
