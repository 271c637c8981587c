"""LSS slave: switch mode, node ID, bit timing, store, identity, identify, fastscan (CiA 305)."""

from __future__ import annotations

import random
from unittest.mock import Mock

import pytest

from starhil.protocol.canopen.context import UNCONFIGURED_NODE, NmtState
from starhil.protocol.canopen.storage import ParameterStorage, StorageError

VENDOR, PRODUCT, REVISION, SERIAL = 0, 0x53544152, 0x10000, 1
IDENTITY = (VENDOR, PRODUCT, REVISION, SERIAL)


def lss(bench, data: str | bytes) -> list[str]:
    data = bytes.fromhex(data) if isinstance(data, str) else data
    answers = bench.frame(0x7E5, data.ljust(8, b"\0"))
    return [data.hex() for identifier, data in answers if identifier == 0x7E4]


def select(bench, identity=IDENTITY) -> list[str]:
    return [
        answer
        for step, number in enumerate(identity)
        for answer in lss(bench, bytes([0x40 + step]) + number.to_bytes(4, "little"))
    ]


def configuring(bench) -> bool:
    return lss(bench, "5e") != []


@pytest.fixture
def unconfigured(new_bench):
    return new_bench(255).power_on()


def test_unconfigured_node_answers_only_lss(unconfigured):
    assert unconfigured.sent == []
    assert unconfigured.slave.state is NmtState.INITIALISING
    assert unconfigured.frame(0, "0100") == []
    assert unconfigured.slave.next_deadline() is None
    assert lss(unconfigured, "4c") == ["5000000000000000"]


def test_unconfigured_node_boots_with_its_new_id(unconfigured):
    assert lss(unconfigured, "04 01") == []
    assert lss(unconfigured, "5e") == ["5eff000000000000"]
    assert lss(unconfigured, "11 21") == ["1100000000000000"]
    assert unconfigured.frame(0x7E5, "0400000000000000") == [(0x721, b"\0")]
    assert unconfigured.slave.state is NmtState.PRE_OPERATIONAL
    assert unconfigured.frame(0x621, "4005100000000000")[0][0] == 0x5A1
    assert lss(unconfigured, "4c") == []


def test_configured_node_takes_its_new_id_at_the_reset(bench):
    lss(bench, "04 01")
    assert lss(bench, "11 21") == ["1100000000000000"]
    lss(bench, "04 00")
    assert bench.slave.node_id == 0x2C
    assert bench.nmt(130) == [(0x721, b"\0")]
    assert bench.frame(0x621, "4014100000000000") == [(0x5A1, bytes.fromhex("43141000a1000000"))]
    assert bench.frame(0x62C, "4014100000000000") == []


def test_node_id_is_cleared_at_the_reset(bench):
    lss(bench, "04 01")
    assert lss(bench, "11 ff") == ["1100000000000000"]
    lss(bench, "04 00")
    assert bench.nmt(130) == []
    assert bench.slave.state is NmtState.INITIALISING
    assert lss(bench, "4c") == ["5000000000000000"]


@pytest.mark.parametrize("node_id", [1, 127])
def test_first_and_last_node_id(bench, node_id):
    lss(bench, "04 01")
    assert lss(bench, bytes([0x11, node_id])) == ["1100000000000000"]


@pytest.mark.parametrize("node_id", [0, 128, 200, 254])
def test_node_id_out_of_range(bench, node_id):
    lss(bench, "04 01")
    assert lss(bench, bytes([0x11, node_id])) == ["1101000000000000"]


@pytest.mark.parametrize("request_", ["11 05", "13 00 02", "17", "5a", "5b", "5c", "5d", "5e"])
def test_waiting_node_ignores_configuration_commands(bench, request_):
    assert lss(bench, request_) == []
    lss(bench, "04 01")
    assert len(lss(bench, request_)) == 1
    lss(bench, "04 00")
    assert lss(bench, request_) == []


def test_switch_selective(bench):
    assert select(bench) == ["4400000000000000"]
    assert configuring(bench)


@pytest.mark.parametrize("wrong", range(4))
def test_switch_selective_by_another_identity(bench, wrong):
    identity = list(IDENTITY)
    identity[wrong] ^= 0x100
    assert select(bench, identity) == []
    assert not configuring(bench)


def test_switch_selective_out_of_order(bench):
    for step in (0, 2, 1, 3):
        assert lss(bench, bytes([0x40 + step]) + IDENTITY[step].to_bytes(4, "little")) == []
    assert not configuring(bench)


