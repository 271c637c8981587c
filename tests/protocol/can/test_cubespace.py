"""CAN framing: the published vectors, segments that count down, and a receiver that no frame throws off."""

from __future__ import annotations

import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from starhil.protocol.can.cubespace import (
    MAX_MESSAGE,
    MAX_OPEN_MESSAGES,
    CanDeviceReceiver,
    CanHostReceiver,
    CanId,
    MessageType,
    encode_reply_frames,
    encode_request_frames,
    segment,
)
from starhil.protocol.can.frame import CanFrame, format_candump
from starhil.protocol.errors import ProtocolError
from starhil.protocol.messages import ErrorCode, FaultKind, LinkFault, Reply, ReplyKind, Request, RequestKind
from tests.candump import parse_candump

OBC, DEVICE = 1, 4
GOOD = Request(RequestKind.TELECOMMAND, 54, bytes(range(12)), OBC)


def frame(text: str) -> CanFrame:
    """Read a frame as cansend takes it: `07360104#0001`."""
    return parse_candump(f"(0.000000) vcan0 {text}")[1]


def text(frames: list[CanFrame]) -> list[str]:
    """Write frames as cansend takes them."""
    return [format_candump(one, "vcan0").split()[-1] for one in frames]


def take(
    receiver: CanDeviceReceiver | CanHostReceiver, frames: list[CanFrame], now: float = 0.0
) -> list[object]:
    return [event for one in frames for event in receiver.feed(one, now)]


# -- published vectors -------------------------------------------------------------------------------------------------


def test_vector_telecommand_54_of_12_bytes() -> None:
    frames = encode_request_frames(Request.of(54, bytes(range(12))), OBC, DEVICE)
    assert text(frames) == ["07360104#0001020304050601", "07360104#0708090A0B00"]
    assert take(CanDeviceReceiver(DEVICE), frames) == [GOOD]


def test_vector_acknowledge() -> None:
    frames = encode_reply_frames(Reply(ReplyKind.ACK, 54, destination=OBC), DEVICE)
    assert text(frames) == ["02360401#"]
    assert take(CanHostReceiver(OBC, DEVICE), frames) == [Reply(ReplyKind.ACK, 54, source=DEVICE)]


def test_vector_telemetry_133_of_8_bytes() -> None:
    request = encode_request_frames(Request.of(133), OBC, DEVICE)
    assert text(request) == ["04850104#"]
    assert take(CanDeviceReceiver(DEVICE), request) == [Request(RequestKind.TELEMETRY, 133, b"", OBC)]
    reply = encode_reply_frames(Reply(ReplyKind.TELEMETRY, 133, bytes(range(8)), destination=OBC), DEVICE)
    assert text(reply) == ["05850401#0001020304050607"]


def test_vector_telemetry_170_of_33_bytes_counts_from_4_to_0() -> None:
    frames = encode_reply_frames(Reply(ReplyKind.TELEMETRY, 170, bytes(range(33)), destination=OBC), DEVICE)
    assert [one.id for one in frames] == [0x08AA0401] * 5
    assert [one.data[-1] for one in frames] == [4, 3, 2, 1, 0]
    assert [len(one.data) for one in frames] == [8, 8, 8, 8, 6]
    assert take(CanHostReceiver(OBC), frames) == [
        Reply(ReplyKind.TELEMETRY, 170, bytes(range(33)), source=DEVICE)
    ]


def test_vector_refusal() -> None:
    frames = encode_reply_frames(
        Reply(ReplyKind.NACK, 133, code=ErrorCode.INVALID_PARAMETER, destination=OBC), DEVICE
    )
    assert text(frames) == ["06850401#03"]
    assert take(CanHostReceiver(OBC), frames) == [
        Reply(ReplyKind.NACK, 133, code=ErrorCode.INVALID_PARAMETER, source=DEVICE)
    ]


def test_refused_telecommands_have_their_own_type() -> None:
    frames = encode_reply_frames(Reply(ReplyKind.NACK, 54, code=ErrorCode.CRC, destination=OBC), DEVICE)
    assert text(frames) == ["03360401#04"]


