"""SYNC and TIME: consumer, producer, counter, time of day."""

from __future__ import annotations

import datetime as dt

import pytest

from starhil.protocol.canopen.abort import AbortCode
from starhil.protocol.canopen.timestamp import decode_time_of_day


def test_producer_sends_at_its_period_and_acts_on_its_own_sync(bench):
    bench.write(0x1017, 0, 0, 2)
    assert bench.write(0x1006, 0, 20_000) == 0
    assert bench.advance(0.1) == []
    assert bench.write(0x1005, 0, 0x4000_0080) == 0
    start = bench.now
    assert bench.advance(0.05) == [
        (pytest.approx(start + 0.02), 0x80, b""),
        (pytest.approx(start + 0.04), 0x80, b""),
    ]
    bench.write(0x1800, 1, 0xC000_01AC)
    bench.write(0x1800, 2, 1, 1)
    bench.write(0x1800, 1, 0x4000_01AC)
    bench.operational()
    assert [identifier for _, identifier, _ in bench.advance(0.02)] == [0x80, 0x1AC]


def test_the_counter_wraps_at_its_overflow_and_restarts_after_stopped(bench):
    bench.write(0x1017, 0, 0, 2)
    assert bench.write(0x1019, 0, 3, 1) == 0
    bench.write(0x1006, 0, 10_000)
    bench.write(0x1005, 0, 0x4000_0080)
    assert [data[0] for _, _, data in bench.advance(0.051)] == [1, 2, 3, 1, 2]
    bench.nmt(2)
    assert bench.advance(0.02) == []
    bench.nmt(128)
    assert [data[0] for _, _, data in bench.advance(0.02)] == [1, 2]


@pytest.mark.parametrize("value", [1, 241, 255])
def test_invalid_counter_overflow(bench, value):
    assert bench.write(0x1019, 0, value, 1) == AbortCode.VALUE_RANGE


def test_counter_overflow_is_fixed_while_a_period_is_set(bench):
    bench.write(0x1006, 0, 1000)
    assert bench.write(0x1019, 0, 10, 1) == AbortCode.DEVICE_STATE
    bench.write(0x1006, 0, 0)
    assert bench.write(0x1019, 0, 10, 1) == 0


@pytest.mark.parametrize(("overflow", "good", "bad"), [(0, "", "01"), (10, "01", "")])
def test_sync_of_wrong_length_is_an_error_until_a_right_one(bench, overflow, good, bad):
    bench.write(0x1019, 0, overflow, 1)
    assert bench.frame(0x80, good) == []
    ((identifier, data),) = bench.frame(0x80, bad)
    assert (identifier, data[:3]) == (0xAC, bytes.fromhex("4082 11"))
    assert bench.frame(0x80, bad) == []
    assert bench.frame(0x80, good)[0][1][:3] == bytes(3)


@pytest.mark.parametrize("cob_id", [0x2000_0080, 0x0, 0x7F, 0x601, 0x801, 0x101, 0x180, 0x701])
def test_invalid_sync_can_id(bench, cob_id):
    assert bench.write(0x1005, 0, cob_id) == AbortCode.VALUE_RANGE


def test_sync_can_id_is_fixed_while_producing(bench):
    assert bench.write(0x1005, 0, 0x90) == 0
    assert bench.write(0x1005, 0, 0x4000_0090) == 0
    assert bench.write(0x1005, 0, 0x4000_0080) == AbortCode.VALUE_RANGE
    assert bench.write(0x1005, 0, 0x80) == 0


# TIME

NOON = dt.datetime(2026, 3, 1, 12, 0, 0, 250_000, tzinfo=dt.UTC)
NOON_DATA = (43_200_250).to_bytes(4, "little") + (15_400).to_bytes(2, "little")


def test_days_since_1984():
    assert (NOON.date() - dt.date(1984, 1, 1)).days == 15_400


def test_time_of_day_both_ways():
    assert decode_time_of_day(NOON_DATA) == NOON.timestamp()


@pytest.mark.parametrize(
    "data", [b"", NOON_DATA[:5], NOON_DATA + b"\0", (86_400_000).to_bytes(4, "little") + b"\0\0"]
)
def test_an_invalid_time_of_day_is_ignored(bench, data):
    bench.events()
    assert decode_time_of_day(data) is None
    bench.frame(0x100, data)
    assert bench.events() == []


def test_upper_bits_of_the_milliseconds_do_not_count():
    assert (
        decode_time_of_day(bytes([*NOON_DATA[:3], NOON_DATA[3] | 0xF0, *NOON_DATA[4:]])) == NOON.timestamp()
    )


@pytest.mark.parametrize(("command", "heard"), [(1, True), (128, True), (2, False)])
def test_time_is_an_event_except_in_stopped(bench, command, heard):
    bench.nmt(command)
    bench.events()
    bench.frame(0x100, NOON_DATA)
    assert bench.events() == ([("time", NOON.timestamp())] if heard else [])


def test_time_can_id_can_be_changed_and_time_disabled(bench):
    assert bench.write(0x1012, 0, 0x8000_0090) == AbortCode.VALUE_RANGE
    assert bench.write(0x1012, 0, 0x100) == 0
    bench.events()
    bench.frame(0x100, NOON_DATA)
    assert bench.events() == []
    assert bench.write(0x1012, 0, 0x8000_0090) == 0
    bench.frame(0x90, NOON_DATA)
    assert bench.events() == [("time", NOON.timestamp())]


def test_time_is_not_produced(bench):
    assert bench.write(0x1012, 0, 0xC000_0100) == AbortCode.VALUE_RANGE


def test_high_resolution_time_stamp_advances_and_can_be_set(bench):
    assert bench.write(0x1013, 0, 5) == 0
    bench.now += 0.25
    assert bench.number(0x1013) == 250_005
