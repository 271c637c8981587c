"""Exported links that are composed of framing, header and check, against our own ends of the same links."""

from __future__ import annotations

import random
import re
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest

from starhil.protocol.errors import IcdError, ProtocolError
from starhil.protocol.export.cosmos_plugin.composed import link_text
from starhil.protocol.export.packets import row_key
from starhil.protocol.export.templates import part_of
from starhil.protocol.icd.definition import Names
from starhil.protocol.icd.link_schema import CustomCheck, CustomFraming, SerialLinkModel
from starhil.protocol.messages import Reply, ReplyKind, Request, RequestKind
from starhil.protocol.plugin import Plugin
from starhil.protocol.serial.stack import SerialStack
from starhil.protocol.unit import load_unit
from tests.protocol.export.c_driver import CDriver, hex_or_none
from tests.protocol.serial.check_values import CHECK_VALUES
from tests.protocol.serial.composed_links import REPLIES, REQUESTS, STACKS, definition

pytestmark = pytest.mark.long


def python_link(name: str) -> Any:
    stack = STACKS[name]
    text = link_text(stack)
    namespace: dict[str, Any] = {"re": re}
    exec(compile(text, f"{name}_link.py", "exec"), namespace)
    return namespace["Link"]()


def key_of(stack: SerialStack, message: Request | Reply) -> int:
    return row_key(stack.classes, message.message_class, message.id or 0)


def expected(stack: SerialStack, reply: Reply) -> tuple[str, int, bytes]:
    """What the link has to make of a reply."""
    key = key_of(stack, reply)
    if reply.kind is ReplyKind.ACK:
        return "answer", key, b"\0"
    if reply.kind is ReplyKind.NACK:
        return "answer", key, bytes((int(reply.code) or 1,))
    return "telemetry", key, reply.data


def test_what_an_export_has_no_code_for_is_named() -> None:
    for path in ("c/checks.c", "cosmos_plugin/checks.py.in"):
        with pytest.raises(IcdError, match=rf"crc7 cannot be exported: protocol/export/{path} has no such"):
            part_of(path, "crc7")


@pytest.mark.parametrize("path", ["c/checks.c", "cosmos_plugin/checks.py.in"])
def test_every_check_can_be_exported(path: str) -> None:
    for model, _ in CHECK_VALUES:
        assert "check(" in part_of(path, model["kind"])


