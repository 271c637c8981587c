"""The traffic on the links as a trace shows it, for units with and without each kind of link."""

from types import SimpleNamespace

import pytest

from starhil.emulator.launch.unit_in_memory import MemorySerial
from starhil.emulator.links.traffic import (
    CONSOLE_ADDRESS,
    MAX_ADDRESSES,
    Decoder,
    Traffic,
    WireItem,
    canopen_text,
    short,
)
from starhil.protocol.can.cubespace import encode_reply_frames, encode_request_frames
from starhil.protocol.can.frame import CanFrame
from starhil.protocol.messages import ErrorCode, Reply, ReplyKind, Request, RequestKind
from starhil.protocol.serial.cubespace import Dialect
from starhil.protocol.unit import load_unit
from tests.protocol.serial.composed_links import CUBESPACE

ICD = load_unit()
MODE = ICD.telecommands["set_mode"]
STATUS = ICD.telemetry["device_status"]
ACK = CUBESPACE.encode_reply(Reply(ReplyKind.ACK, MODE.id), Dialect.A)


def sent(item):
    """Return an item that the device sends."""
    return WireItem(0.0, "can", outgoing=True, item=item)


LINES = {
    "an 11-bit frame": ("cubestar", CanFrame(0x62C, b"\x40\x18\x10", extended=False), ("canopen", "node 44 SDO request", "62C#401810")),
    "an RPDO": ("cubestar", CanFrame(0x22C, b"\1", extended=False), ("canopen", "node 44 RPDO 1", "22C#01")),
    "a remote frame": ("cubestar", CanFrame(0x72C, extended=False, remote=True), ("canopen", "node 44 heartbeat", "72C#R")),
    "an acknowledge": ("cubestar", ACK, ("ack", "set_mode accepted", ACK.hex(" ").upper())),
    "a 29-bit frame without CAN": ("nos3", CanFrame(0x08AA0401, b"\1"), ("part", "29-bit frame", "08AA0401#01")),
    "bytes without a serial line": ("oresat", b"\x1f\x7f", ("part", "bytes", "1F 7F")),
}  # fmt: skip


@pytest.mark.parametrize(
    ("value", "text"),
    [(1767225627.15, "1767225627.15"), (1e6, "1000000"), (0.7369893193244934, "0.736989"), (1e300, "1e+300"), (b"\1\xff", "01 FF"), (7, "7")],
)  # fmt: skip
def test_a_time_is_shown_to_its_microseconds_and_other_numbers_shortly(value, text):
    assert short(value) == text


@pytest.mark.parametrize("name", LINES)
def test_what_passes_is_named_as_far_as_the_unit_has_such_a_link(name):
    unit, item, expected = LINES[name]
    line = Decoder(load_unit(unit), lambda: Dialect.A).line(sent(item))
    assert (line["kind"], line["text"], line["raw"]) == expected
    assert not line["own"]


def test_a_row_is_found_by_its_name():
    decoder = Decoder(ICD, lambda: None)
    assert decoder.row_named("device_status") is STATUS
    assert decoder.row_named("nothing") is None


def test_a_reply_without_an_id_is_that_to_the_last_request():
    decoder = Decoder(ICD, lambda: Dialect.B)
    request_bytes = CUBESPACE.encode_request(Request(RequestKind.TELEMETRY, STATUS.id))
    reply = Reply(ReplyKind.TELEMETRY, STATUS.id, STATUS.encode(STATUS.example(), saturate=True))
    answer = CUBESPACE.encode_reply(reply, Dialect.B)
    kinds = [
        decoder.line(WireItem(0.0, "serial", outgoing=item is answer, item=item))["text"]
        for item in (request_bytes, answer)
    ]
    assert all(STATUS.name in text for text in kinds), kinds


def test_frames_between_the_console_and_the_unit_are_its_own():
    (frame,) = encode_reply_frames(Reply(ReplyKind.ACK, MODE.id, destination=CONSOLE_ADDRESS), 4)
    assert Decoder(ICD, lambda: None).line(sent(frame))["own"]


def test_segments_for_more_addresses_than_are_joined_are_forgotten():
    decoder = Decoder(ICD, lambda: None)
    data = STATUS.encode(STATUS.example(), saturate=True)

    def frames(destination):
        return encode_reply_frames(Reply(ReplyKind.TELEMETRY, STATUS.id, data, destination=destination), 4)

    first, *others = frames(1)
    decoder.events(sent(first))
    for destination in range(2, MAX_ADDRESSES + 2):
        (whole,) = [event for frame in frames(destination) for event in decoder.events(sent(frame))]
        assert whole.data == data
    found = [event for frame in others for event in decoder.events(sent(frame))]
    assert data not in [getattr(event, "data", b"") for event in found]


def lines(items, dialect=Dialect.B):
    decoder = Decoder(ICD, lambda: dialect)
    return [
        (line["kind"], line["text"])
        for line in (
            decoder.line(
                WireItem(0.01 * number, "can" if isinstance(item, CanFrame) else "serial", outgoing, item)
            )
            for number, (outgoing, item) in enumerate(items)
        )
    ]