# -- there and back ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [0, 1, 7, 8, 9, 13, 14, 15, 53, 56, 512, MAX_MESSAGE])
def test_segments_of_any_size_are_full_but_the_last(size: int) -> None:
    data = bytes(number % 251 for number in range(size))
    parts = segment(data)
    if size <= 8:
        assert parts == [data]
    else:
        assert [part[-1] for part in parts] == list(range(len(parts) - 1, -1, -1))
        assert all(len(part) == 8 for part in parts[:-1])
        assert b"".join(part[:-1] for part in parts) == data
        assert len(parts[-1]) == (size - 1) % 7 + 2


def test_a_message_too_long_for_the_counter_is_rejected() -> None:
    with pytest.raises(ProtocolError, match="does not fit"):
        segment(bytes(MAX_MESSAGE + 1))


@settings(max_examples=80, deadline=None, derandomize=True)
@given(st.integers(0, 255), st.binary(max_size=512), st.integers(0, 255))
def test_requests_survive_encoding_and_decoding(identifier: int, data: bytes, source: int) -> None:
    if identifier >= 128:
        data = data[:8]
    request = Request.of(identifier, data, source)
    assert take(CanDeviceReceiver(DEVICE), encode_request_frames(request, source, DEVICE)) == [request]


replies = st.one_of(
    st.builds(Reply, st.just(ReplyKind.TELEMETRY), st.integers(128, 255), st.binary(max_size=300)),
    st.builds(Reply, st.just(ReplyKind.UNSOLICITED), st.integers(128, 255), st.binary(max_size=300)),
    st.builds(Reply, st.just(ReplyKind.EVENT), st.integers(0, 255), st.binary(max_size=8)),
    st.builds(Reply, st.just(ReplyKind.NACK), st.integers(0, 255), code=st.sampled_from(ErrorCode)),
    st.builds(Reply, st.just(ReplyKind.ACK), st.integers(0, 127)),
    st.builds(Reply, st.just(ReplyKind.BURST), st.just(119), st.binary(min_size=22, max_size=22)),
)


@settings(max_examples=80, deadline=None, derandomize=True)
@given(st.lists(replies, max_size=5))
def test_replies_survive_encoding_and_decoding(sent: list[Reply]) -> None:
    receiver = CanHostReceiver(OBC, DEVICE)
    got: list[object] = []
    for reply in sent:
        addressed = Reply(reply.kind, reply.id, reply.data, reply.code, destination=OBC)
        got += take(receiver, encode_reply_frames(addressed, DEVICE))
    assert got == [Reply(r.kind, r.id, r.data, r.code, source=DEVICE) for r in sent]


def test_messages_of_several_senders_may_interleave() -> None:
    receiver = CanDeviceReceiver(DEVICE)
    first = encode_request_frames(Request.of(54, bytes(20)), 1, DEVICE)
    second = encode_request_frames(Request.of(54, bytes(range(20))), 2, DEVICE)
    events = take(receiver, [one for pair in zip(first, second, strict=True) for one in pair])
    assert events == [Request.of(54, bytes(20), 1), Request.of(54, bytes(range(20)), 2)]


def test_frames_for_other_nodes_are_ignored() -> None:
    receiver = CanDeviceReceiver(DEVICE)
    assert take(receiver, encode_request_frames(Request.of(54, bytes(20)), OBC, 9)) == []
    assert take(receiver, [CanFrame(0x104, b"", extended=False), CanFrame(0x04850104, remote=True)]) == []
    host = CanHostReceiver(OBC, DEVICE)
    assert take(host, encode_reply_frames(Reply(ReplyKind.ACK, 2, destination=OBC), 9)) == []
    assert take(host, encode_request_frames(Request.of(54, bytes(20)), 2, OBC)) == []


# -- faults ------------------------------------------------------------------------------------------------------------


def _segments() -> list[CanFrame]:
    return encode_request_frames(Request.of(54, bytes(range(30))), OBC, DEVICE)


WHOLE = Request.of(54, bytes(range(30)), OBC)

