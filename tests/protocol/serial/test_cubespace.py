"""Serial framing: published byte strings, the ambiguous id, and a receiver that no input throws off."""

from __future__ import annotations

import random
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from starhil.protocol.errors import ProtocolError
from starhil.protocol.messages import ErrorCode, FaultKind, LinkFault, Reply, ReplyKind, Request, RequestKind
from starhil.protocol.serial.cubespace import BURST_SIZE, Dialect
from starhil.protocol.serial.stack import SerialStack
from tests.protocol.serial.composed_links import CUBESPACE, definition, shape, stack_of

TC, TLM = RequestKind.TELECOMMAND, RequestKind.TELEMETRY
GOOD = Request(TC, 2, b"\x1f\x00\xff\x7f\x1f\x1f")
requests = st.builds(Request.of, st.integers(0, 255), st.binary(max_size=60))


def limited(**limits: float) -> SerialStack:
    return stack_of({"framing": {"kind": "cubespace"}} | limits)


def with_single_id(line: bytes) -> bytes:
    """The request as some flight software sends it, which does not double an ID of 0x1F."""
    return line[:2] + line[3:] if line[2:4] == b"\x1f\x1f" else line


def device_feed(text: str) -> list[Request | LinkFault]:
    return CUBESPACE.device().feed(bytes.fromhex(text), 0.0)


def kinds(events: list[Request | LinkFault]) -> list[FaultKind | int]:
    return [event.kind if isinstance(event, LinkFault) else event.id for event in events]


def test_the_kind_of_a_request_is_that_of_its_row() -> None:
    link = {"framing": {"kind": "cubespace"}}
    unit = definition(link, rows=(shape("", 5, TLM), shape("", 200, TC, 1)))
    device = SerialStack(replace(unit, first_telemetry_id=None)).device()
    found = device.feed(CUBESPACE.encode_request(Request(TLM, 5)), 0.0)
    found += device.feed(CUBESPACE.encode_request(Request(TC, 200, b"\1")), 0.1)
    assert found == [Request(TLM, 5), Request(TC, 200, b"\1")]


# -- requests ----------------------------------------------------------------------------------------------------------

PUBLISHED_REQUESTS = [
    (Request(TLM, 128), "1F 7F 80 1F FF"),
    (Request(TC, 1, b"\x5a"), "1F 7F 01 5A 1F FF"),
    (Request(TC, 2, b"\x1f\x02\x03\x04\xe7\x03"), "1F 7F 02 1F 1F 02 03 04 E7 03 1F FF"),
    (Request(TC, 5, b"\x1f\x1f"), "1F 7F 05 1F 1F 1F 1F 1F FF"),
]


@pytest.mark.parametrize(("request_", "text"), PUBLISHED_REQUESTS)
def test_requests_are_framed_and_read_as_published(request_: Request, text: str) -> None:
    assert CUBESPACE.encode_request(request_).hex(" ").upper() == text
    assert device_feed(text) == [request_]


@pytest.mark.parametrize(
    ("text", "data"),
    [
        ("1F 7F 1F 1F 05 1F FF", b"\x05"),  # id doubled
        ("1F 7F 1F 05 1F FF", b"\x05"),  # id single, as libCubeObc sends it
        ("1F 7F 1F 1F 1F FF", b""),
        ("1F 7F 1F 1F 1F 1F 1F FF", b"\x1f"),
    ],
)
def test_the_escape_byte_as_id_is_read_both_ways(text: str, data: bytes) -> None:
    assert device_feed(text) == [Request(TC, 0x1F, data)]


def test_an_id_that_is_the_escape_byte_goes_out_in_either_form() -> None:
    request = Request(TC, 0x1F, b"\x05")
    assert CUBESPACE.encode_request(request).hex() == "1f7f1f1f051fff"
    assert with_single_id(CUBESPACE.encode_request(request)).hex() == "1f7f1f051fff"


