"""Serial links composed from data: bytes of public units, faults, resynchronisation, and input that no decoder minds."""

from __future__ import annotations

import os
import random
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from starhil.protocol.errors import ProtocolError
from starhil.protocol.link_schema import SerialLinkModel
from starhil.protocol.messages import (
    ErrorCode,
    FaultKind,
    LinkFault,
    MessageClass,
    Reply,
    ReplyKind,
    Request,
    RequestKind,
)
from starhil.protocol.serial_framing import Dialect
from starhil.protocol.serial_stack import ComposedStack, CubeSpaceStack, RowShape, SerialStack, build_stack
from starhil.protocol.values import IcdError
from tests.protocol.mutations import mutated

TC, TLM = RequestKind.TELECOMMAND, RequestKind.TELEMETRY
SEED = 20260517
FUZZ_INPUTS = int(os.environ.get("STARHIL_FUZZ_INPUTS", "1500"))


def stack_of(
    link: dict[str, Any],
    classes: tuple[MessageClass, ...] = (),
    rows: tuple[RowShape, ...] = (),
    order: Any = "little",
) -> ComposedStack:
    stack = build_stack(SerialLinkModel.model_validate(link), classes, rows, order)
    assert isinstance(stack, ComposedStack)
    return stack


# Star trackers whose serial links are public, and one of each other kind of framing.

SAGITTA = stack_of(
    {
        "framing": {"kind": "slip"},
        "check": {"kind": "xxh32", "seed": 1425},
        "request_header": [
            {"role": "address", "type": "u8", "const": 0x21},
            {"role": "class", "type": "u8"},
            {"role": "id", "type": "u8"},
        ],
        "reply_header": [
            {"role": "address", "type": "u8", "const": 0x21},
            {"role": "class", "type": "u8"},
            {"role": "id", "type": "u8"},
            {"role": "status", "type": "u8", "classes": ["set", "telemetry", "action"]},
            {"role": "ticks", "type": "u32", "scale": 1e-3, "classes": ["telemetry"]},
            {"role": "time", "type": "u64", "scale": 1e-6, "classes": ["telemetry"]},
        ],
    },
    (
        MessageClass("set", TC, 0, 128),
        MessageClass("get", TLM, 1, 129),
        MessageClass("telemetry", TLM, 2, 130, 132),
        MessageClass("action", TC, 3, 131),
    ),
    (
        RowShape("set", 6, TC, 16),
        RowShape("get", 6, TLM, 0, 16),
        RowShape("telemetry", 24, TLM, 0, 67),
        RowShape("action", 14, TC, 8),
    ),
)

NOS3 = stack_of(
    {
        "framing": {"kind": "fixed", "start": [0xDE, 0xAD], "end": [0xBE, 0xEF], "request_size": 5},
        "request_header": [{"role": "id", "type": "u8"}],
    },
    (MessageClass("command", TC), MessageClass("telemetry", TLM)),
    (
        RowShape("command", 0, TC, 4, 0, ("echo",)),
        RowShape("telemetry", 1, TLM, 4, 4, ("echo", "reply")),
        RowShape("telemetry", 2, TLM, 4, 9, ("echo", "reply")),
    ),
    "big",
)

NSP = stack_of(
    {
        "framing": {"kind": "slip"},
        "check": {"kind": "crc", "type": "u16", "poly": 0x1021, "init": 0xFFFF, "reflect": True},
        "request_header": [
            {"role": "address", "type": "u8", "default": 0x0E},
            {"role": "source", "type": "u8", "default": 0x11},
            {"type": "bits8", "bits": [{"role": "id", "width": 5}, {"width": 2}, {"default": 1}]},
        ],
        "reply_header": [
            {"role": "destination", "type": "u8", "default": 0x11},
            {"role": "address", "type": "u8", "default": 0x0E},
            {
                "type": "bits8",
                "bits": [{"role": "id", "width": 5}, {"role": "ack"}, {"width": 1}, {"role": "final"}],
            },
        ],
    },
    rows=(RowShape("", 0, TLM, 0, 8), RowShape("", 1, TC, 4), RowShape("", 18, TLM, 4, 20)),
)