BROKEN = [
    ("one lost", lambda f: f[:1] + f[2:], [FaultKind.CAN_SEQUENCE]),
    ("two swapped", lambda f: [f[0], f[2], f[1], *f[3:]], [FaultKind.CAN_SEQUENCE]),
    ("one twice", lambda f: [f[0], f[1], f[1], *f[2:]], [FaultKind.CAN_SEQUENCE]),
    (
        "a short one inside",
        lambda f: [f[0], CanFrame(f[1].id, f[1].data[3:]), *f[2:]],
        [FaultKind.CAN_SEQUENCE],
    ),
    ("an empty one", lambda f: [f[0], CanFrame(f[0].id)], [FaultKind.CAN_LENGTH]),
    ("only the last", lambda f: f[-1:], [FaultKind.CAN_SEQUENCE]),
    ("counter 0 at the start", lambda f: [CanFrame(f[0].id, bytes(8))], [FaultKind.CAN_SEQUENCE]),
]


@pytest.mark.parametrize(
    ("change", "expected"), [case[1:] for case in BROKEN], ids=[case[0] for case in BROKEN]
)
def test_a_broken_message_is_one_fault_and_no_request(change: object, expected: list[FaultKind]) -> None:
    receiver = CanDeviceReceiver(DEVICE)
    events = take(receiver, change(_segments()))  # type: ignore[operator]
    assert [event.kind for event in events if isinstance(event, LinkFault)] == expected
    assert not [event for event in events if isinstance(event, Request)]
    assert take(receiver, _segments()) == [WHOLE]


def test_a_restarted_message_is_accepted() -> None:
    receiver = CanDeviceReceiver(DEVICE)
    events = take(receiver, _segments()[:2] + _segments())
    assert isinstance(events[0], LinkFault)
    assert events[0].detail.endswith(f", expected {_segments()[2].data[-1]}")
    assert events[1:] == [WHOLE]


def test_an_incomplete_message_is_abandoned_after_the_timeout() -> None:
    receiver = CanDeviceReceiver(DEVICE, timeout_s=0.5)
    take(receiver, _segments()[:2], 0.0)
    assert receiver.busy
    assert receiver.flush(0.49) == []
    assert [fault.kind for fault in receiver.flush(0.5)] == [FaultKind.CAN_INCOMPLETE]
    assert not receiver.busy
    assert take(receiver, _segments(), 1.0) == [WHOLE]


def test_a_message_longer_than_allowed_is_one_fault() -> None:
    receiver = CanDeviceReceiver(DEVICE, max_size=64)
    frames = encode_request_frames(Request.of(54, bytes(200)), OBC, DEVICE)
    events = take(receiver, frames)
    assert [event.kind for event in events if isinstance(event, LinkFault)] == [FaultKind.CAN_OVERLONG]
    assert take(receiver, _segments()) == [WHOLE]


def test_too_many_open_messages_evict_the_oldest() -> None:
    receiver = CanDeviceReceiver(DEVICE)
    senders = range(MAX_OPEN_MESSAGES + 5)
    frames = [encode_request_frames(Request.of(54, bytes(12)), source, DEVICE) for source in senders]
    events: list[object] = []
    for source in senders:
        events += take(receiver, frames[source][:1], now=source * 1e-4)
    assert [event.kind for event in events if isinstance(event, LinkFault)] == [FaultKind.CAN_OVERLONG] * 5
    ends = [take(receiver, frames[source][1:], now=0.01) for source in senders]
    whole = [[type(event) for event in end] == [Request] for end in ends]
    assert whole == [source >= 5 for source in senders]


@pytest.mark.parametrize(
    "text_",
    [
        "00360104#",
        "02360104#",
        "05850104#00",
        "09360104#",
        "1F360104#",
        "01850104#",
        "04360104#",
        "07850104#0001020304050601",
    ],
)
def test_types_other_than_requests_are_faults(text_: str) -> None:
    (event,) = CanDeviceReceiver(DEVICE).feed(frame(text_), 0.0)
    assert isinstance(event, LinkFault)
    assert event.kind is FaultKind.CAN_TYPE


def test_a_refusal_without_a_code_is_a_fault() -> None:
    (event,) = CanHostReceiver(OBC).feed(frame("06850401#"), 0.0)
    assert isinstance(event, LinkFault)
    assert event.kind is FaultKind.CAN_LENGTH


