"""The traffic that a trace keeps, and saves."""

import json
import struct

from starhil.emulator.console.pcapng import pcapng
from starhil.emulator.console.trace import DECODED_LINES, WireTrace
from starhil.emulator.links.traffic import Decoder, Traffic, WireItem
from starhil.protocol.can.frame import CanFrame
from starhil.protocol.unit import load_unit


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