LENGTH = stack_of(
    {
        "framing": {"kind": "length", "start": [0xAA, 0x55]},
        "check": {"kind": "sum", "complement": "twos", "covers": ["header", "data"]},
        "request_header": [
            {"role": "length", "type": "u16", "includes": ["header", "data", "check"]},
            {"role": "id", "type": "u8"},
            {"role": "sequence", "type": "u8"},
        ],
        "reply_header": [
            {"role": "length", "type": "u16", "includes": ["header", "data", "check"]},
            {"role": "id", "type": "u8"},
            {"role": "sequence", "type": "u8"},
            {"role": "status", "type": "u8"},
        ],
    },
    rows=(RowShape("", 3, TC, 2), RowShape("", 200, TLM, 0, 6)),
    order="big",
)

DLE = stack_of(
    {
        "framing": {"kind": "escaped"},
        "check": {"kind": "crc", "type": "u16", "poly": 0x1021, "init": 0xFFFF},
        "request_header": [{"role": "id", "type": "u8"}],
        "reply_header": [{"role": "id", "type": "u8"}, {"role": "status", "type": "u8"}],
    },
    rows=(RowShape("", 3, TC, 2), RowShape("", 16, TLM, 0, 6)),
)

HDLC = stack_of(
    {
        "framing": {"kind": "slip", "end": 0x7E, "escape": 0x7D, "xor": 0x20},
        "check": {
            "kind": "crc",
            "type": "u16",
            "poly": 0x1021,
            "init": 0xFFFF,
            "reflect": True,
            "xor": 0xFFFF,
        },
        "request_header": [{"role": "id", "type": "u8"}],
        "reply_header": [{"role": "id", "type": "u8"}, {"role": "status", "type": "u8"}],
    },
    rows=(RowShape("", 3, TC, 2), RowShape("", 126, TLM, 0, 6)),
)

TEXT = stack_of(
    {
        "framing": {"kind": "delimited", "start": [0x24], "end": [0x0D, 0x0A], "encoding": "hex"},
        "check": {"kind": "xor"},
        "request_header": [{"role": "id", "type": "u8"}],
        "reply_header": [{"role": "id", "type": "u8"}, {"role": "status", "type": "u8"}],
    },
    rows=(RowShape("", 3, TC, 2), RowShape("", 200, TLM, 0, 6)),
)

STACKS = {
    "sagitta": SAGITTA,
    "nos3": NOS3,
    "nsp": NSP,
    "length": LENGTH,
    "dle": DLE,
    "hdlc": HDLC,
    "text": TEXT,
}

REQUESTS: dict[str, list[Request]] = {
    "sagitta": [
        Request(TC, 6, bytes(range(16)), klass="set"),
        Request(TLM, 6, klass="get"),
        Request(TLM, 24, klass="telemetry"),
        Request(TC, 14, b"\xc0\xdb\xdc\xdd\xc0\xc0\xdb\xdb", klass="action"),
    ],
    "nos3": [
        Request(TC, 0, b"\xde\xad\xbe\xef", klass="command"),
        Request(TLM, 1, bytes(4), klass="telemetry"),
        Request(TLM, 2, b"\0\0\0\x07", klass="telemetry"),
    ],
    "nsp": [Request(TLM, 0, source=0x11), Request(TC, 1, b"\0\x20\0\0", source=0x12)],
    "length": [Request(TC, 3, b"\xaa\x55", sequence=7), Request(TLM, 200, sequence=255)],
    "dle": [Request(TC, 3, b"\x10\x10"), Request(TLM, 16)],
    "hdlc": [Request(TC, 3, b"\x7e\x7d"), Request(TLM, 126)],
    "text": [Request(TC, 3, b"\r\n"), Request(TLM, 200)],
}

