"""The bench's receiver of the CubeSpace dialects takes messages for what the judge, which reads them by itself, takes them for."""

from __future__ import annotations

import random

import pytest

from starhil.hil_tests.judge.definition import unit_of
from starhil.hil_tests.judge.messages import Request as JudgedRequest
from starhil.hil_tests.judge.serial import SerialLine
from starhil.protocol.messages import LinkFault, Request
from starhil.protocol.serial.cubespace import Dialect
from starhil.protocol.unit import load_unit
from tests.protocol.serial.composed_links import CUBESTAR

ICD = load_unit()
UNIT = unit_of(ICD)
ROWS = list(ICD.rows)
STARTS = {Dialect.A: (0x7F,), Dialect.B: (0x7F,), Dialect.C: (0x7F, 0x07, 0x0F, 0x4F, 0x2F)}
SAME = {"event": "unsolicited"}
"""The judge has one name for both."""


def message(rng: random.Random, dialect: Dialect, row_id: int, data: bytes) -> bytes:
    body = data if dialect is Dialect.B else bytes([row_id]) + data
    return bytes([0x1F, rng.choice(STARTS[dialect])]) + body.replace(b"\x1f", b"\x1f\x1f") + b"\x1f\xff"


def kinds(dialect: Dialect, awaited: int, line: bytes) -> tuple[list[str], list[str]]:
    """What the receiver and the judge make of bytes, if they await the answer to a request."""
    receiver, judge = CUBESTAR.host(dialect), SerialLine(UNIT, dialect.value)
    receiver.overhear(Request.of(awaited))
    judge.expect(JudgedRequest(awaited))
    received = receiver.feed(line, 0.0)
    found = ["malformed" if isinstance(each, LinkFault) else each.kind.value for each in received]
    return [SAME.get(each, each) for each in found], [answer.kind for answer in judge.feed(line)]


@pytest.mark.parametrize("dialect", Dialect)
def test_a_message_is_of_the_same_kind(dialect: Dialect) -> None:
    """But for acknowledges with data, which only the judge rejects, and messages without a byte, whose size is checked later."""
    rng = random.Random(3)
    seen = set()
    for _ in range(2000):
        row = rng.choice(ROWS)
        size = rng.choice([1, 1, 2, 3, row.size or 1])
        line = message(rng, dialect, row.id, bytes(rng.choices([0, 0, 1, 6, 11, 0x77], k=size)))
        received, judged = kinds(dialect, row.id, line)
        if (received, line[1]) != (["ack"], 0x07):
            assert received == judged, (row.name, line.hex())
        seen.update(received)
    assert {"telemetry", "nack", "malformed"} <= seen


def test_a_late_reply_to_another_request_changes_nothing_of_the_next_message() -> None:
    rng = random.Random(4)
    for _ in range(500):
        late, awaited = rng.sample(ROWS, 2)
        data = bytes(late.size) if late.kind == "telemetry" else b"\0"
        refusal = message(rng, Dialect.A, awaited.id, bytes([rng.randrange(1, 9)]))
        received, judged = kinds(Dialect.A, awaited.id, message(rng, Dialect.A, late.id, data) + refusal)
        assert received[1:] == judged[1:] == kinds(Dialect.A, awaited.id, refusal)[0], (
            late.name,
            awaited.name,
        )