FAULTS = [
    ("41 42 43", [FaultKind.UART_PROTOCOL]),
    ("1F 41", [FaultKind.UART_PROTOCOL]),
    ("1F FF", [FaultKind.UART_PROTOCOL]),
    ("1F 7F 1F FF", [FaultKind.UART_PROTOCOL]),
    ("1F 7F 02 1F 05 06 07", [FaultKind.UART_PROTOCOL]),
    ("1F 7F 02 05 1F 7F 80 1F FF", [FaultKind.UART_INCOMPLETE, 128]),
    ("1F 7F 1F 7F 80 1F FF", [FaultKind.UART_INCOMPLETE, 128]),
    ("00 1F 7F 80 1F FF 00 1F 7F 81 1F FF", [FaultKind.UART_PROTOCOL, 128, FaultKind.UART_PROTOCOL, 129]),
    ("1F 1F 7F 80 1F FF", [FaultKind.UART_PROTOCOL, 128]),
    ("1F 1F 1F 7F 80 1F FF", [FaultKind.UART_PROTOCOL, 128]),
    ("1F 07 80 1F FF", [FaultKind.UART_PROTOCOL]),
]


@pytest.mark.parametrize(("text", "expected"), FAULTS)
def test_bytes_against_the_framing_make_one_fault_each(text: str, expected: list[FaultKind | int]) -> None:
    receiver = CUBESPACE.device()
    assert kinds(receiver.feed(bytes.fromhex(text), 0.0)) == expected
    assert receiver.feed(CUBESPACE.encode_request(GOOD), 1.0)[-1] == GOOD


def test_an_incomplete_message_is_abandoned_after_the_timeout() -> None:
    receiver = limited(timeout=0.5).device()
    assert receiver.feed(b"\x1f\x7f\x02\x05", 10.0) == []
    assert receiver.busy
    assert receiver.flush(10.49) == []
    assert kinds(list(receiver.flush(10.5))) == [FaultKind.UART_INCOMPLETE]
    assert not receiver.busy
    assert receiver.flush(99.0) == []


def test_bytes_after_the_timeout_start_a_new_frame() -> None:
    receiver = limited(timeout=0.5).device()
    receiver.feed(b"\x1f\x7f\x02\x05", 0.0)
    assert kinds(receiver.feed(CUBESPACE.encode_request(GOOD), 1.0)) == [FaultKind.UART_INCOMPLETE, GOOD.id]


def test_an_endless_message_keeps_within_bounds_and_counts_once() -> None:
    receiver = limited(max_size=64).device()
    events = receiver.feed(b"\x1f\x7f\x02" + bytes(100_000), 0.0)
    assert kinds(events) == [FaultKind.UART_OVERLONG]
    assert receiver.feed(CUBESPACE.encode_request(GOOD), 0.0) == [GOOD]


@settings(max_examples=80, deadline=None, derandomize=True)
@given(st.lists(requests, max_size=6), st.lists(st.integers(1, 40), min_size=1), st.booleans())
def test_requests_are_decoded_from_a_stream_cut_anywhere(
    originals: list[Request], cuts: list[int], doubled: bool
) -> None:
    def unambiguous(request: Request) -> bool:
        # a single 0x1F as id, followed by 1F, 7F or FF, means something else
        return request.id != 0x1F or (bool(request.data) and request.data[0] not in (0x1F, 0x7F, 0xFF))

    stream = b"".join(
        line if doubled or not unambiguous(request) else with_single_id(line)
        for request in originals
        for line in [CUBESPACE.encode_request(request)]
    )
    receiver = CUBESPACE.device()
    events: list[Request | LinkFault] = []
    position = number = 0
    while position < len(stream):
        size = cuts[number % len(cuts)]
        events += receiver.feed(stream[position : position + size], 0.0)
        position, number = position + size, number + 1
    assert events == originals


@settings(max_examples=80, deadline=None, derandomize=True)
@given(st.binary(max_size=400), st.integers(1, 50))
def test_events_do_not_depend_on_how_noise_is_cut(noise: bytes, size: int) -> None:
    whole = limited(max_size=32).device().feed(noise, 0.0)
    receiver = limited(max_size=32).device()
    pieces = [
        event
        for start in range(0, len(noise), size)
        for event in receiver.feed(noise[start : start + size], 0.0)
    ]
    assert pieces == whole


def test_the_receiver_survives_ten_thousand_random_byte_strings() -> None:
    random_bytes = random.Random(20260101)
    receiver = CUBESPACE.device()
    for number in range(10_000):
        noise = random_bytes.randbytes(random_bytes.randrange(1, 40))
        if number % 3 == 0:  # noise that resembles the protocol
            noise = bytes(random_bytes.choice(b"\x1f\x7f\xff\x01\x80") for _ in range(len(noise)))
        for event in receiver.feed(noise, float(number)):
            if isinstance(event, Request):
                assert (event.kind is TLM) == (event.id >= 128)
        # after the time-out the next good command is read, alone and whole
        answer = receiver.feed(CUBESPACE.encode_request(GOOD), number + 0.6)
        assert answer[-1] == GOOD
        assert [event for event in answer if isinstance(event, Request)] == [GOOD]