REPLIES: dict[str, list[Reply]] = {
    "sagitta": [
        Reply(ReplyKind.ACK, 6, klass="set"),
        Reply(ReplyKind.NACK, 6, code=ErrorCode.INVALID_PARAMETER, klass="set"),
        Reply(ReplyKind.TELEMETRY, 6, b"\xc0" * 16, klass="get"),
        Reply(
            ReplyKind.TELEMETRY,
            24,
            b"\xdb" * 67,
            klass="telemetry",
            uptime_ns=12_000_000,
            time_ns=1_700_000_000_123_456_000,
        ),
        Reply(ReplyKind.UNSOLICITED, 24, bytes(67), klass="telemetry", time_ns=1_000),
    ],
    "nsp": [
        Reply(ReplyKind.TELEMETRY, 0, b"ST-16\xc0\xdb!", destination=0x11),
        Reply(ReplyKind.ACK, 1, destination=0x11),
        Reply(ReplyKind.NACK, 1, destination=0x11),
        Reply(ReplyKind.TELEMETRY, 18, bytes(9), destination=0x11, final=False),
    ],
    "length": [Reply(ReplyKind.ACK, 3, sequence=7), Reply(ReplyKind.TELEMETRY, 200, b"\xaa\x55" * 3)],
    "dle": [Reply(ReplyKind.ACK, 3), Reply(ReplyKind.TELEMETRY, 16, b"\x10\x03" * 3)],
    "hdlc": [Reply(ReplyKind.ACK, 3), Reply(ReplyKind.TELEMETRY, 126, b"\x7e\x7d" * 3)],
    "text": [Reply(ReplyKind.ACK, 3), Reply(ReplyKind.TELEMETRY, 200, b"\r\n$$\r\n")],
}

ALL_REQUESTS = [(name, request) for name, requests in REQUESTS.items() for request in requests]
ALL_REPLIES = [(name, reply) for name, replies in REPLIES.items() for reply in replies]


def faults(events: list[Any]) -> list[FaultKind]:
    assert all(isinstance(event, LinkFault) for event in events), events
    return [event.kind for event in events]


# -- bytes of public units ---------------------------------------------------------------------------------------------


def test_slip_substitutes_as_rfc_1055_says() -> None:
    link = {"framing": {"kind": "slip"}, "request_header": [{"role": "id", "type": "u8"}]}
    sent = stack_of(link).encode_request(Request(TC, 1, b"\xc0\x02\xdb"))
    assert sent.hex(" ").upper() == "C0 01 DB DC 02 DB DD C0"


def test_slip_accepts_a_sender_that_ends_frames_without_starting_them() -> None:
    link = {"framing": {"kind": "slip"}, "request_header": [{"role": "id", "type": "u8"}]}
    assert [
        item.id
        for item in stack_of(link).device().feed(bytes.fromhex("01C002C0C003C0"), 0.0)
        if isinstance(item, Request)
    ] == [1, 2, 3]


def test_hdlc_substitutes_with_xor() -> None:
    sent = HDLC.encode_request(Request(TC, 3, b"\x7e\x7d"))
    assert sent[:6].hex(" ").upper() == "7E 03 7D 5E 7D 5D"
    assert sent[-1] == 0x7E


def test_request_for_the_sagitta_solution_has_the_published_bytes() -> None:
    # 21 02 18 and XXH32 with seed 1425 over these three bytes, computed from its specification by hand.
    assert (
        SAGITTA.encode_request(Request(TLM, 24, klass="telemetry")).hex(" ") == "c0 21 02 18 ac 15 e1 76 c0"
    )


def test_sagitta_solution_reply_has_87_bytes_between_the_flags() -> None:
    sent = SAGITTA.encode_reply(Reply(ReplyKind.TELEMETRY, 24, bytes(67), klass="telemetry"))
    assert len(sent) >= 87 + 2
    assert sent[1:5] == bytes((0x21, 130, 24, 0))


