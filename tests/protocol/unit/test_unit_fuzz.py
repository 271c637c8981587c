"""Every bundled unit: its decoders withstand mutated input (STARHIL_FUZZ_INPUTS sets the number), another unit's bytes included."""

from __future__ import annotations

import os
import random

import pytest

from starhil.protocol.files.bundled import bundled_units
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.icd.values import MessageError
from starhil.protocol.messages import FaultKind, LinkFault, Reply, ReplyKind, Request
from starhil.protocol.serial.stack import SerialStack
from starhil.protocol.unit import load_unit
from tests.protocol.mutations import mutated

pytestmark = pytest.mark.long

INPUTS = int(os.environ.get("STARHIL_FUZZ_INPUTS", "1500"))
SEED = 20261122
UNITS = [name for name in bundled_units() if load_unit(name).link.serial is not None]
FOREIGN = [
    (unit, other)
    for unit in UNITS
    for other in UNITS
    if unit != other and not (unit.startswith("cubestar") and other.startswith("cubestar"))
]
"""Pairs of units that do not speak the same framing with the same check."""
MARKS = b"\xc0\xdb\xdc\xdd\x1f\x7f\xff\xde\xad\xbe\xef\x00\x21"


def exchanges(icd: InterfaceDefinition, stack: SerialStack) -> tuple[list[bytes], list[bytes]]:
    """Return good requests and good replies of each row as bytes."""
    requests, replies = [], []
    for row in icd.rows:
        request = icd.request(row, row.encode(row.example()) if row.kind == "telecommand" else b"")
        requests.append(stack.encode_request(request))
        kind = ReplyKind.ACK if row.kind == "telecommand" else ReplyKind.TELEMETRY
        data = b"" if kind is ReplyKind.ACK else row.encode()
        if len(data) < 200:
            replies.append(stack.encode_reply(Reply(kind, row.id, data, message_class=row.message_class)))
    return requests, replies


@pytest.mark.parametrize("unit", UNITS)
def test_decoders_survive_mutated_input_and_read_the_next_request(unit):
    icd = load_unit(unit)
    stack = SerialStack(icd)
    requests, replies = exchanges(icd, stack)
    rows = list(icd.rows)
    source = random.Random(SEED)
    device, host = stack.device(), stack.host()
    now = 0.0
    decoded = 0
    for _ in range(INPUTS):
        now += source.choice((0.0, 0.01, 0.6))
        for event in device.feed(mutated(requests, source, MARKS), now):
            decoded += decode(icd, event)
        row = source.choice(rows)
        host.overhear(icd.request(row))
        for event in host.feed(mutated(replies, source, MARKS), now):
            decoded += decode(icd, event)
    assert decoded > INPUTS // 10
    device.flush(now + 1.0)
    assert not device.busy
    (request,) = device.feed(requests[-1], now + 2.0)
    assert isinstance(request, Request)
    assert request.id == rows[-1].id


def decode(icd: InterfaceDefinition, event: Request | Reply | LinkFault) -> bool:
    """Decode the data of a message as its row says; return whether that is possible."""
    if isinstance(event, LinkFault):
        return False
    row = icd.row(event.id or 0, event.message_class)
    if row is None:
        return False
    try:
        row.decode(event.data)
    except MessageError:
        return False
    return True


@pytest.mark.parametrize(("unit", "other"), FOREIGN)
def test_bytes_of_another_unit_are_flagged_and_survived(unit, other):
    stack, foreign = SerialStack(load_unit(unit)), SerialStack(load_unit(other))
    receiver = stack.device()
    kinds: list[FaultKind] = []
    for number, sent in enumerate(exchanges(load_unit(other), foreign)[0]):
        events = [*receiver.feed(sent, number), *receiver.flush(number + 0.9)]
        faults = [event for event in events if isinstance(event, LinkFault)]
        expected = [
            event
            for event in events
            if isinstance(event, Request) and stack.icd.row(event.id, event.message_class)
        ]
        assert not expected, (sent.hex(), events)  # any line may be the text of a request, but of no row
        assert faults == events or stack.text_formats, (sent.hex(), events)
        kinds += [event.kind for event in faults]
    assert kinds
    own = exchanges(load_unit(unit), stack)[0][0]
    assert isinstance(receiver.feed(own, 1e6)[-1], Request)
