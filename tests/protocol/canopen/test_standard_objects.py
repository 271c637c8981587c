"""Values and codes of CiA 301, and services at the edges of their node IDs, sizes and instants."""

from __future__ import annotations

from dataclasses import replace

import canopen
import pytest

from starhil.protocol.canopen.abort import AbortCode
from starhil.protocol.canopen.device_dictionary import DeviceDictionary
from starhil.protocol.canopen.eds import build_eds
from starhil.protocol.errors import IcdError
from starhil.protocol.icd.canopen_schema import CanopenModel
from starhil.protocol.unit import load_unit

EMCY = 0xAC


def test_abort_codes_are_those_that_another_library_knows():
    assert {int(code) for code in AbortCode} <= set(canopen.SdoAbortedError.CODES)


def test_the_format_of_stored_files_is_0(bench):
    assert bench.read(0x1022) == b"\0"


def test_each_heartbeat_consumer_has_an_entry(bench):
    count = bench.number(0x1016)
    assert count > 1
    assert [bench.number(0x1016, number) for number in range(1, count + 1)] == [0] * count
    with pytest.raises(canopen.SdoAbortedError):
        bench.read(0x1016, count + 1)


@pytest.mark.parametrize("node", [1, 127])
def test_nodes_at_both_ends_of_the_range_are_watched(bench, node):
    assert bench.write(0x1016, 1, node << 16 | 100) == 0
    bench.write(0x1017, 0, 0, 2)
    bench.frame(0x700 + node, "05")
    assert [(identifier, data[:2].hex()) for _, identifier, data in bench.advance(1.0)] == [(EMCY, "3081")]


def test_a_remote_frame_is_not_a_heartbeat(bench):
    assert bench.write(0x1016, 1, 5 << 16 | 100) == 0
    bench.write(0x1017, 0, 0, 2)
    bench.frame(0x705, remote=True)
    assert bench.advance(1.0) == []


def test_an_emergency_is_reported_as_an_event_and_stored_with_its_first_two_bytes(bench):
    bench.events()
    bench.slave.raise_emergency(0xFF01, 0x80, bytes.fromhex("1122334455"), now=bench.now)
    assert ("emergency", 0xFF01) in bench.events()
    assert bench.number(0x1003, 1) == 0x2211_FF01


def test_the_inhibit_time_of_emergencies_begins_at_the_instant_of_the_error(bench):
    bench.write(0x1017, 0, 0, 2)
    assert bench.write(0x1015, 0, 200, 2) == 0  # 20 ms
    bench.now += 5.0  # without a frame or a deadline in between
    begin = bench.now
    for code in (0xFF00, 0xFF01):
        bench.slave.raise_emergency(code, 0x80, now=bench.now)
    assert [round(time - begin, 6) for time, _, _ in bench.advance(0.1)] == [0.02]


def test_a_record_that_sets_a_telecommand_must_report_it():
    icd = load_unit("cubestar")
    record = {"index": 0x6000, "name": "x", "telemetry": "card_progress", "telecommand": "select_parameter"}
    layout = icd.canopen.model_dump(by_alias=True) | {"object": [record], "tpdo": [], "rpdo": []}
    assert icd.telemetry["card_progress"].size == icd.telecommands["select_parameter"].size
    with pytest.raises(IcdError, match="card_progress must include select_parameter alone"):
        DeviceDictionary(replace(icd, canopen=CanopenModel.model_validate(layout)))


def test_a_scaled_entry_is_described_in_the_eds():
    eds = build_eds(DeviceDictionary(load_unit("cubestar")))
    assert "[raw * 0.001 deg/s]" in eds
    assert "raw * 1 " not in eds
