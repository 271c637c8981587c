"""Mutants of the serial link."""

from __future__ import annotations

import dataclasses

from starhil.protocol.icd.link_schema import LinkModel
from starhil.protocol.messages import FaultKind, LinkFault, Reply, ReplyKind, Request
from starhil.protocol.serial.stack import SerialStack
from tests.conformance.mutant_seams import (
    enter,
    events,
    incoming,
    mutant,
    outgoing,
    without_faults,
)
from tests.conformance.simulated import SimulatedUnit

enter(
    "replies are not stuffed",
    "serial",
    "data.escapes",
    outgoing(lambda data: [data[:2] + data[2:-2].replace(b"\x1f\x1f", b"\x1f") + data[-2:]]),
)
enter("replies lack the end mark", "serial", "framing.one", outgoing(lambda data: [data[:-2]]))
enter("replies lack the start mark", "serial", "framing.one", outgoing(lambda data: [data[2:]]))
enter("replies come twice", "serial", "framing.one", outgoing(lambda data: [data, data]))
enter("a stray byte follows each reply", "serial", "framing.one", outgoing(lambda data: [data + b"\0"]))
enter(
    "replies carry an identifier in dialect b",
    "serial",
    "framing.one",
    outgoing(lambda data: [data[:2] + b"\x80" + data[2:]]),
)
enter(
    "the first byte of telemetry is dropped",
    "serial",
    "framing.one",
    outgoing(lambda data: [data[:2] + data[3:]] if len(data) > 6 else [data]),
)
enter(
    "only the first request of a piece is taken",
    "serial",
    "framing.two-at-once",
    incoming(lambda data: [data[: data.find(b"\x1f\xff") + 2]] if b"\x1f\xff" in data else [data]),
)
enter(
    "requests must come in one piece",
    "serial",
    "framing.byte-by-byte",
    incoming(lambda data: [data] if data.startswith(b"\x1f\x7f") and data.endswith(b"\x1f\xff") else []),
)
enter(
    "a piece that begins with junk is dropped whole",
    "serial",
    "framing.junk-before",
    incoming(lambda data: [data] if data[:1] == b"\x1f" else []),
)
enter(
    "any start mark begins a request",
    "serial",
    "framing.start-of-nack",
    incoming(lambda data: [data.replace(b"\x1f\x0f", b"\x1f\x7f")]),
)
enter(
    "junk is not flagged",
    "serial",
    "errors.junk",
    without_faults(FaultKind.UART_PROTOCOL),
)
enter(
    "half messages are not flagged",
    "serial",
    "errors.half",
    without_faults(FaultKind.UART_INCOMPLETE),
)
enter(
    "half messages are flagged as junk",
    "serial",
    "errors.cut-off",
    events(
        lambda event: [LinkFault(FaultKind.UART_PROTOCOL, "")] if isinstance(event, LinkFault) else [event]
    ),
)


def _receiving_with(unit: SimulatedUnit, **limits: float) -> None:
    """Receive with other limits, which are keys of [link.serial]."""
    link = unit.link._stack.link.model_copy(update=limits)
    icd = dataclasses.replace(unit.device.icd, link=LinkModel(serial=link))
    unit.link._receiver = SerialStack(icd).device()


@mutant("incomplete messages never time out", "serial", "framing.half")
def never_given_up(unit: SimulatedUnit) -> None:
    _receiving_with(unit, timeout=1e9)


@mutant("messages time out after 50 ms", "serial", "framing.pause")
def given_up_early(unit: SimulatedUnit) -> None:
    _receiving_with(unit, timeout=0.05)


@mutant("long messages are not taken", "serial", "framing.longest")
def short_buffer(unit: SimulatedUnit) -> None:
    _receiving_with(unit, max_size=100)


@mutant("messages of any length are taken", "serial", "framing.overlong")
def endless_buffer(unit: SimulatedUnit) -> None:
    _receiving_with(unit, max_size=1 << 20)


@mutant("stuffed bytes stay doubled in requests", "serial", "stuffing.taken-out")
def not_taken_out(unit: SimulatedUnit) -> None:
    events(
        lambda event: (
            [dataclasses.replace(event, data=event.data.replace(b"\x1f", b"\x1f\x1f"))]
            if isinstance(event, Request)
            else [event]
        )
    )(unit)


@mutant("unsolicited telemetry comes in a dialect that has none", "serial", "unsolicited.rate")
def talkative(unit: SimulatedUnit) -> None:
    def say(reply: Reply) -> None:
        unit.link._send_unsolicited(dataclasses.replace(reply, kind=ReplyKind.TELEMETRY))

    unit.device.signals.unsolicited.observers[:] = [say]


def _answering(row_id: int):
    def change(unit: SimulatedUnit) -> None:
        unit.link._stack._silent -= {row_id}

    return change


enter("reset is acknowledged on a serial line", "serial", "reset.acknowledged", _answering(1))
enter("a refused reset is answered on a serial line", "serial", "reset.magic", _answering(1))
enter("the start of a program is refused aloud", "serial", "lengths.run_program.long", _answering(101))
enter("the start of a burst is acknowledged on a serial line", "serial", "bursts.block", _answering(119))


@mutant("replies leave faster than the line", "serial", "timing.pace")
def unpaced(unit: SimulatedUnit) -> None:
    unit.transport._pace = None


@mutant("replies take half a second", "both", "timing.reply")
def slow(unit: SimulatedUnit) -> None:
    send = unit.link.wire.send
    unit.link.wire.send = lambda item: unit.loop.call_later(0.4, send, item)
