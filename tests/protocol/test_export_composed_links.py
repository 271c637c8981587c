"""Exported links that are composed of framing, header and check, against our own ends of the same links."""

from __future__ import annotations

import random
import re
from typing import Any

import pytest

from starhil.protocol.errors import ProtocolError
from starhil.protocol.export.cosmos_plugin.composed import link_text, packet_key
from starhil.protocol.link_schema import CustomCheck, CustomFraming, SerialLinkModel
from starhil.protocol.messages import Reply, ReplyKind, Request, RequestKind
from starhil.protocol.serial_stack import ComposedStack, RowShape, build_stack
from tests.protocol.test_serial_stack import REPLIES, REQUESTS, STACKS

ORDERS = {"nos3": "big", "length": "big"}


def rows_of(stack: ComposedStack) -> list[RowShape]:
    return list(stack._rows.values())


def python_link(name: str) -> Any:
    stack = STACKS[name]
    text = link_text(stack, stack.classes.classes, rows_of(stack), ORDERS.get(name, "little"))
    namespace: dict[str, Any] = {"re": re}
    exec(compile(text, f"{name}_link.py", "exec"), namespace)
    return namespace["Link"]()


def key_of(stack: ComposedStack, message: Request | Reply) -> int:
    return packet_key(stack.classes.by_name.get(message.klass), message.id or 0)


def expected(stack: ComposedStack, reply: Reply) -> tuple[str, int, bytes]:
    """What the link has to make of a reply."""
    key = key_of(stack, reply)
    if reply.kind is ReplyKind.ACK:
        return "answer", key, b"\0"
    if reply.kind is ReplyKind.NACK:
        return "answer", key, bytes((int(reply.code) or 1,))
    return "telemetry", key, reply.data


@pytest.mark.parametrize("name", STACKS)
def test_the_device_reads_every_request(name: str) -> None:
    stack, link = STACKS[name], python_link(name)
    for request in REQUESTS[name]:
        (seen,) = stack.device().feed(link.request(key_of(stack, request), request.data), 0.0)
        assert isinstance(seen, Request)
        assert (seen.kind, seen.id, seen.data, seen.klass) == (
            request.kind,
            request.id,
            request.data,
            request.klass,
        )


@pytest.mark.parametrize("name", REPLIES)
def test_every_reply_is_read_in_pieces_of_any_size_and_amid_noise(name: str) -> None:
    stack, rng = STACKS[name], random.Random(5)
    for reply in REPLIES[name]:
        for piece in (1, 3, 1000):
            link = python_link(name)
            noise = rng.randbytes(rng.randrange(6)).translate(
                bytes(value & 0x3F | 0x20 for value in range(256))
            )
            sent = (b"" if stack.framing.start else stack.framing.end) + stack.encode_reply(reply)
            found = [
                message
                for start in range(0, len(noise + sent), piece)
                for message in link.receive((noise + sent)[start : start + piece])
            ]
            assert found == [expected(stack, reply)]


@pytest.mark.parametrize("name", REPLIES)
def test_no_damaged_reply_is_taken_where_there_is_a_check(name: str) -> None:
    stack, rng = STACKS[name], random.Random(6)
    for reply in REPLIES[name]:
        sent = stack.encode_reply(reply)
        for _ in range(60):
            damaged = bytearray(sent)
            damaged[rng.randrange(len(sent))] ^= rng.randrange(1, 256)
            theirs = [
                expected(stack, event)[1:]
                for event in stack.host().feed(bytes(damaged), 0.0)
                if isinstance(event, Reply)
            ]
            assert [message[1:] for message in python_link(name).receive(bytes(damaged))] == theirs


def test_an_echo_is_consumed_before_the_reply() -> None:
    stack, link = STACKS["nos3"], python_link("nos3")
    data = b"\xbe\xef" * 4 + b"\x01"
    request = Request(RequestKind.TELEMETRY, 2, bytes(4), klass="telemetry")
    sent = link.request(2, b"")
    assert sent == stack.encode_request(request)
    reply = stack.encode_reply(Reply(ReplyKind.TELEMETRY, 2, data, klass="telemetry"))
    assert link.receive(sent + reply) == [("telemetry", 2, data)]
    noop = link.request(0, b"")
    assert link.receive(noop) == [("answer", 0, b"\0")]


@pytest.mark.parametrize(
    "link",
    [
        {"framing": {"kind": "custom", "name": "mine"}},
        {"framing": {"kind": "slip"}, "check": {"kind": "custom", "name": "mine"}},
    ],
)
def test_code_of_a_plugin_is_refused(link: dict[str, Any]) -> None:
    model = SerialLinkModel.model_validate({**link, "request_header": [{"role": "id", "type": "u8"}]})
    custom: Any = {"mine": STACKS["nsp"].framing}
    stack = build_stack(model, framings=custom, checks={"mine": lambda _data: b""})
    assert isinstance(stack, ComposedStack)
    assert isinstance(model.framing, CustomFraming) or isinstance(model.check, CustomCheck)
    with pytest.raises(ProtocolError, match="'mine' is code of the unit's plugin"):
        link_text(stack, (), (), "little")