@pytest.mark.parametrize(("command", "number"), list(enumerate(IDENTITY, 0x5A)))
def test_inquire_identity(bench, command, number):
    lss(bench, "04 01")
    assert lss(bench, bytes([command])) == [
        (bytes([command]) + number.to_bytes(4, "little") + bytes(3)).hex()
    ]


@pytest.mark.parametrize(
    ("ranges", "is_answered"),
    [
        ((VENDOR, PRODUCT, REVISION, REVISION, SERIAL, SERIAL), True),
        ((VENDOR, PRODUCT, 0, 0xFFFFFFFF, 0, 0xFFFFFFFF), True),
        ((VENDOR, PRODUCT, REVISION + 1, 0xFFFFFFFF, 0, 0xFFFFFFFF), False),
        ((VENDOR, PRODUCT, 0, 0xFFFFFFFF, 0, 0), False),
        ((VENDOR, PRODUCT + 1, 0, 0xFFFFFFFF, 0, 0xFFFFFFFF), False),
        ((VENDOR + 1, PRODUCT, 0, 0xFFFFFFFF, 0, 0xFFFFFFFF), False),
    ],
)
def test_identify_remote_slave(bench, ranges, is_answered):
    answers = [
        answer
        for step, number in enumerate(ranges)
        for answer in lss(bench, bytes([0x46 + step]) + number.to_bytes(4, "little"))
    ]
    assert answers == (["4f00000000000000"] if is_answered else [])


@pytest.mark.parametrize(
    ("index", "status"), [(0, 0), (2, 0), (3, 0), (4, 0), (8, 0), (5, 1), (9, 1), (255, 1)]
)
def test_bit_timing(bench, index, status):
    lss(bench, "04 01")
    assert lss(bench, bytes([0x13, 0, index])) == [f"13{status:02x}000000000000"]


def test_other_bit_timing_tables_and_rates_that_are_not_allowed(new_bench):
    bench = new_bench(bit_rates=frozenset({1_000_000, 500_000})).power_on()
    lss(bench, "04 01")
    assert lss(bench, "13 01 00") == ["1301000000000000"]
    assert lss(bench, "13 00 02") == ["1300000000000000"]
    assert lss(bench, "13 00 03") == ["1301000000000000"]


def test_activated_bit_timing_keeps_silent_before_and_after(bench):
    bench.write(0x1017, 0, 30, 2)
    lss(bench, "04 01")
    lss(bench, "13 00 02")
    bench.events()
    start = bench.now
    assert lss(bench, "15 64 00") == []  # 100 ms
    assert bench.sdo("40 00 10 00") == ""
    sent = bench.advance(0.25)
    assert bench.events() == [("bit_rate", 500_000)]
    assert bench.slave.lss.bit_rate == 500_000
    assert min(time for time, _, _ in sent) >= start + 0.2
    assert bench.sdo("40 00 10 00") != ""


def test_a_frame_just_after_the_silence_is_answered_though_no_timer_has_run(bench):
    lss(bench, "04 01")
    lss(bench, "13 00 02")
    assert lss(bench, "15 64 00") == []  # 100 ms
    bench.now += 0.21
    assert bench.sdo("40 00 10 00") != ""
    assert bench.slave.lss.bit_rate == 500_000


def test_store_survives_the_power_cycle(new_bench):
    storage = ParameterStorage()
    bench = new_bench(storage=storage).power_on()
    lss(bench, "04 01")
    lss(bench, "11 30")
    lss(bench, "13 00 03")
    assert lss(bench, "17") == ["1700000000000000"]
    again = new_bench(storage=storage)
    assert [(frame.id, frame.data) for frame in again.slave.start(0.0)] == [(0x730, b"\0")]
    assert again.slave.lss.bit_rate == 250_000


@pytest.mark.parametrize(("stored", "node_id", "bit_rate"), [(False, 0x2C, 1_000_000), (True, 0x30, 250_000)])
def test_a_reset_of_the_node_discards_what_is_not_stored(bench, stored, node_id, bit_rate):
    lss(bench, "04 01")
    if stored:
        lss(bench, "11 30")
        lss(bench, "13 00 03")
        lss(bench, "17")
    lss(bench, "11 21")
    lss(bench, "13 00 02")
    assert bench.nmt(129) == [(0x700 + node_id, b"\0")]
    bench.node = node_id
    lss(bench, "04 01")
    assert lss(bench, "17") == ["1700000000000000"]
    assert bench.slave.store.load_lss() == (node_id, bit_rate)


