"""Another CANopen slave, durand, given the same frames: where both follow CiA 301 they answer alike."""

from __future__ import annotations

import pytest
from durand.datatypes import DatatypeEnum
from durand.network import NetworkABC
from durand.node import MinimalNode
from durand.object_dictionary import Record, Variable

pytestmark = pytest.mark.long

NODE = 0x2C
PIXELS = bytes(number * 5 & 0xFF for number in range(1000))


class Wire(NetworkABC):
    """Hands frames to durand and collects what it sends."""

    def __init__(self) -> None:
        self.callbacks = {}
        self.sent = []

    def add_subscription(self, cob_id, callback):
        self.callbacks[cob_id] = callback

    def remove_subscription(self, cob_id):
        self.callbacks.pop(cob_id)

    def send(self, cob_id, msg):
        self.sent.append((cob_id, bytes(msg)))

    def frame(self, identifier, data):
        self.sent = []
        if identifier in self.callbacks:
            self.callbacks[identifier](identifier, data)
        return self.sent


@pytest.fixture
def other():
    wire = Wire()
    node = MinimalNode(wire, NODE)
    od = node.object_dictionary
    od[0x1018][2].value = 0x53544152
    od[0x1018][3].value = 0x10000
    od[0x1018][4].value = 1
    record = Record(name="Frame")
    record[1] = Variable(DatatypeEnum.DOMAIN, "ro", name="pixels", value=PIXELS)
    od[0x6040] = record
    od[0x6060] = Variable(DatatypeEnum.REAL32, "wo", minimum=0.1, maximum=20.0, name="rate")
    parameters = Record(name="Parameters")
    parameters[1] = Variable(
        DatatypeEnum.UNSIGNED16, "rw", minimum=1, maximum=5000, value=100, name="exposure"
    )
    od[0x6020] = parameters
    return wire


SDO_SEQUENCES = {
    "device type": ["40 00 10 00"],
    "identity": ["40 18 10 01", "40 18 10 02", "40 18 10 03", "40 18 10 04"],
    "no object": ["40 00 0f 00", "23 00 50 00 01"],
    "no sub-index": ["40 18 10 09"],
    "read-only": ["23 00 10 00 01"],
    "write-only": ["40 60 60 00"],
    "range": ["2b 20 60 01 00 00", "2b 20 60 01 89 13", "2b 20 60 01 c8 00", "40 20 60 01"],
    "no transfer": ["60", "01", "e0"],
    "segmented upload": ["40 40 60 01", "60", "70", "60", "60"],
    "abort by the client": ["40 40 60 01", "80 40 60 01 00 00 04 05", "60"],
    "block upload": ["a4 40 60 01 03 00", "a3", "a2 03 7f", "a2 01 7f", "80 40 60 01 00 00 04 05"],
    "block size": ["a4 40 60 01 00 00", "a4 40 60 01 80 00"],
    "block upload to the end": ["a4 40 60 01 7f 00", "a3", "a2 7f 7f", "a2 10 7f", "a1"],
}


@pytest.mark.parametrize("name", SDO_SEQUENCES)
def test_same_answers_to_sdo_requests(bench, other, name):
    bench.show(PIXELS)
    for request in SDO_SEQUENCES[name]:
        data = bytes.fromhex(request).ljust(8, b"\0")
        assert bench.frame(0x600 + NODE, data) == other.frame(0x600 + NODE, data), request


# Without "identify remote slave": durand answers it by 47h, CiA 305 and other stacks by 4Fh.
LSS_SEQUENCES = {
    "global": ["04 01", "5e", "5a", "5b", "5c", "5d", "04 00", "5e"],
    "selective": ["40", "41 52 41 54 53", "42 00 00 01 00", "43 01", "5e"],
    "wrong serial number": ["40", "41 52 41 54 53", "42 00 00 01 00", "43 02", "5e"],
    "node-ID": ["04 01", "11 21", "11 80"],
    "configured node and fastscan": ["51 00 00 00 00 80 00 00", "4c"],
}


@pytest.mark.parametrize("name", LSS_SEQUENCES)
def test_same_answers_to_lss_requests(bench, other, name):
    for request in LSS_SEQUENCES[name]:
        data = bytes.fromhex(request).ljust(8, b"\0")
        assert bench.frame(0x7E5, data) == other.frame(0x7E5, data), request


@pytest.mark.parametrize("command", [1, 2, 128, 129, 130])
def test_same_answers_to_nmt_commands(bench, other, command):
    for data in (bytes([command, NODE]), bytes([command, 0]), bytes([command, 5]), bytes([command])):
        ours = [frame for frame in bench.frame(0, data) if frame[0] not in {0x1AC, 0x2AC, 0x3AC, 0x4AC}]
        assert ours == other.frame(0, data)
