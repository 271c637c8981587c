"""Decoding of the traffic trace."""

import json
import struct

import pytest

from starhil.emulator.console.pcapng import pcapng
from starhil.emulator.console.trace import DECODED_LINES, WireTrace
from starhil.emulator.links.traffic import Decoder, Traffic, WireItem, canopen_text
from starhil.protocol.can.cubespace import encode_reply_frames, encode_request_frames
from starhil.protocol.can.frame import CanFrame
from starhil.protocol.canopen.device_dictionary import DeviceDictionary
from starhil.protocol.messages import ErrorCode, Reply, ReplyKind, Request
from starhil.protocol.serial.cubespace import Dialect
from starhil.protocol.unit import load_unit
from tests.protocol.serial.composed_links import CUBESPACE

pytestmark = pytest.mark.long

ICD = load_unit()
MODE = ICD.telecommands["set_mode"]
STATUS = ICD.telemetry["device_status"]


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
        (0x5AC, "node 44 SDO reply"), (0x62C, "node 44 SDO request"), (0x72C, "node 44 heartbeat"), (0x7E5, "LSS request"),
        (0x101, "COB-ID 101"),
    ],
)  # fmt: skip
def test_frames_of_canopen_are_named_by_their_function(can_id, text):
    assert canopen_text(CanFrame(can_id, extended=False)) == text


def test_the_latest_items_are_decoded_once_however_many_pages_ask(monkeypatch):
    decoded = []
    line = Decoder.line

    def noted(self, entry):
        decoded.append(entry)
        return line(self, entry)

    monkeypatch.setattr(Decoder, "line", noted)
    traffic = Traffic()
    trace = WireTrace(load_unit(), traffic, lambda: None, str)

    def pass_by(count):
        for _ in range(count):
            traffic.passed.emit(WireItem(0.0, "serial", outgoing=False, item=bytes.fromhex("1F7FE61FFF")))

    def numbers(start):
        while trace.decode():
            pass
        return [json.loads(text)["n"] for text in trace.texts(range(start, trace.end))]

    pass_by(2)
    assert numbers(0) == [0, 1]
    pass_by(3)
    for _ in range(10):
        assert numbers(0) == [0, 1, 2, 3, 4]
        assert numbers(3) == [3, 4]
    assert len(decoded) == 5
    pass_by(3 * DECODED_LINES)
    for _ in range(10):
        assert numbers(0) == list(range(5 + 2 * DECODED_LINES, 5 + 3 * DECODED_LINES))
    assert len(decoded) == 5 + DECODED_LINES


def test_frames_of_canopen_have_index_name_and_value():
    objects = DeviceDictionary(ICD)
    decoder = Decoder(ICD, lambda: None, objects)

    def line(can_id, data, outgoing=False):
        frame = CanFrame(can_id, bytes.fromhex(data), extended=False)
        found = decoder.line(WireItem(0.0, "can", outgoing, frame))
        return found["kind"], found["text"]

    assert line(0x62C, "4018100100000000") == (
        "telemetry",
        "node 44 read 1018h:01h Identity object.Vendor-ID",
    )
    kind, text = line(0x5AC, "4318100178563412", outgoing=True)
    assert (kind, text) == ("reply", f"node 44 1018h:01h Identity object.Vendor-ID = {0x12345678}")
    assert line(0x62C, "2B171000E8030000") == (
        "telecommand",
        "node 44 write 1017h Producer heartbeat time = 1000",
    )
    assert line(0x5AC, "6017100000000000") == ("ack", "node 44 written 1017h Producer heartbeat time")
    kind, text = line(0x5AC, "8017100030000906")
    assert kind == "nack"
    assert "refused: 0x06090030" in text
    assert line(0x5AC, "4108100009000000")[1].endswith("follows in segments")
    line(0x62C, "4008100000000000")
    assert line(0x5AC, "00") == ("canopen", "COB-ID 5AC")
    assert line(0x5AC, "0061626364656667")[0] == "part"
    kind, text = line(0x5AC, "0B68690000000000")
    assert (kind, text.rpartition(" = ")[2]) == ("reply", "abcdefghi"[:9])
    assert line(0x72C, "05") == ("canopen", "node 44 heartbeat: operational")
    assert line(0x000, "012C") == ("canopen", "NMT start, node 44")
    assert line(0x0AC, "3081010000000000") == ("fault", "node 44 EMCY 8130h, register 01h")
    assert "TPDO 1 " in line(0x1AC, "0000000000000000", outgoing=True)[1]


def test_traffic_of_the_line_of_the_console_is_marked_as_its_own():
    found = Decoder(ICD, lambda: Dialect.B).line(
        WireItem(0.0, "console", outgoing=False, item=CUBESPACE.encode_request(Request.of(STATUS.id)))
    )
    assert (found["own"], found["text"]) == (True, "device_status?")


def test_traffic_is_saved_as_pcapng(tmp_path):
    items = [
        WireItem(1.5, "can", outgoing=True, item=CanFrame(0x123, b"\x01\x02", extended=False)),
        WireItem(2.5, "serial", outgoing=False, item=b"\x1f\x7f"),
    ]
    data = pcapng(items)
    blocks, at = [], 0
    while at < len(data):
        kind, size = struct.unpack_from("<II", data, at)
        assert struct.unpack_from("<I", data, at + size - 4) == (size,)
        blocks.append(kind)
        at += size
    assert blocks == [0x0A0D0D0A, 1, 6, 1, 6]
    assert struct.pack(">IB3x", 0x123, 2) + b"\x01\x02" in data
