"""Serial links composed from data: bytes of public units, both directions, and definitions that do not fit."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from starhil.protocol.errors import IcdError, ProtocolError
from starhil.protocol.messages import ErrorCode, FaultKind, LinkFault, Reply, ReplyKind, Request
from tests.protocol.serial.composed_links import (
    ALL_REPLIES,
    ALL_REQUESTS,
    HDLC,
    NOS3,
    NSP,
    REQUESTS,
    SAGITTA,
    STACKS,
    TC,
    TLM,
    counted,
    faults,
    stack_of,
)


def test_slip_escapes_as_in_rfc_1055() -> None:
    link = {"framing": {"kind": "slip"}, "request_header": [{"role": "id", "type": "u8"}]}
    sent = stack_of(link).encode_request(Request(TC, 1, b"\xc0\x02\xdb"))
    assert sent.hex(" ").upper() == "C0 01 DB DC 02 DB DD C0"


def test_slip_has_the_substitutes_of_the_definition() -> None:
    framing = {"kind": "slip", "substitutes": [0x01, 0x02]}
    stack = stack_of({"framing": framing, "request_header": [{"role": "id", "type": "u8"}]})
    sent = stack.encode_request(Request(TC, 5, b"\xc0\xdb"))
    assert sent.hex(" ").upper() == "C0 05 DB 01 DB 02 C0"
    assert [item.data for item in stack.device().feed(sent, 0.0) if isinstance(item, Request)] == [
        b"\xc0\xdb"
    ]


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
        SAGITTA.encode_request(Request(TLM, 24, message_class="telemetry")).hex(" ")
        == "c0 21 02 18 ac 15 e1 76 c0"
    )


def test_sagitta_solution_reply_has_87_bytes_between_the_flags() -> None:
    sent = SAGITTA.encode_reply(Reply(ReplyKind.TELEMETRY, 24, bytes(67), message_class="telemetry"))
    assert len(sent) >= 87 + 2
    assert sent[1:5] == bytes((0x21, 130, 24, 0))


def test_sagitta_parameter_reply_has_no_status() -> None:
    assert SAGITTA.encode_reply(Reply(ReplyKind.TELEMETRY, 6, bytes(16), message_class="get"))[1:4] == bytes(
        (0x21, 129, 6)
    )


def test_nos3_request_and_replies_have_the_published_bytes() -> None:
    request = Request(TLM, 2, bytes(4), message_class="telemetry")
    assert NOS3.encode_request(request).hex().upper() == "DEAD0200000000BEEF"
    assert NOS3.encode_reply(Reply.echo(request)) == NOS3.encode_request(request)
    reply = Reply(ReplyKind.TELEMETRY, 2, bytes(9), message_class="telemetry")
    assert NOS3.encode_reply(reply).hex().upper() == "DEAD" + "00" * 9 + "BEEF"


def test_start_in_pieces_is_not_lost_after_junk() -> None:
    request = NOS3.encode_request(REQUESTS["nos3"][0])
    for split in range(1, 4):
        device = NOS3.device()
        first = list(device.feed(b"\x00" + request[:split], 0.0))
        rest = list(device.feed(request[split:], 0.0))
        assert [type(event) for event in first + rest] == [LinkFault, Request]


def test_nsp_reply_swaps_the_addresses_and_sets_ack_and_final() -> None:
    request = NSP.device().feed(NSP.encode_request(Request(TLM, 0, source=0x11)), 0.0)[0]
    assert isinstance(request, Request)
    reply = NSP.encode_reply(Reply(ReplyKind.TELEMETRY, 0, b"x", destination=request.source))
    assert reply[1:5] == bytes((0x11, 0x0E, 0x20 | 0x80, ord("x")))
    assert NSP.encode_request(Request(TLM, 0))[1:4] == bytes((0x0E, 0x11, 0x80))


# -- both directions ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "request_"), ALL_REQUESTS)
def test_the_device_reads_requests_in_pieces_of_any_size(name: str, request_: Request) -> None:
    sent = STACKS[name].encode_request(request_)
    for size in (1, 2, 5, len(sent)):
        receiver = STACKS[name].device()
        events = [
            event for at in range(0, len(sent), size) for event in receiver.feed(sent[at : at + size], 0.0)
        ]
        assert events == [request_]
        assert not receiver.busy


@pytest.mark.parametrize(("name", "reply"), ALL_REPLIES)
def test_the_host_reads_replies(name: str, reply: Reply) -> None:
    receiver = STACKS[name].host()
    sent = STACKS[name].encode_reply(reply)
    (fault,) = [event for byte in sent for event in receiver.feed(bytes((byte,)), 0.0)]
    assert isinstance(fault, Reply)
    if reply.kind is ReplyKind.NACK and "status" not in STACKS[name].replies.header.roles:
        assert fault.kind is ReplyKind.NACK
        return
    keys = ("kind", "id", "data", "code", "message_class", "sequence", "final", "uptime_ns", "time_ns")
    assert {key: getattr(fault, key) for key in keys} == {key: getattr(reply, key) for key in keys}


def test_host_verifies_the_echo_before_the_reply() -> None:
    receiver = NOS3.host()
    request = REQUESTS["nos3"][2]
    echo = receiver.request(request)
    reply = NOS3.encode_reply(
        Reply(ReplyKind.TELEMETRY, 2, b"\xbe\xef" * 4 + b"\x01", message_class="telemetry")
    )
    events = receiver.feed(echo + reply, 0.0)
    assert [(event.kind, event.id, event.data) for event in events if isinstance(event, Reply)] == [
        (ReplyKind.TELEMETRY, 2, b"\xbe\xef" * 4 + b"\x01")
    ]


def test_echo_that_differs_is_a_fault() -> None:
    receiver = NOS3.host()
    receiver.overhear(REQUESTS["nos3"][0])
    wrong = NOS3.encode_request(REQUESTS["nos3"][1])
    assert faults(receiver.feed(wrong, 0.0))[0] is FaultKind.UART_PROTOCOL


def test_echo_is_the_ack_of_a_telecommand_that_has_no_other_answer() -> None:
    receiver = NOS3.host()
    request = REQUESTS["nos3"][0]
    receiver.overhear(request)
    (reply,) = receiver.feed(NOS3.encode_reply(Reply.echo(request)), 0.0)
    assert isinstance(reply, Reply)
    assert (reply.kind, reply.id) == (ReplyKind.ACK, 0)


def test_refusal_that_the_header_cannot_express_sends_nothing() -> None:
    assert NOS3.encode_reply(Reply(ReplyKind.NACK, 2, code=ErrorCode.BUSY)) == b""
    assert (
        SAGITTA.encode_reply(Reply(ReplyKind.NACK, 99, code=ErrorCode.INVALID_ID, message_class="get")) == b""
    )
    assert SAGITTA.encode_reply(Reply(ReplyKind.NACK, 99, code=ErrorCode.INVALID_ID, message_class="set"))


def test_code_that_does_not_fit_the_header_is_an_error() -> None:
    with pytest.raises(ProtocolError, match=r"link\.serial\.reply_header: status 300 does not fit 8 bits"):
        SAGITTA.encode_reply(Reply(ReplyKind.NACK, 6, code=300, message_class="set"))


def test_binary_message_that_contains_the_delimiter_is_an_error_with_a_remedy() -> None:
    link = {
        "framing": {"kind": "delimited", "end": [0x0D, 0x0A]},
        "request_header": [{"role": "id", "type": "u8"}],
    }
    with pytest.raises(ProtocolError, match='encoding = "hex"'):
        stack_of(link).encode_request(Request(TC, 1, b"\r\n"))


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


@settings(max_examples=200, deadline=None)
@given(name=st.sampled_from([name for name in STACKS if name != "nos3"]), data=st.binary(max_size=40))
def test_any_data_arrives_as_it_was_sent(name: str, data: bytes) -> None:
    message_class = "action" if name == "sagitta" else ""
    row_id = 14 if name == "sagitta" else 3
    request = Request(TC, row_id, data, source=0x11 if name == "nsp" else 0, message_class=message_class)
    (found,) = STACKS[name].device().feed(STACKS[name].encode_request(request), 0.0)
    assert isinstance(found, Request)
    assert (found.id, found.data) == (row_id, data)


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
            "the bits add up to 5, must be 8",
        ),
        (
            {
                "framing": {"kind": "slip"},
                "request_header": HEADER,
                "reply_header": [{"type": "u8", "role": "id", "counts": ["reply"]}],
            },
            "reply_header: 1: only role sequence has `counts`",
        ),
        (
            {
                "framing": {"kind": "slip"},
                "request_header": [*HEADER, {"type": "u8", "role": "sequence", "counts": ["reply"]}],
            },
            "request_header: `counts` belongs to the reply header",
        ),
        (
            {"framing": {"kind": "slip"}, "request_header": [{"type": "u8", "role": "id", "offset": 1}]},
            "only role length has an `offset`",
        ),
        ({"framing": {"kind": "slip", "end": 1, "escape": 1}, "request_header": HEADER}, "must differ"),
        (
            {"framing": {"kind": "escaped", "escape": 2, "start": 2}, "request_header": HEADER},
            "escape, start and end must differ",
        ),
        (
            {"framing": {"kind": "slip"}, "request_header": [{"role": "id", "type": "bits8"}]},
            "types bits8, bits16 and bits32 have `bits`",
        ),
        (
            {
                "framing": {"kind": "slip"},
                "request_header": HEADER,
                "reply_header": [*HEADER, {"role": "time", "type": "u32", "scale": 1e-10}],
            },
            "scale 1e-10 s is below a nanosecond",
        ),
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


# --- requests without an answer, and to other addresses ---

POLLED: dict[str, Any] = {
    "framing": {"kind": "slip"},
    "check": {"kind": "sum"},
    "request_header": [
        {"role": "address", "type": "u8", "default": 7},
        {"type": "bits8", "bits": [{"role": "id", "width": 7}, {"role": "poll", "default": 1}]},
    ],
}


def test_a_request_says_whether_it_is_answered() -> None:
    stack = stack_of(POLLED)
    for polled, control in ((True, 0x85), (False, 0x05)):
        sent = stack.encode_request(Request(TC, 5, polled=polled))
        assert sent[2] == control
        assert [item.polled for item in stack.device().feed(sent, 0.0) if isinstance(item, Request)] == [
            polled
        ]


@pytest.mark.parametrize("bits", [[{"role": "poll"}], [{"role": "poll", "default": 0}]])
def test_a_poll_bit_that_no_request_would_set_is_rejected(bits: list[dict[str, Any]]) -> None:
    fields = [{"type": "bits8", "bits": [{"role": "id", "width": 7}, *bits]}]
    with pytest.raises(IcdError, match="role poll needs `default = 1`"):
        stack_of({**POLLED, "request_header": fields})


@pytest.mark.parametrize(
    ("line", "kind"),
    [
        ("C0 07 C0", FaultKind.UART_SHORT),
        ("C0 07 85 00 C0", FaultKind.UART_CHECK),
        ("C0 08 C0", FaultKind.UART_ADDRESS),
        ("C0 08 85 00 C0", FaultKind.UART_ADDRESS),
    ],
)
def test_a_damaged_message_to_another_address_is_no_damage_here(line: str, kind: FaultKind) -> None:
    found = stack_of(POLLED).device().feed(bytes.fromhex(line), 0.0)
    assert [item.kind for item in found if isinstance(item, LinkFault)] == [kind]