# -- replies -----------------------------------------------------------------------------------------------------------

ACK = Reply(ReplyKind.ACK, 2)
NACK = Reply(ReplyKind.NACK, 2, code=ErrorCode.INVALID_PARAMETER)
TELEMETRY = Reply(ReplyKind.TELEMETRY, 230, b"\x1f\x00\x01\x02\x03\x04")
REFUSED = Reply(ReplyKind.NACK, 250, code=ErrorCode.INVALID_ID)
BURST = Reply(ReplyKind.BURST, 119, bytes(range(BURST_SIZE)))
EVENT = Reply(ReplyKind.EVENT, 3, b"\x01")
UNSOLICITED = Reply(ReplyKind.UNSOLICITED, 160, b"\x09\x08")

PUBLISHED_REPLIES = [
    (Dialect.A, ACK, "1F 7F 02 00 1F FF"),
    (Dialect.A, NACK, "1F 7F 02 03 1F FF"),
    (Dialect.A, TELEMETRY, "1F 7F E6 1F 1F 00 01 02 03 04 1F FF"),
    (Dialect.A, REFUSED, "1F 7F FA 01 1F FF"),
    (Dialect.B, ACK, "1F 7F 00 1F FF"),
    (Dialect.B, NACK, "1F 7F 03 1F FF"),
    (Dialect.B, TELEMETRY, "1F 7F 1F 1F 00 01 02 03 04 1F FF"),
    (Dialect.B, REFUSED, "1F 7F 01 1F FF"),
    (Dialect.C, ACK, "1F 07 02 1F FF"),
    (Dialect.C, NACK, "1F 0F 02 03 1F FF"),
    (Dialect.C, TELEMETRY, "1F 07 E6 1F 1F 00 01 02 03 04 1F FF"),
    (Dialect.C, REFUSED, "1F 0F FA 01 1F FF"),
    (Dialect.C, EVENT, "1F 2F 03 01 1F FF"),
    (Dialect.C, UNSOLICITED, "1F 4F A0 09 08 1F FF"),
]


@pytest.mark.parametrize(("dialect", "reply", "text"), PUBLISHED_REPLIES)
def test_replies_are_framed_and_read_in_each_dialect(dialect: Dialect, reply: Reply, text: str) -> None:
    assert CUBESPACE.encode_reply(reply, dialect).hex(" ").upper() == text
    receiver = CUBESPACE.host(dialect)
    assert reply.id is not None
    if reply.kind not in (ReplyKind.EVENT, ReplyKind.UNSOLICITED):
        receiver.overhear(Request.of(reply.id))
    assert receiver.feed(bytes.fromhex(text), 0.0) == [reply]


@pytest.mark.parametrize("dialect", Dialect)
def test_burst_packets_have_one_form_in_all_dialects(dialect: Dialect) -> None:
    text = CUBESPACE.encode_reply(BURST, dialect)
    assert text[:3] == b"\x1f\x7f\x77"
    receiver = CUBESPACE.host(dialect)
    receiver.overhear(Request.of(119, b"\x14\x01"))
    assert receiver.feed(CUBESPACE.encode_reply(Reply(ReplyKind.ACK, 119), dialect), 0.0) == [
        Reply(ReplyKind.ACK, 119)
    ]
    assert receiver.feed(text * 3, 0.0) == [BURST] * 3


@pytest.mark.parametrize("dialect", [Dialect.A, Dialect.B])
@pytest.mark.parametrize("reply", [EVENT, UNSOLICITED])
def test_generation_1_has_nothing_unsolicited(dialect: Dialect, reply: Reply) -> None:
    assert not CUBESPACE.supports_unsolicited(dialect)
    with pytest.raises(ProtocolError, match="use dialect c"):
        CUBESPACE.encode_reply(reply, dialect)


@pytest.mark.parametrize("dialect", Dialect)
def test_no_dialect_has_echoes(dialect: Dialect) -> None:
    with pytest.raises(ProtocolError, match=f"serial dialect {dialect} has no echo messages"):
        CUBESPACE.encode_reply(Reply(ReplyKind.ECHO, 2), dialect)


def test_unknown_error_codes_stay_numbers() -> None:
    receiver = CUBESPACE.host(Dialect.A)
    assert receiver.feed(bytes.fromhex("1F7F02631FFF"), 0.0) == [Reply(ReplyKind.NACK, 2, code=99)]