def test_store_that_fails(new_bench):
    storage = ParameterStorage()
    storage.save = Mock(side_effect=StorageError("disk full"))
    bench = new_bench(storage=storage).power_on()
    lss(bench, "04 01")
    assert lss(bench, "17") == ["1702000000000000"]
    assert ("storage_error", 0) in bench.events()


def scan(bench, number=0, bit=0x80, part=0, following=0):
    return lss(bench, bytes([0x51]) + number.to_bytes(4, "little") + bytes([bit, part, following]))


def fastscan(bench) -> list[int]:
    """Find the identity bit by bit, as a master does."""
    assert scan(bench)
    identity = []
    for part in range(4):
        number = 0
        for bit in reversed(range(32)):
            if not scan(bench, number, bit, part, part):
                number |= 1 << bit
        assert scan(bench, number, 0, part, (part + 1) % 4)
        identity.append(number)
    return identity


def test_fastscan_finds_the_identity_and_selects_the_node(unconfigured):
    assert fastscan(unconfigured) == list(IDENTITY)
    assert configuring(unconfigured)
    assert scan(unconfigured) == []  # no longer waiting


def test_fastscan_is_for_unconfigured_nodes(bench):
    assert scan(bench) == []


def test_fastscan_out_of_step(unconfigured):
    scan(unconfigured)
    assert scan(unconfigured, 0, 31, 1, 1) == []
    assert scan(unconfigured, 0, 32, 0, 0) == []
    assert scan(unconfigured, 0, 31, 4, 0) == []
    assert not configuring(unconfigured)


@pytest.mark.parametrize("frame", ["04", "0401", "04010000000000"])
def test_frames_of_another_length_are_ignored(bench, frame):
    bench.frame(0x7E5, frame)
    assert not configuring(bench)


def test_extended_and_remote_frames_are_ignored(bench):
    bench.frame(0x7E5, "0401000000000000", extended=True)
    bench.frame(0x7E5, remote=True)
    assert not configuring(bench)


@pytest.mark.parametrize("command", [2, 1])
def test_lss_works_in_every_state(bench, command):
    bench.nmt(command)
    assert select(bench) == ["4400000000000000"]


LONGEST_SILENCE_S = 2 * 65.535
"""Twice the longest delay of a change of the bit rate."""


def answering(bench) -> list[int]:
    """Return the node IDs under which an SDO client is answered."""
    return [node for node in range(1, 128) if bench.frame(0x600 + node, "4000100000000000")]


@pytest.mark.parametrize("seed", range(20))
def test_whatever_lss_frames_arrive_the_node_is_found_again(new_bench, seed):
    rng, storage = random.Random(seed), ParameterStorage()
    bench = new_bench(storage=storage).power_on()
    commands = (0x04, 0x11, 0x13, 0x15, 0x17, 0x40, 0x41, 0x42, 0x43, 0x46, 0x4C, 0x51, 0x5E)
    for _ in range(150):
        values = (0, 1, 1, 0x21, UNCONFIGURED_NODE, rng.randrange(256))
        lss(bench, bytes((rng.choice(commands), rng.choice(values))) + rng.randbytes(6))
        if rng.random() < 0.03:
            bench.nmt(rng.choice((129, 130)), 0)
        bench.advance(rng.choice((0.0, 0.01, 0.5)))
    if bench.slave.lss.silent:  # no node sends while the bit rate is changed
        assert answering(bench) == []
        bench.advance(LONGEST_SILENCE_S)
    node = bench.slave.node_id
    if node == UNCONFIGURED_NODE:
        assert answering(bench) == []
        for frame in ("04 01", "11 21", "04 00"):
            lss(bench, frame)
        node = 0x21
    assert answering(bench) == [node]


def test_a_stored_node_id_of_255_leaves_the_node_to_lss_after_a_restart(new_bench):
    storage = ParameterStorage()
    bench = new_bench(storage=storage).power_on()
    for frame in ("04 01", "11 ff", "17"):
        lss(bench, frame)
    assert answering(bench) == [0x2C]
    again = new_bench(storage=storage).power_on()
    assert answering(again) == []
    assert lss(again, "4c") == ["5000000000000000"]
    for frame in ("04 01", "11 2c", "17", "04 00"):
        lss(again, frame)
    assert answering(again) == answering(new_bench(storage=storage).power_on()) == [0x2C]
