"""CANopen frames as a trace shows them: objects by index, name and value."""

import pytest

from starhil.emulator.links.canopen_trace import CanopenDecoder
from starhil.protocol.can.frame import CanFrame
from starhil.protocol.canopen.device_dictionary import DeviceDictionary
from starhil.protocol.unit import load_unit


@pytest.fixture(scope="module")
def objects():
    return DeviceDictionary(load_unit())


@pytest.fixture
def decoder(objects):
    return CanopenDecoder(objects)


def line(decoder, can_id, data):
    return decoder.line(CanFrame(can_id, bytes.fromhex(data), extended=False))


FRAMES = {
    (0x000, "012C"): ("canopen", "NMT start, node 44"),
    (0x000, "8000"): ("canopen", "NMT pre-operational, node all"),
    (0x000, "FF05"): ("canopen", "NMT 255, node 5"),
    (0x000, "01"): ("canopen", "COB-ID 000"),
    (0x080, ""): ("canopen", "SYNC"),
    (0x0AC, "3081010000000000"): ("fault", "node 44 EMCY 8130h, register 01h"),
    (0x0AC, "308101"): ("canopen", "COB-ID 0AC"),
    (0x100, "0011"): ("canopen", "TIME"),
    (0x72C, "00"): ("canopen", "node 44 heartbeat: boot-up"),
    (0x72C, "85"): ("canopen", "node 44 heartbeat: operational"),  # with the toggle bit of node guarding
    (0x72C, "09"): ("canopen", "node 44 heartbeat: 9"),
    (0x72C, "0500"): ("canopen", "COB-ID 72C"),
    (0x7E4, "00"): ("canopen", "LSS reply"),
    (0x7E5, "00"): ("canopen", "LSS request"),
    (0x62C, "4018100100000000"): ("telemetry", "node 44 read 1018h:01h Identity object.Vendor-ID"),
    (0x62C, "40FFFF0100000000"): ("telemetry", "node 44 read FFFFh:01h"),
    (0x5AC, "4318100178563412"): ("reply", f"node 44 1018h:01h Identity object.Vendor-ID = {0x12345678}"),
    (0x5AC, "4200100078563412"): ("reply", f"node 44 1000h Device type = {0x12345678}"),  # of no stated size
    (0x5AC, "4B17100011220000"): ("reply", f"node 44 1017h Producer heartbeat time = {0x2211}"),
    (0x5AC, "4BFFFF0011220000"): ("reply", "node 44 FFFFh = 11 22"),
    (0x62C, "2B171000E8030000"): ("telecommand", "node 44 write 1017h Producer heartbeat time = 1000"),
    (0x5AC, "6017100000000000"): ("ack", "node 44 written 1017h Producer heartbeat time"),
    (0x5AC, "4108100009000000"): ("part", "node 44 1008h Manufacturer device name follows in segments"),
    (0x62C, "6000000000000000"): ("part", "node 44 SDO: next segment"),
    (0x5AC, "2000000000000000"): ("part", "node 44 SDO: segment received"),
    (0x5AC, "0061626364656667"): ("part", "node 44 SDO segment"),  # of a transfer whose begin was not seen
    (0x62C, "C008100000000000"): ("part", "node 44 SDO block transfer"),
    (0x5AC, "C008100000000000"): ("part", "node 44 SDO block transfer"),
    (0x5AC, "00"): ("canopen", "COB-ID 5AC"),
    (0x22C, "01"): ("canopen", "node 44 RPDO 1 Mode=standby"),
    (0x32C, "01"): ("canopen", "node 44 RPDO 2"),  # maps nothing
    (0x1AC, "0102010F0201"): (
        "canopen",
        (
            "node 44 TPDO 1 mode=standby error=parameter_store reset_cause=power_on "
            "time_set parameters_changed attitude_valid image_stored store_fault=15 boot_count=258"
        ),
    ),
    (0x2AC, "0102"): ("canopen", "node 44 TPDO 2 sequence=1 flags=2"),  # the rest is missing
    (0x3AC, "01"): ("canopen", "node 44 TPDO 3 sequence=1"),
    (0x52C, "01"): ("canopen", "node 44 RPDO 4"),
}
"""Identifier and data → kind and text (CiA 301, 7.2 and 7.3)."""


@pytest.mark.parametrize("frame", FRAMES, ids=lambda frame: f"{frame[0]:03X}#{frame[1]}")
def test_a_frame_is_shown_with_its_object_and_value(decoder, frame):
    assert line(decoder, *frame) == FRAMES[frame]


@pytest.mark.parametrize("can_id", [0x62C, 0x5AC])
def test_an_abort_is_shown_with_its_code(decoder, can_id):
    kind, text = line(decoder, can_id, "8017100030000906")
    assert kind == "nack"
    assert ": 0x06090030" in text


def test_the_segments_of_each_node_are_joined(decoder):
    for node in (44, 45):
        line(decoder, 0x600 + node, "4008100000000000")
    for first, node in (("61", 44), ("41", 45)):
        assert line(decoder, 0x580 + node, f"00{first}626364656667")[0] == "part"
    texts = [line(decoder, 0x580 + node, "0B68690000000000") for node in (44, 45)]
    assert texts == [
        ("reply", "node 44 1008h Manufacturer device name = abcdefghi"),
        ("reply", "node 45 1008h Manufacturer device name = Abcdefghi"),
    ]
    assert line(decoder, 0x5AC, "0B68690000000000")[0] == "part", "the transfer has ended"


def test_what_a_client_writes_in_segments_is_joined(decoder):
    begin = line(decoder, 0x62C, "2108100009000000")
    assert begin == ("telecommand", "node 44 write 1008h Manufacturer device name in segments")
    line(decoder, 0x62C, "0061626364656667")
    end = line(decoder, 0x62C, "1B68690000000000")
    assert end == ("telecommand", "node 44 write 1008h Manufacturer device name = abcdefghi")


def test_of_a_long_value_the_begin_is_shown(decoder, objects):
    """The EDS, 1021h, is a domain."""
    line(decoder, 0x62C, "4021100000000000")
    for _ in range(2):
        line(decoder, 0x5AC, "0001020304050607")
    text = line(decoder, 0x5AC, "0901020300000000")[1]
    shown = "01 02 03 04 05 06 07 01 02 03 04 05 06 07 01 02"
    assert text == f"node 44 1021h {objects.find(0x1021, 0).variable.qualname} = {shown} …"
