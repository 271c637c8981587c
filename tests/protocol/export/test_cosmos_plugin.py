"""The protocol of the exported COSMOS plugin against our own ends of the serial line, without COSMOS."""

from __future__ import annotations

import random
from pathlib import Path
from typing import Any

import pytest

from starhil.protocol.export.cosmos_plugin import answer_id
from starhil.protocol.messages import ErrorCode, Reply, ReplyKind, Request
from starhil.protocol.serial.cubespace import Dialect
from starhil.protocol.unit import load_unit
from tests.protocol.export.cosmos_plugin import Plugin
from tests.protocol.export.test_export import packets
from tests.protocol.serial.composed_links import CUBESPACE, CUBESTAR

pytestmark = pytest.mark.long

ICD = load_unit()
ANSWER = answer_id(ICD)


def protocol(folder: Path, dialect: Dialect) -> Any:
    return Plugin(ICD, folder, dialect=dialect.value, reply_timeout=0).protocol()


def read(link: Any, data: bytes, piece: int = 7) -> list[bytes]:
    """Return the packets that COSMOS gets from bytes that come in pieces."""
    packets = []
    for start in range(0, len(data), piece):
        packet, _ = link.read_data(data[start : start + piece])
        while packet != "STOP":
            packets.append(packet)
            packet, _ = link.read_data(b"")
    return packets


@pytest.mark.parametrize("dialect", Dialect)
def test_every_row_goes_out_and_its_reply_becomes_its_packet(tmp_path: Path, dialect: Dialect) -> None:
    link, device = protocol(tmp_path, dialect), CUBESPACE.device()
    for row in ICD.rows:
        for _, data in packets(row):
            payload = data if row.kind == "telecommand" else b""
            sent, _ = link.write_data(bytes((row.id,)) + payload)
            assert device.feed(sent, 0.0) == [Request.of(row.id, payload)]
            if not CUBESTAR.answers(row):
                assert link.answered.is_set()
                continue
            accepted = Reply(ReplyKind.ACK, row.id)
            reply = accepted if row.kind == "telecommand" else Reply(ReplyKind.TELEMETRY, row.id, data)
            packet = bytes((ANSWER, row.id, 0)) if row.kind == "telecommand" else bytes((row.id,)) + data
            assert read(link, CUBESPACE.encode_reply(reply, dialect)) == [packet]
            if row.kind == "telecommand" or row.size != 1 or dialect is Dialect.C:
                link.write_data(bytes((row.id,)) + payload)
                refusal = Reply(ReplyKind.NACK, row.id, code=ErrorCode.BUSY)
                assert read(link, CUBESPACE.encode_reply(refusal, dialect)) == [
                    bytes((ANSWER, row.id, ErrorCode.BUSY))
                ]


@pytest.mark.parametrize("dialect", Dialect)
def test_noise_between_replies_costs_no_reply_after_it(tmp_path: Path, dialect: Dialect) -> None:
    link, rng = protocol(tmp_path, dialect), random.Random(3)
    row = ICD.telemetry["quaternion"]
    for _ in range(200):
        data = rng.randbytes(row.size)
        link.write_data(bytes((row.id,)))
        noise = rng.randbytes(rng.randrange(20)).replace(b"\x1f", b"\x00")
        reply = CUBESPACE.encode_reply(Reply(ReplyKind.TELEMETRY, row.id, data), dialect)
        assert read(link, noise + reply, rng.randrange(1, 9)) == [bytes((row.id,)) + data]


def test_half_a_reply_is_dropped_after_silence(tmp_path: Path) -> None:
    link = protocol(tmp_path, Dialect.A)
    reply = CUBESPACE.encode_reply(Reply(ReplyKind.TELEMETRY, 230, bytes(6)), Dialect.A)
    link.write_data(b"\xe6")
    assert read(link, reply[:5]) == []
    link.last_received -= 1.0
    link.write_data(b"\xe6")
    assert read(link, reply) == [b"\xe6" + bytes(6)]


def test_unsolicited_telemetry_and_bursts_are_packets_of_their_own(tmp_path: Path) -> None:
    link = protocol(tmp_path, Dialect.C)
    link.write_data(b"\xe6")
    unsolicited = CUBESPACE.encode_reply(Reply(ReplyKind.UNSOLICITED, 229, bytes(6)), Dialect.C)
    burst = CUBESPACE.encode_reply(Reply(ReplyKind.BURST, 119, bytes(22)), Dialect.C)
    reply = CUBESPACE.encode_reply(Reply(ReplyKind.TELEMETRY, 230, bytes(6)), Dialect.C)
    found = read(link, unsolicited + burst + reply)
    assert found == [b"\xe5" + bytes(6), b"\x77" + bytes(22), b"\xe6" + bytes(6)]


def test_a_command_waits_for_the_previous_reply_up_to_a_limit(tmp_path: Path) -> None:
    link = Plugin(ICD, tmp_path, dialect="b", reply_timeout=0.05).protocol()
    link.write_data(b"\xe6")
    assert not link.answered.is_set()
    link.write_data(b"\x80")  # after the time-out
    assert read(link, CUBESPACE.encode_reply(Reply(ReplyKind.TELEMETRY, 128, bytes(8)), Dialect.B)) == [
        b"\x80" + bytes(8)
    ]
    assert link.answered.is_set()


def test_an_unknown_dialect_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="dialect d: must be a, b or c"):
        Plugin(ICD, tmp_path, dialect="d").protocol()