@pytest.mark.parametrize("dialect", list(Dialect))
def test_serial_requests_and_replies_are_named_in_every_dialect(dialect):
    data = STATUS.encode(STATUS.example(), saturate=True)
    request, command = Request.of(STATUS.id), Request.of(MODE.id, MODE.encode({"mode": "standby"}))
    trace = lines(
        [
            (False, CUBESPACE.encode_request(request)),
            (True, CUBESPACE.encode_reply(Reply(ReplyKind.TELEMETRY, STATUS.id, data), dialect)),
            (False, CUBESPACE.encode_request(command)[:3]),
            (False, CUBESPACE.encode_request(command)[3:]),
            (True, CUBESPACE.encode_reply(Reply(ReplyKind.NACK, MODE.id, code=ErrorCode.SEQUENCE), dialect)),
        ],
        dialect,
    )
    assert trace[0] == ("telemetry", "device_status?")
    assert trace[1][0] == "reply"
    assert trace[1][1].startswith("device_status mode=boot error=none")
    assert trace[2] == ("part", "part of a message")
    assert trace[3] == ("telecommand", "set_mode mode=standby")
    assert trace[4] == ("nack", "set_mode refused: sequence")


def test_segments_on_can_are_joined_for_each_pair_of_nodes():
    data = STATUS.encode(STATUS.example(), saturate=True)
    reply = Reply(ReplyKind.TELEMETRY, STATUS.id, data, destination=1)
    other = Reply(ReplyKind.TELEMETRY, STATUS.id, data, destination=253)
    segments = zip(encode_reply_frames(reply, 4), encode_reply_frames(other, 4), strict=True)
    found = lines([(True, frame) for pair in segments for frame in pair])
    assert all(text.endswith("segment of device_status") for _, text in found[:-2])
    assert found[-2][1].startswith("4→1 device_status mode=boot")
    assert found[-1][1].startswith("4→253 device_status mode=boot")


def test_requests_on_can_and_junk_are_distinguished():
    (frame,) = encode_request_frames(Request.of(STATUS.id), 1, 4)
    trace = lines(
        [(False, frame), (False, CanFrame(0x1FFFFFFF, b"\x01")), (True, CanFrame(0x05EE0401, bytes(3)))]
    )
    assert trace[0] == ("telemetry", "1→4 device_status?")
    assert trace[1][0] == "fault"
    assert trace[2] == ("reply", "4→1 id 238")


@pytest.mark.parametrize(
    ("can_id", "text"),
    [
        (0x000, "NMT command"), (0x080, "SYNC"), (0x0AC, "node 44 EMCY"), (0x1AC, "node 44 TPDO 1"),
        (0x22C, "node 44 RPDO 1"), (0x2AC, "node 44 TPDO 2"), (0x32C, "node 44 RPDO 2"), (0x3AC, "node 44 TPDO 3"),
        (0x42C, "node 44 RPDO 3"), (0x4AC, "node 44 TPDO 4"), (0x52C, "node 44 RPDO 4"), (0x7E4, "LSS reply"),
        (0x5AC, "node 44 SDO reply"), (0x62C, "node 44 SDO request"), (0x72C, "node 44 heartbeat"), (0x7E5, "LSS request"),
        (0x101, "COB-ID 101"),
    ],
)  # fmt: skip
def test_frames_of_canopen_are_named_by_their_function(can_id, text):
    assert canopen_text(CanFrame(can_id, extended=False)) == text


def test_traffic_of_the_line_of_the_console_is_marked_as_its_own():
    found = Decoder(ICD, lambda: Dialect.B).line(
        WireItem(0.0, "console", outgoing=False, item=CUBESPACE.encode_request(Request.of(STATUS.id)))
    )
    assert (found["own"], found["text"]) == (True, "device_status?")


def test_each_of_two_serial_lines_reports_what_arrives():
    links = [
        SimpleNamespace(bus="serial", wire=SimpleNamespace(), transport=MemorySerial(name, lambda: 0.0))
        for name in ("one", "two")
    ]
    traffic, passed = Traffic(), []
    traffic.passed.connect(passed.append)
    for link in links:
        traffic.add(link)
        link.transport.listener(link.transport.description.encode())
    assert [entry.item for entry in passed] == [b"one", b"two"]


def test_a_bus_with_two_links_reports_what_arrives_once_and_nothing_without_an_observer():
    links = [
        SimpleNamespace(bus="can", wire=SimpleNamespace(), transport=SimpleNamespace(listener=None))
        for _ in range(2)
    ]
    traffic, passed = Traffic(), []
    for link in links:
        traffic.add(link)
    links[0].transport.listener("lost")
    traffic.passed.connect(passed.append)
    assert links[1].transport.listener is None
    links[0].transport.listener("in")
    for link in links:
        link.wire.listener("out")
    assert [(entry.bus, entry.outgoing, entry.item) for entry in passed] == [
        ("can", False, "in"),
        ("can", True, "out"),
        ("can", True, "out"),
    ]