def test_sagitta_parameter_reply_has_no_status() -> None:
    assert SAGITTA.encode_reply(Reply(ReplyKind.TELEMETRY, 6, bytes(16), klass="get"))[1:4] == bytes(
        (0x21, 129, 6)
    )


def test_nos3_request_and_replies_have_the_published_bytes() -> None:
    request = Request(TLM, 2, bytes(4), klass="telemetry")
    assert NOS3.encode_request(request).hex().upper() == "DEAD0200000000BEEF"
    assert NOS3.encode_reply(Reply.echo(request)) == NOS3.encode_request(request)
    reply = Reply(ReplyKind.TELEMETRY, 2, bytes(9), klass="telemetry")
    assert NOS3.encode_reply(reply).hex().upper() == "DEAD" + "00" * 9 + "BEEF"


def test_nsp_reply_swaps_the_addresses_and_sets_ack_and_final() -> None:
    request = NSP.device().feed(NSP.encode_request(Request(TLM, 0, source=0x11)), 0.0)[0]
    assert isinstance(request, Request)
    reply = NSP.encode_reply(Reply(ReplyKind.TELEMETRY, 0, b"x", destination=request.source))
    assert reply[1:5] == bytes((0x11, 0x0E, 0x20 | 0x80, ord("x")))
    assert NSP.encode_request(Request(TLM, 0))[1:4] == bytes((0x0E, 0x11, 0x80))


# -- both directions ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "request_"), ALL_REQUESTS)
def test_device_reads_what_the_host_sends_in_pieces_of_any_size(name: str, request_: Request) -> None:
    sent = STACKS[name].encode_request(request_)
    for size in (1, 2, 5, len(sent)):
        receiver = STACKS[name].device()
        events = [
            event for at in range(0, len(sent), size) for event in receiver.feed(sent[at : at + size], 0.0)
        ]
        assert events == [request_]
        assert not receiver.busy


@pytest.mark.parametrize(("name", "reply"), ALL_REPLIES)
def test_host_reads_what_the_device_sends(name: str, reply: Reply) -> None:
    receiver = STACKS[name].host()
    sent = STACKS[name].encode_reply(reply)
    (found,) = [event for byte in sent for event in receiver.feed(bytes((byte,)), 0.0)]
    assert isinstance(found, Reply)
    if reply.kind is ReplyKind.NACK and "status" not in STACKS[name].reply_header.roles:
        assert found.kind is ReplyKind.NACK
        return
    keys = ("kind", "id", "data", "code", "klass", "sequence", "final", "uptime_ns", "time_ns")
    assert {key: getattr(found, key) for key in keys} == {key: getattr(reply, key) for key in keys}


def test_host_verifies_the_echo_before_the_reply() -> None:
    receiver = NOS3.host()
    request = REQUESTS["nos3"][2]
    receiver.expect(request, 9)
    reply = NOS3.encode_reply(Reply(ReplyKind.TELEMETRY, 2, b"\xbe\xef" * 4 + b"\x01", klass="telemetry"))
    events = receiver.feed(NOS3.encode_request(request) + reply, 0.0)
    assert [(event.kind, event.id, event.data) for event in events if isinstance(event, Reply)] == [
        (ReplyKind.TELEMETRY, 2, b"\xbe\xef" * 4 + b"\x01")
    ]


def test_echo_that_differs_is_a_fault() -> None:
    receiver = NOS3.host()
    receiver.expect(REQUESTS["nos3"][0], 0)
    wrong = NOS3.encode_request(REQUESTS["nos3"][1])
    assert faults(receiver.feed(wrong, 0.0))[0] is FaultKind.UART_PROTOCOL


def test_echo_is_the_ack_of_a_telecommand_that_has_no_other_answer() -> None:
    receiver = NOS3.host()
    request = REQUESTS["nos3"][0]
    receiver.expect(request, 0)
    (reply,) = receiver.feed(NOS3.encode_reply(Reply.echo(request)), 0.0)
    assert isinstance(reply, Reply)
    assert (reply.kind, reply.id) == (ReplyKind.ACK, 0)


