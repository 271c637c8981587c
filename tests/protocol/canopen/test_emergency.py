"""EMCY: error register, history, COB-ID, inhibit time, states."""

from __future__ import annotations

import pytest

from starhil.protocol.canopen.abort import AbortCode
from starhil.protocol.canopen.emergency import ErrorRegister

pytestmark = pytest.mark.lowest("construct")

CODE = 0xFF01


def raise_error(bench, code=CODE, bits=ErrorRegister.MANUFACTURER, data=b"\x0a\x0b", key=b""):
    frames = bench.slave.raise_emergency(code, bits, data, now=bench.now, key=key)
    return [(frame.id, frame.data.hex()) for frame in frames]


def clear_error(bench, code=CODE, key=b""):
    return [
        (frame.id, frame.data.hex()) for frame in bench.slave.clear_emergency(code, now=bench.now, key=key)
    ]


def test_error_is_reported_and_reset(bench):
    assert raise_error(bench) == [(0xAC, "01ff810a0b000000")]
    assert bench.number(0x1001) == 0x81
    assert raise_error(bench) == []
    assert clear_error(bench) == [(0xAC, "00000001ff000000")]
    assert bench.number(0x1001) == 0
    assert clear_error(bench) == []


def test_the_error_register_holds_the_bits_of_the_remaining_errors(bench):
    raise_error(bench, 0x4210, ErrorRegister.TEMPERATURE)
    raise_error(bench, 0x3110, ErrorRegister.VOLTAGE)
    assert bench.number(0x1001) == 0x0D
    assert clear_error(bench, 0x3110)[0][1].startswith("000009")
    raise_error(bench, 0x4210, ErrorRegister.TEMPERATURE, key=b"second")
    clear_error(bench, 0x4210)
    assert bench.number(0x1001) == 0x09


def test_history_is_newest_first_and_bounded(bench):
    for number in range(10):
        raise_error(bench, 0xFF00 + number, data=bytes([number, 0x20]))
    assert bench.number(0x1003, 0) == 8
    assert bench.number(0x1003, 1) == 0x2009_FF09
    assert bench.number(0x1003, 8) == 0x2002_FF02
    clear_error(bench, 0xFF09)
    assert bench.number(0x1003, 1) == 0x2009_FF09
    assert bench.write(0x1003, 0, 0, 1) == 0
    assert bench.number(0x1003, 0) == 0
    assert bench.sdo("40 03 10 01") == "80031001" + AbortCode.NO_DATA.to_bytes(4, "little").hex()
    assert bench.write(0x1003, 0, 3, 1) == AbortCode.VALUE_RANGE


def test_inhibit_time_spaces_messages(bench):
    bench.write(0x1017, 0, 0, 2)
    assert bench.write(0x1015, 0, 200, 2) == 0  # 20 ms
    start = bench.now
    assert len(raise_error(bench, 0xFF00)) == 1
    assert raise_error(bench, 0xFF01) == []
    assert clear_error(bench, 0xFF00) == []
    assert [(round(time - start, 6), data[:2].hex()) for time, _, data in bench.advance(0.1)] == [
        (0.02, "01ff"),
        (0.04, "0000"),
    ]


def test_switched_off_by_bit_31(bench):
    assert bench.write(0x1014, 0, 0x8000_00AC) == 0
    assert raise_error(bench) == []
    assert bench.number(0x1003, 0) == 1


def test_can_id_changes_only_while_disabled(bench):
    assert bench.write(0x1014, 0, 0x91) == AbortCode.VALUE_RANGE
    assert bench.write(0x1014, 0, 0x8000_00AC) == 0
    assert bench.write(0x1014, 0, 0x701) == AbortCode.VALUE_RANGE
    assert bench.write(0x1014, 0, 0x2000_0091) == AbortCode.VALUE_RANGE
    assert bench.write(0x1014, 0, 0x91) == 0
    assert raise_error(bench)[0][0] == 0x91


def test_nothing_is_sent_in_stopped_and_everything_afterwards(bench):
    bench.nmt(2)
    assert raise_error(bench) == []
    assert [(identifier, data[:2].hex()) for identifier, data in bench.nmt(128)] == [(0xAC, "01ff")]


def test_a_node_reset_clears_all_errors_and_a_communication_reset_its_own(bench):
    raise_error(bench)
    bench.frame(0x80, "01")
    assert bench.number(0x1001) == 0x91
    bench.nmt(130)
    assert bench.number(0x1001) == 0x81
    assert bench.number(0x1003, 0) == 2
    bench.nmt(129)
    assert bench.number(0x1001) == 0
    assert bench.number(0x1003, 0) == 0


@pytest.mark.parametrize("data", [b"", b"12345", b"1234567890"])
def test_five_manufacturer_bytes(bench, data):
    ((_, message),) = raise_error(bench, data=data)
    assert bytes.fromhex(message)[3:] == data[:5].ljust(5, b"\0")