@pytest.mark.parametrize("name", STACKS)
def test_the_device_reads_every_request(name: str) -> None:
    stack, link = STACKS[name], python_link(name)
    for request in REQUESTS[name]:
        (seen,) = stack.device().feed(link.request(key_of(stack, request), request.data), 0.0)
        assert isinstance(seen, Request)
        assert (seen.kind, seen.id, seen.data, seen.message_class) == (
            request.kind,
            request.id,
            request.data,
            request.message_class,
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
            sent = (b"" if stack.requests.framing.start else stack.requests.framing.end) + stack.encode_reply(
                reply
            )
            lines = [
                message
                for start in range(0, len(noise + sent), piece)
                for message in link.receive((noise + sent)[start : start + piece])
            ]
            assert lines == [expected(stack, reply)]


@pytest.mark.parametrize("name", REPLIES)
def test_no_damaged_reply_is_taken_where_there_is_a_check(name: str) -> None:
    stack, rng, link = STACKS[name], random.Random(6), python_link(name)
    for reply in REPLIES[name]:
        sent = stack.encode_reply(reply)
        for _ in range(30):
            damaged = bytearray(sent)
            damaged[rng.randrange(len(sent))] ^= rng.randrange(1, 256)
            theirs = [
                expected(stack, event)[1:]
                for event in stack.host().feed(bytes(damaged), 0.0)
                if isinstance(event, Reply)
            ]
            link.reset()
            assert [message[1:] for message in link.receive(bytes(damaged))] == theirs


def test_an_echo_is_consumed_before_the_reply() -> None:
    stack, link = STACKS["nos3"], python_link("nos3")
    data = b"\xbe\xef" * 4 + b"\x01"
    request = Request(RequestKind.TELEMETRY, 2, bytes(4), message_class="telemetry")
    sent = link.request(2, bytes(4))
    assert sent == stack.encode_request(request)
    reply = stack.encode_reply(Reply(ReplyKind.TELEMETRY, 2, data, message_class="telemetry"))
    assert link.receive(sent + reply) == [("telemetry", 2, data)]
    noop = link.request(0, bytes(4))
    assert link.receive(noop) == [("answer", 0, b"\0")]


# -- C -----------------------------------------------------------------------------------------------------------------

KINDS = ["none", "telemetry", "ack", "nack", "unsolicited", "fault"]


@pytest.fixture(scope="module", params=list(STACKS))
def c(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[tuple[str, CDriver]]:
    """The compiled link of each stack, of a unit whose rows have no values."""
    empty: Any = {
        "telecommands": Names("telecommand", ()),
        "telemetry": Names("telemetry", ()),
        "enums": Names("enum", ()),
    }
    icd = replace(load_unit(), name=request.param, **empty)
    with CDriver(icd, tmp_path_factory.mktemp(request.param), STACKS[request.param]) as driver:
        yield request.param, driver


def c_events(driver: CDriver, pending: int | None, data: bytes) -> list[list[str]]:
    """Messages of the C, each as kind, row, code and data; a fault as its kind."""
    words = driver("receive", 0, -1 if pending is None else pending, hex_or_none(data))[:-1]
    return [words[start : start + 4] for start in range(0, len(words), 4)]


def our_events(stack: SerialStack, data: bytes) -> list[list[str]]:
    """Messages from our end of the link, in the same form."""
    return [
        [
            str(KINDS.index(event.kind.value)),
            str(key_of(stack, event)),
            str(int(event.code)),
            hex_or_none(event.data),
        ]
        for event in stack.host().feed(data, 0.0)
        if isinstance(event, Reply)
    ]


def test_the_c_frames_requests_as_ours(c: tuple[str, CDriver]) -> None:
    name, driver = c
    stack = STACKS[name]
    for request in REQUESTS[name]:
        plain = replace(request, sequence=0, source=0)
        sent = driver("frame", key_of(stack, request), hex_or_none(request.data))
        assert sent == ["0", stack.encode_request(plain).hex()]
    assert driver("frame", 9999, "-") == ["0", "-"]


def test_the_c_reads_replies_whole_and_damaged_as_ours(c: tuple[str, CDriver]) -> None:
    name, driver = c
    stack, rng = STACKS[name], random.Random(8)
    fault = str(KINDS.index("fault"))
    for reply in REPLIES.get(name, []):
        sent = stack.encode_reply(reply)
        assert c_events(driver, None, sent) == our_events(stack, sent) != []
        again = c_events(driver, None, sent + sent + sent)
        assert again == our_events(stack, sent) * 3
        for _ in range(30):
            damaged = bytearray(rng.randbytes(rng.randrange(3)) + sent + sent)
            damaged[rng.randrange(len(damaged))] ^= rng.randrange(1, 256)
            found = [event for event in c_events(driver, None, bytes(damaged)) if event[0] != fault]
            assert found == our_events(stack, bytes(damaged)), damaged.hex()


@pytest.mark.parametrize("c", ["nos3"], indirect=True)
def test_the_c_consumes_an_echo_before_the_reply(c: tuple[str, CDriver]) -> None:
    name, driver = c
    stack = STACKS[name]
    data = b"\xbe\xef" * 4 + b"\x01"
    echo = stack.encode_request(Request(RequestKind.TELEMETRY, 2, bytes(4), message_class="telemetry"))
    reply = stack.encode_reply(Reply(ReplyKind.TELEMETRY, 2, data, message_class="telemetry"))
    assert c_events(driver, 2, echo + reply) == [["1", "2", "0", data.hex()]]
    assert c_events(
        driver,
        0,
        stack.encode_request(Request(RequestKind.TELECOMMAND, 0, bytes(4), message_class="command")),
    ) == [["2", "0", "0", "-"]]


@pytest.mark.parametrize(
    "link",
    [
        {"framing": {"kind": "custom", "name": "mine"}},
        {"framing": {"kind": "slip"}, "check": {"kind": "custom", "name": "mine"}},
    ],
)
def test_code_of_a_plugin_is_rejected(link: dict[str, Any]) -> None:
    model = SerialLinkModel.model_validate({**link, "request_header": [{"role": "id", "type": "u8"}]})
    custom: Any = {"mine": lambda: STACKS["nsp"].requests.framing}
    plugin = Plugin(framings=custom, checks={"mine": lambda _data: b""})
    stack = SerialStack(definition(model.model_dump(exclude_unset=True), plugin=plugin))
    assert isinstance(model.framing, CustomFraming) or isinstance(model.check, CustomCheck)
    with pytest.raises(ProtocolError, match="'mine' is Python code in the unit's plugin"):
        link_text(stack)