def test_refusal_that_the_header_cannot_express_sends_nothing() -> None:
    assert NOS3.encode_reply(Reply(ReplyKind.NACK, 2, code=ErrorCode.BUSY)) == b""
    assert SAGITTA.encode_reply(Reply(ReplyKind.NACK, 99, code=ErrorCode.INVALID_ID, klass="get")) == b""
    assert SAGITTA.encode_reply(Reply(ReplyKind.NACK, 99, code=ErrorCode.INVALID_ID, klass="set"))


def test_code_that_does_not_fit_the_header_is_an_error() -> None:
    with pytest.raises(ProtocolError, match="status 300 does not fit 1 bytes"):
        SAGITTA.encode_reply(Reply(ReplyKind.NACK, 6, code=300, klass="set"))


# -- faults ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [name for name, stack in STACKS.items() if stack.check.size])
def test_each_flipped_bit_of_a_message_is_flagged_and_the_next_message_read(name: str) -> None:
    stack = STACKS[name]
    request = REQUESTS[name][0]
    sent = stack.encode_request(request)
    for bit in range(8 * len(sent)):
        damaged = bytearray(sent)
        damaged[bit // 8] ^= 1 << bit % 8
        receiver = stack.device()
        events = list(receiver.feed(bytes(damaged), 0.0))
        events += receiver.flush(1.0)
        events += receiver.feed(sent, 2.0)
        assert events[-1] == request, f"bit {bit}"
        assert len(events) > 1, f"bit {bit}"
        assert not [event for event in events[:-1] if isinstance(event, Request) and event != request], (
            f"bit {bit}"
        )


def test_wrong_check_is_flagged_as_such() -> None:
    sent = bytearray(SAGITTA.encode_request(REQUESTS["sagitta"][2]))
    sent[5] ^= 1
    (fault,) = SAGITTA.device().feed(bytes(sent), 0.0)
    assert isinstance(fault, LinkFault)
    assert fault.kind is FaultKind.UART_CHECK


def test_message_to_another_address_is_flagged_as_such() -> None:
    other = stack_of(
        {
            **SAGITTA.link.model_dump(exclude_none=True),
            "request_header": [
                {"role": "address", "type": "u8", "const": 0x22},
                {"role": "class", "type": "u8"},
                {"role": "id", "type": "u8"},
            ],
        },
        tuple(SAGITTA.classes.classes),
    )
    sent = other.encode_request(REQUESTS["sagitta"][2])
    assert faults(list(SAGITTA.device().feed(sent, 0.0))) == [FaultKind.UART_ADDRESS]


def test_unknown_class_is_flagged() -> None:
    body = bytes((0x21, 9, 24))
    sent = SAGITTA.framing.encode(body + SAGITTA.check.compute(body))
    assert faults(list(SAGITTA.device().feed(sent, 0.0))) == [FaultKind.UART_PROTOCOL]


def test_unknown_id_is_a_request_that_the_device_refuses() -> None:
    (request,) = SAGITTA.device().feed(SAGITTA.encode_request(Request(TLM, 99, klass="telemetry")), 0.0)
    assert request == Request(TLM, 99, klass="telemetry")


@pytest.mark.parametrize("name", STACKS)
def test_incomplete_message_is_flagged_after_the_timeout(name: str) -> None:
    receiver = STACKS[name].device()
    sent = STACKS[name].encode_request(REQUESTS[name][0])
    assert receiver.feed(sent[: len(sent) // 2], 0.0) == []
    assert receiver.busy
    assert receiver.flush(0.4) == []
    assert faults(receiver.flush(0.6)) == [FaultKind.UART_INCOMPLETE]
    assert not receiver.busy
    assert receiver.feed(sent, 0.7) == [REQUESTS[name][0]]


@pytest.mark.parametrize("name", ["sagitta", "nsp", "dle", "hdlc", "text", "length"])
def test_overlong_message_is_flagged_once_and_the_next_message_read(name: str) -> None:
    stack = STACKS[name]
    request = REQUESTS[name][0]
    head = stack.framing.start or stack.framing.end
    filler = b"\xff" if name == "length" else b"0"
    receiver = stack.device()
    events = [
        event
        for _ in range(30)
        for event in receiver.feed(head + filler * 99 if _ == 0 else filler * 100, 0.0)
    ]
    assert faults(events) == [FaultKind.UART_OVERLONG]
    events = receiver.feed(stack.framing.end + stack.encode_request(request), 0.1)
    assert events[-1] == request


@pytest.mark.parametrize("name", ["nos3", "length", "dle", "text"])
def test_run_of_junk_before_a_message_is_flagged_once(name: str) -> None:
    request = REQUESTS[name][0]
    events = STACKS[name].device().feed(b"\x01\x02\x03" + STACKS[name].encode_request(request), 0.0)
    assert faults(events[:-1]) == [FaultKind.UART_PROTOCOL]
    assert events[-1] == request


def test_false_start_within_junk_does_not_swallow_the_message() -> None:
    request = REQUESTS["nos3"][1]
    events = NOS3.device().feed(b"\xde\xad\x01" + NOS3.encode_request(request), 0.0)
    assert faults(events[:-1]) == [FaultKind.UART_PROTOCOL]
    assert events[-1] == request


def test_length_that_is_wrong_does_not_swallow_the_messages_that_follow() -> None:
    request = REQUESTS["length"][0]
    sent = LENGTH.encode_request(request)
    wrong = sent[:3] + b"\x10" + sent[4:]
    events = LENGTH.device().feed(wrong + sent + sent, 0.0)
    assert faults(events[:1]) == [FaultKind.UART_CHECK]
    assert events[1:] == [request, request]


def test_binary_message_that_contains_the_delimiter_is_an_error_with_a_remedy() -> None:
    link = {
        "framing": {"kind": "delimited", "end": [0x0D, 0x0A]},
        "request_header": [{"role": "id", "type": "u8"}],
    }
    with pytest.raises(ProtocolError, match='encoding = "hex"'):
        stack_of(link).encode_request(Request(TC, 1, b"\r\n"))


def counted(includes: list[str], covers: list[str], start: list[int]) -> ComposedStack:
    header = [{"role": "length", "type": "u8", "includes": includes}, {"role": "id", "type": "u8"}]
    return stack_of(
        {
            "framing": {"kind": "length", "start": start, "end": [0x0A]},
            "check": {"kind": "xor", "covers": covers},
            "request_header": header,
            "reply_header": header,
        }
    )


@pytest.mark.parametrize(
    ("includes", "covers", "expected"),
    [
        (["data"], ["header", "data"], "55 02 07 01 03 07 0A"),
        (["header", "data"], ["data"], "55 04 07 01 03 02 0A"),
        (["header", "data", "check"], ["header"], "55 05 07 01 03 02 0A"),
        (["start", "header", "data", "check", "end"], ["start", "header", "data"], "55 07 07 01 03 57 0A"),
    ],
)
def test_length_counts_and_check_covers_the_parts_that_are_named(
    includes: Any, covers: Any, expected: str
) -> None:
    stack = counted(includes, covers, [0x55])
    request = Request(TC, 7, b"\x01\x03")
    assert stack.encode_request(request).hex(" ").upper() == expected
    assert stack.device().feed(bytes.fromhex(expected), 0.0) == [request]


def test_link_without_a_start_is_in_step_again_after_a_silence() -> None:
    stack = counted(["data"], ["header", "data"], [])
    request = Request(TC, 7, b"\x01\x03")
    sent = stack.encode_request(request)
    receiver = stack.device()
    wrong = sent[:-1] + b"\x00"
    assert faults(list(receiver.feed(wrong + sent, 0.0))) == [FaultKind.UART_PROTOCOL]
    assert receiver.busy
    assert receiver.feed(sent, 0.1) == []
    assert receiver.flush(0.7) == []
    assert not receiver.busy
    assert receiver.feed(sent, 0.8) == [request]


# -- definitions that do not fit ---------------------------------------------------------------------------------------

HEADER = [{"role": "id", "type": "u8"}]


@pytest.mark.parametrize(
    ("link", "message"),
    [
        ({"framing": {"kind": "length"}, "request_header": HEADER}, "request_header: framing length needs"),
        ({"framing": {"kind": "slip"}}, "request_header: needs a field with role id"),
        (
            {"framing": {"kind": "slip"}, "request_header": [*HEADER, {"type": "u8"}]},
            "request_header: 2: needs a role",
        ),
        (
            {
                "framing": {"kind": "slip"},
                "request_header": [{"type": "bits8", "bits": [{"role": "id", "width": 5}]}],
            },
            "the bits make 5, must be 8",
        ),
        ({"framing": {"kind": "slip", "end": 1, "escape": 1}, "request_header": HEADER}, "must differ"),
        (
            {"framing": {"kind": "custom", "name": "mine"}, "request_header": HEADER},
            "no framing named 'mine'",
        ),
        (
            {
                "framing": {"kind": "slip"},
                "request_header": HEADER,
                "reply_header": [{"role": "source", "type": "u8"}],
            },
            "role source belongs to the other direction",
        ),
    ],
)
def test_parts_that_do_not_fit_one_another_are_rejected(link: dict[str, Any], message: str) -> None:
    with pytest.raises((IcdError, ProtocolError), match=message):
        stack_of(link)


# -- the CubeSpace family ----------------------------------------------------------------------------------------------


def test_cubespace_keeps_its_codec_and_dialects() -> None:
    stack: SerialStack = build_stack(SerialLinkModel.model_validate({"framing": {"kind": "cubespace"}}))
    assert isinstance(stack, CubeSpaceStack)
    assert stack.encode_request(Request.of(128)).hex().upper() == "1F7F801FFF"
    reply = Reply(ReplyKind.TELEMETRY, 128, b"\x01")
    assert [stack.encode_reply(reply, dialect).hex() for dialect in Dialect] == [
        "1f7f80011fff",
        "1f7f011fff",
        "1f0780011fff",
    ]
    assert stack.supports_unsolicited(Dialect.C)
    assert not stack.supports_unsolicited(Dialect.A)


MARKS = b"\xc0\xdb\x10\x02\x03\x7e\x7d\xde\xad\xaa\x55\r\n$\xff\x00"

# -- any input ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", STACKS)
def test_no_input_throws_a_receiver_off(name: str) -> None:
    stack = STACKS[name]
    source = random.Random(SEED)
    requests = REQUESTS[name]
    seeds = [stack.encode_request(request) for request in requests]
    seeds += [stack.encode_reply(reply) for reply in REPLIES.get(name, [])]
    device, host = stack.device(), stack.host()
    now = 0.0
    for _ in range(FUZZ_INPUTS):
        data = mutated(seeds, source, MARKS)
        now += source.choice((0.0, 0.01, 0.6))
        host.expect(source.choice(requests), source.randrange(12))
        for receiver in (device, host):
            for event in receiver.feed(data, now):
                assert isinstance(event, LinkFault | Request | Reply)
    for receiver in (device, host):
        receiver.flush(now + 1.0)
        assert not receiver.busy
    assert device.feed(seeds[0], now + 2.0) == [requests[0]]


@settings(max_examples=200, deadline=None)
@given(name=st.sampled_from([name for name in STACKS if name != "nos3"]), data=st.binary(max_size=40))
def test_any_data_arrives_as_it_was_sent(name: str, data: bytes) -> None:
    klass = "action" if name == "sagitta" else ""
    row_id = 14 if name == "sagitta" else 3
    request = Request(TC, row_id, data, source=0x11 if name == "nsp" else 0, klass=klass)
    (found,) = STACKS[name].device().feed(STACKS[name].encode_request(request), 0.0)
    assert isinstance(found, Request)
    assert (found.id, found.data) == (row_id, data)