def test_lost_first_segment_of_unsolicited_telemetry_is_noticed() -> None:
    frames = encode_reply_frames(Reply(ReplyKind.UNSOLICITED, 160, bytes(56), destination=OBC), DEVICE)
    assert [CanId.unpack(one.id).type for one in frames] == [
        MessageType.UNSOLICITED_FIRST, *[MessageType.UNSOLICITED_BODY] * 6, MessageType.UNSOLICITED_LAST,
    ]  # fmt: skip
    events = take(CanHostReceiver(OBC), frames[:3] + frames[4:])
    assert [type(event) for event in events] == [LinkFault]


def test_the_receiver_survives_ten_thousand_random_frames() -> None:
    source = random.Random(20260102)
    receiver = CanDeviceReceiver(DEVICE)
    accepted = 0
    for number in range(10_000):
        identifier = source.getrandbits(29)
        if number % 2:  # frames that look like the protocol, to this device
            kind = source.choice((1, 4, 7, 7, 7, source.getrandbits(5)))
            identifier = CanId(kind, source.choice((54, 230, source.getrandbits(8))), OBC, DEVICE).pack()
        data = source.randbytes(source.randrange(9))
        if len(data) == 8 and number % 3:
            data = data[:7] + bytes((source.randrange(4),))
        for event in receiver.feed(CanFrame(identifier, data), number * 1e-2):
            if isinstance(event, Request):
                accepted += 1
                parts = CanId.unpack(identifier)
                assert parts.destination == DEVICE
                assert (parts.type, event.id >= 128) in ((1, False), (4, True), (7, False))
                if parts.type == MessageType.TELECOMMAND_EXTENDED:
                    assert len(event.data) > 7
        if number % 100 == 0:
            # after the time-out the next good command is read, alone and whole
            events = take(receiver, encode_request_frames(GOOD, OBC, DEVICE), number * 1e-2 + 0.5)
            assert events[-1] == GOOD
            assert [event for event in events if isinstance(event, Request)] == [GOOD]
    assert accepted > 100


# -- identifiers, frames, logs -----------------------------------------------------------------------------------------


@settings(max_examples=80, deadline=None, derandomize=True)
@given(st.integers(0, 0x1FFFFFFF))
def test_can_ids_are_split_and_joined(raw: int) -> None:
    assert CanId.unpack(raw).pack() == raw


@pytest.mark.parametrize("parts", [(32, 0, 0, 0), (0, 256, 0, 0), (0, 0, -1, 0), (0, 0, 0, 300)])
def test_parts_that_do_not_fit_a_can_id_are_rejected(parts: tuple[int, int, int, int]) -> None:
    with pytest.raises(ProtocolError):
        CanId(*parts).pack()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"id": 0x800, "extended": False}, "11-bit"),
        ({"id": 1 << 29}, "29-bit"),
        ({"id": -1}, "29-bit"),
        ({"id": 1, "data": bytes(9)}, "at most 8"),
        ({"id": 1, "data": b"x", "remote": True}, "remote frame with data"),
    ],
)
def test_an_impossible_frame_is_rejected(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(ProtocolError, match=message):
        CanFrame(**arguments)  # type: ignore[arg-type]


def test_candump_lines_have_the_format_of_candump() -> None:
    assert format_candump(
        CanFrame(0x123, b"\xde\xad", extended=False, timestamp=1436509052.249713), "vcan0"
    ) == ("(1436509052.249713) vcan0 123#DEAD")
    assert format_candump(CanFrame(0x701, extended=False, remote=True, timestamp=1.0), "can1") == (
        "(0000000001.000000) can1 701#R"
    )


@settings(max_examples=80, deadline=None, derandomize=True)
@given(
    st.builds(
        CanFrame,
        st.integers(0, 0x7FF),
        st.binary(max_size=8),
        st.booleans(),
        timestamp=st.integers(0, 2**31).map(float),
    )
)
def test_python_can_reads_the_lines_of_a_candump_log(one: CanFrame) -> None:
    channel, read = parse_candump(format_candump(one, "can0"))
    assert (channel, read, read.timestamp) == ("can0", one, one.timestamp)