def test_in_dialect_b_a_reply_to_nothing_is_a_fault() -> None:
    receiver = CUBESPACE.host(Dialect.B)
    events = receiver.feed(
        CUBESPACE.encode_reply(TELEMETRY, Dialect.B) + CUBESPACE.encode_reply(ACK, Dialect.B), 0.0
    )
    assert [event.kind for event in events] == [FaultKind.UART_PROTOCOL] * 2


@pytest.mark.parametrize("dialect", Dialect)
def test_no_refusal_has_the_code_0(dialect: Dialect) -> None:
    receiver = CUBESPACE.host(dialect)
    receiver.overhear(Request.of(230))
    line = {Dialect.A: "1F7FE6001FFF", Dialect.B: "1F7F001FFF", Dialect.C: "1F0FE6001FFF"}[dialect]
    (event,) = receiver.feed(bytes.fromhex(line), 0.0)
    assert event.kind is FaultKind.UART_PROTOCOL
    assert "an acknowledge of an earlier request" in event.detail
    assert receiver.feed(CUBESPACE.encode_reply(TELEMETRY, dialect), 0.0) == [TELEMETRY]


@pytest.mark.parametrize("late", [Reply(ReplyKind.TELEMETRY, 240, bytes(6)), Reply(ReplyKind.ACK, 2)])
def test_in_dialect_a_a_late_reply_to_another_request_leaves_the_next_one_awaited(late: Reply) -> None:
    receiver = CUBESPACE.host(Dialect.A)
    receiver.overhear(Request.of(230))
    refusal = Reply(ReplyKind.NACK, 230, code=ErrorCode.BUSY)
    line = CUBESPACE.encode_reply(late, Dialect.A) + CUBESPACE.encode_reply(refusal, Dialect.A)
    assert receiver.feed(line, 0.0) == [late, refusal]


def test_in_dialect_b_one_expectation_takes_one_reply() -> None:
    receiver = CUBESPACE.host(Dialect.B)
    receiver.overhear(Request.of(230))
    events = receiver.feed(CUBESPACE.encode_reply(TELEMETRY, Dialect.B) * 2, 0.0)
    assert events[0] == TELEMETRY
    assert isinstance(events[1], LinkFault)


def test_a_telecommand_answered_by_more_than_a_code_is_a_fault() -> None:
    receiver = CUBESPACE.host(Dialect.A)
    (event,) = receiver.feed(bytes.fromhex("1F7F0200001FFF"), 0.0)
    assert isinstance(event, LinkFault)
    assert "must be 1" in event.detail


reply_data = st.binary(min_size=2, max_size=80).filter(lambda data: len(data) != BURST_SIZE + 1)


@settings(max_examples=80, deadline=None, derandomize=True)
@given(st.sampled_from(Dialect), st.integers(128, 255), reply_data)
def test_telemetry_comes_back_in_each_dialect(dialect: Dialect, identifier: int, data: bytes) -> None:
    receiver = CUBESPACE.host(dialect)
    receiver.overhear(Request.of(identifier))
    reply = Reply(ReplyKind.TELEMETRY, identifier, data)
    assert receiver.feed(CUBESPACE.encode_reply(reply, dialect), 0.0) == [reply]


@settings(max_examples=80, deadline=None, derandomize=True)
@given(st.sampled_from(Dialect), st.lists(st.binary(max_size=40), max_size=8))
def test_the_host_survives_any_bytes(dialect: Dialect, noise: list[bytes]) -> None:
    receiver = limited(max_size=64).host(dialect)
    for piece in noise:
        receiver.feed(piece, 0.0)
    receiver.feed(b"", 10.0)
    receiver.overhear(Request.of(230))
    events = receiver.feed(CUBESPACE.encode_reply(TELEMETRY, dialect), 10.0)
    assert events[-1] == TELEMETRY


def test_the_longest_row_is_read_in_each_dialect() -> None:
    data = bytes(600)
    stack = stack_of(
        {"framing": {"kind": "cubespace"}}, rows=(shape("", 200, RequestKind.TELEMETRY, 0, 600),)
    )
    for dialect in Dialect:
        receiver = stack.host(dialect)
        receiver.overhear(Request.of(200))
        reply = Reply(ReplyKind.TELEMETRY, 200, data)
        assert receiver.feed(stack.encode_reply(reply, dialect), 0.0) == [reply]
