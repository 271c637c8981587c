"""Byte stuffing, formats of a direction or class, and texts: their bytes, their faults, and errors of their keys."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from starhil.protocol.errors import IcdError, ProtocolError
from starhil.protocol.export.c import render_folder as c_files
from starhil.protocol.export.cosmos_plugin import render_folder as cosmos_files
from starhil.protocol.export.xtce import render as xtce
from starhil.protocol.messages import ErrorCode, FaultKind, LinkFault, Reply, ReplyKind, Request, RequestKind
from starhil.protocol.serial.stack import SerialStack
from starhil.protocol.unit import load_unit, read_definition
from tests.protocol.serial.composed_links import TC, TLM, faults, shape, stack_of

ST200 = load_unit("st200")
STACK = SerialStack(ST200)
RECORD = ST200.request(ST200.telemetry["record"])
COMMAND = ST200.request(ST200.telecommands["set_keep_alive"])

STUFFED = stack_of(
    {
        "framing": {"kind": "length", "start": [0xF1], "stuffing": {"escape": 0xF0, "mask": 0x0F}},
        "check": {"kind": "xor"},
        "request_header": [{"role": "length", "type": "u8"}, {"role": "id", "type": "u8"}],
        "reply_header": [{"role": "length", "type": "u8"}, {"role": "id", "type": "u8"}],
    },
    rows=(shape("", 3, TC, 4), shape("", 200, TLM, 0, 6)),
)


def record(data: bytes) -> Reply:
    return Reply(ReplyKind.TELEMETRY, 128, data, message_class="record")


def test_the_bytes_of_the_range_are_sent_as_two() -> None:
    sent = STUFFED.encode_request(Request(TC, 3, b"\xef\xf0\xf3\xff"))
    assert sent.hex(" ") == "f1 04 03 ef f0 00 f0 03 f0 0f 14"


@given(data=st.binary(max_size=60), pieces=st.lists(st.integers(1, 9), min_size=1))
def test_a_stuffed_message_is_read_in_pieces_of_any_size(data: bytes, pieces: list[int]) -> None:
    request = Request(TC, 3, data)
    sent, receiver, events, at = STUFFED.encode_request(request) * 2, STUFFED.device(), [], 0
    assert [byte for byte in sent if byte > 0xF0] == [0xF1, 0xF1]
    while at < len(sent):
        size = pieces[at % len(pieces)]
        events += receiver.feed(sent[at : at + size], 0.0)
        at += size
    assert events == [request, request]


def test_a_message_cut_off_by_another_is_flagged_and_the_other_read() -> None:
    request = Request(TC, 3, b"\xf1\xf1\xf1\xf1")
    sent, receiver = STUFFED.encode_request(request), STUFFED.device()
    events = receiver.feed(sent[:5] + sent, 0.0)
    assert events[-1] == request
    assert faults(events[:-1]) == [FaultKind.UART_CHECK]


def test_requests_are_texts_and_replies_text_or_binary() -> None:
    assert STACK.encode_request(RECORD) == b"show record\r"
    assert STACK.encode_reply(Reply(ReplyKind.ACK, 3, message_class="command")) == b"READY\r\n"
    assert STACK.encode_reply(Reply(ReplyKind.NACK, 129, code=ErrorCode.INVALID_ID)) == b"ERROR 1\r\n"
    sent = STACK.encode_reply(record(b"\xf7" * 51))
    assert sent[0] == 0xF1
    assert sent[1:-1] == b"\xf0\x07" * 51
    assert STACK.device().feed(b"show record\r set keep-alive  off \r", 0.0) == [RECORD, COMMAND]


def test_an_unknown_text_is_a_request_for_a_row_that_does_not_exist() -> None:
    (request,) = STACK.device().feed(b"show record!\r", 0.0)
    assert isinstance(request, Request)
    assert request.id not in {row.id for row in ST200.rows}


def test_the_host_reads_each_format_and_names_the_request() -> None:
    host = STACK.host()
    host.overhear(COMMAND)
    host_events = host.feed(b"READY\r\n", 0.0)
    assert [(event.kind, event.id) for event in host_events if isinstance(event, Reply)] == [
        (ReplyKind.ACK, 3)
    ]
    host.overhear(RECORD)
    sent = STACK.encode_reply(record(bytes(range(0xC0, 0xF3))))
    (reply,) = [event for byte in sent for event in host.feed(bytes((byte,)), 0.0)]
    assert isinstance(reply, Reply)
    assert (reply.kind, reply.id, reply.message_class, reply.data) == (
        ReplyKind.TELEMETRY, 128, "record", bytes(range(0xC0, 0xF3)),
    )  # fmt: skip
    host.overhear(RECORD)
    (refusal,) = host.feed(b"ERROR 6\r\n", 0.0)
    assert isinstance(refusal, Reply)
    assert (refusal.kind, refusal.id, refusal.code) == (ReplyKind.NACK, 128, ErrorCode.BUSY)


@pytest.mark.parametrize("asked", [None, COMMAND], ids=["nothing", "a command"])
def test_a_record_that_nobody_requested_is_a_fault(asked: Request | None) -> None:
    host = STACK.host()
    if asked is not None:
        host.overhear(asked)
    events = host.feed(STACK.encode_reply(record(bytes(51))), 0.0)
    assert events
    assert all(isinstance(event, LinkFault) for event in events)


@pytest.mark.parametrize(
    ("text", "asked"),
    [
        (b"READY\r\n", None),
        (b"READY\r\n", RECORD),
        (b"ready\r\n", COMMAND),
        (b"ERROR x\r\n", COMMAND),
        (b"\r\n", COMMAND),
    ],
)
def test_a_text_that_answers_nothing_is_a_fault(text: bytes, asked: Request | None) -> None:
    host = STACK.host()
    if asked is not None:
        host.overhear(asked)
    (event,) = host.feed(text, 0.0)
    assert isinstance(event, LinkFault)


def test_a_damaged_record_is_flagged_and_the_next_read() -> None:
    sent = STACK.encode_reply(record(b"\xf7" * 51))
    for place in range(1, len(sent)):
        damaged, host = bytearray(sent), STACK.host()
        damaged[place] ^= 0x01
        host.overhear(RECORD)
        assert not [event for event in host.feed(bytes(damaged), 0.0) if isinstance(event, Reply)], place
        host.flush(1.0)
        host.overhear(RECORD)
        (reply,) = host.feed(sent, 2.0)
        assert isinstance(reply, Reply)


def test_a_request_that_no_text_expresses_is_an_error() -> None:
    for request in (
        Request(TLM, 128, b"\0", message_class="record"),
        Request(RequestKind.TELECOMMAND, 99, message_class="command"),
    ):
        with pytest.raises(ProtocolError, match=r"link\.serial: no text|link\.serial: a text has no data"):
            STACK.encode_request(request)


def test_exports_to_code_name_what_they_lack() -> None:
    for export in (c_files, cosmos_files):
        with pytest.raises(IcdError, match=r"link\.serial: requests that are texts cannot be exported to "):
            export(ST200)
    assert 'name="record"' in xtce(ST200)


HEAD = '[unit]\nname = "u"\nversion = "1"\ndoc = "d"\nprovenance = "ours"\n'
CLASSES = '[[class]]\nname = "a"\nkind = "telecommand"\n[[class]]\nname = "b"\nkind = "telemetry"\n'
LINK = '[link.serial]\nframing = {{ kind = "delimited", end = [13] }}\n{}\n'
FORMAT = "[[link.serial.format]]\n{}\n"
ROW = '[[telemetry]]\nid = 128\nname = "r"\ndoc = "d"\nfields = [{ name = "x", type = "u8", value = "stars.matched" }]\n'
PING = '[[telecommand]]\nid = 1\nname = "p"\ndoc = "d"\naction = "nothing"\n'
STUFFING = 'framing = {{ kind = "fixed", start = [241], stuffing = {{ escape = {}, mask = {} }} }}'


@pytest.mark.parametrize(
    ("text", "error"),
    [
        (LINK.format("") + PING + 'request = "ping"\n' + ROW.replace('doc = "d"\n', 'doc = "d"\nrequest = "ping"\n'), "request 'ping' is already that of p"),
        (LINK.format("") + PING + 'request = "ping"\n' + 'fields = [{ name = "n", type = "u8" }]\n', "`request` is a text without data; it has no fields"),
        (LINK.format("") + PING + 'request = " ping"\n', "request"),
        (LINK.format("") + PING + 'request = "ping"\nlast_id = 4\n', "telecommand p_2: request 'ping' is already that of p_1"),
        (LINK.format("") + PING + 'request = "ping"\n' + ROW, "telemetry r: needs `request`, a text, as the other rows of its format on link.serial"),
        (LINK.format("") + PING + 'request = "ping"\nanswer = ["echo"]\nacknowledge = "OK"', "acknowledge"),
        (LINK.format('acknowledge = "OK"') + PING + 'request = "ping"\nanswer = ["echo"]\n', "with `format`, `acknowledge` or `refusal` has no echoes"),
        (PING + 'request = "ping"\n', "`request` is a text on link.serial, which the unit does not have"),
        (LINK.format("").replace("delimited", "fixed") + PING + 'request = "ping"\n', "texts need a framing with an end, such as delimited, not fixed"),
        (LINK.format("") + FORMAT.format('direction = "reply"'), "link.serial.format 1: needs `framing` or `check`"),
        (LINK.format("") + CLASSES + FORMAT.format('classes = ["c"]\ncheck = { kind = "none" }'), "link.serial.format 1: no class named 'c' (known: a, b)"),
        (LINK.format("") + FORMAT.format('framing = { kind = "cubespace" }'), "framing cubespace has its own formats"),
        (LINK.format("") + CLASSES + FORMAT.format('classes = ["b"]\ncheck = { kind = "xor" }'), "framings delimited of class b and delimited of all other messages have no `start`; give them different first bytes"),
        (LINK.format("") + CLASSES + FORMAT.format('classes = ["b"]\nframing = { kind = "slip" }'), "framing slip cannot stand beside another; set `direction`"),
        (LINK.format("") + FORMAT.format('check = { kind = "xor" }') * 2, "a format after one without `classes` fits no message"),
        (LINK.format("") + FORMAT.format('direction = "reply"\n' + STUFFING.format(0xF0, 0)), "mask 0x00 must have bits"),
        (LINK.format("") + FORMAT.format('direction = "reply"\n' + STUFFING.format(0xF0, 0x1F)), "only bits that escape 0xf0 does not have"),
        (LINK.format("") + PING, "link.serial.request_header: needs a field with role id"),
    ],
)  # fmt: skip
def test_contradictory_keys_are_errors_of_one_line(tmp_path, text: str, error: str) -> None:
    path = tmp_path / "unit.toml"
    path.write_text(HEAD + text)
    errors = read_definition(path)[1]
    assert [found for found in errors if error in found], errors
    assert all(len(found.splitlines()) == 1 for found in errors)
