"""Fuzzing of the whole slave: frames near good ones in any order, 20 000 of them (STARHIL_FUZZ_INPUTS sets another number)."""

from __future__ import annotations

import random

import pytest

from starhil.protocol.can.frame import CanFrame
from starhil.protocol.files.bundled import bundled_units
from starhil.protocol.unit import load_unit
from tests.protocol.canopen.conftest import NODE, Bench
from tests.protocol.test_fuzz import INPUTS, SEED

pytestmark = pytest.mark.long

IDENTIFIERS = [
    0x000, 0x080, 0x100, 0x080 + NODE, 0x180 + NODE, 0x200 + NODE, 0x300 + NODE, 0x500 + NODE, 0x580 + NODE,
    *[0x600 + NODE] * 12, 0x601, 0x700 + NODE, 0x705, 0x7E4, *[0x7E5] * 3,
]  # fmt: skip
SDO_COMMANDS = (0x00, 0x01, 0x10, 0x11, 0x20, 0x21, 0x22, 0x23, 0x2B, 0x2F, 0x40, 0x60, 0x70, 0x80, 0xA0, 0xA1, 0xA2, 0xA3, 0xA4,
                0xC0, 0xC1, 0xC2, 0xC6, 0xFF)  # fmt: skip
LSS_COMMANDS = (
    0x04,
    0x11,
    0x13,
    0x15,
    0x17,
    0x40,
    0x41,
    0x42,
    0x43,
    0x46,
    0x4C,
    0x51,
    0x5A,
    0x5B,
    0x5C,
    0x5D,
    0x5E,
)
NMT_COMMANDS = (1, 2, 128, 129, 130)
UNITS = [name for name in bundled_units() if load_unit(name).canopen is not None]
MAX_ANSWERS = 200
"""Frames that one frame may be answered by: a block of 127 segments and what goes with it."""
LONGEST_SILENCE_S = 2 * 65.535
"""LSS activate bit timing keeps a slave silent for two switch delays of 16 bits of milliseconds (CiA 305)."""


def frames(source: random.Random, entries: list[tuple[int, int]]):
    """Frames whose parts are mostly such as the slave knows, endless."""
    while True:
        identifier = source.choice(IDENTIFIERS)
        data = bytearray(source.randbytes(8))
        if identifier == 0x600 + NODE:
            data[0] = source.choice(SDO_COMMANDS)
            if source.random() < 0.8:
                index, subindex = source.choice(entries)
                data[1:4] = index.to_bytes(2, "little") + bytes([subindex])
            if source.random() < 0.5:
                data[4:8] = source.choice(
                    (b"\0\0\0\0", b"\1\0\0\0", b"save", b"load", b"\x7f\0\0\0", b"\xff\xff\xff\xff")
                )
        elif identifier == 0x7E5:
            data[0] = source.choice(LSS_COMMANDS)
        elif identifier == 0x000:
            data[:2] = bytes((source.choice(NMT_COMMANDS), source.choice((0, NODE, NODE, 5))))
            del data[2:]
        if source.random() < 0.1:
            del data[source.randrange(9) :]
        if source.random() < 0.02:
            identifier ^= 1 << source.randrange(11)
        remote = source.random() < 0.02
        extended = source.random() < 0.02
        yield CanFrame(identifier, b"" if remote else bytes(data), extended=extended, remote=remote)


@pytest.mark.parametrize("unit", UNITS)
def test_the_slave_answers_in_order_and_survives_any_input(unit):
    source = random.Random(SEED)
    bench = shown(unit)
    entries = [(item.index, item.subindex) for item in all_entries(bench)]
    for number, frame in zip(range(INPUTS), frames(source, entries), strict=False):
        bench.now += source.choice((0.0, 0.0001, 0.001, 0.02))
        answers = bench.slave.receive(frame, bench.now)
        deadline = bench.slave.next_deadline()
        if deadline is not None and deadline <= bench.now:
            answers = [*answers, *bench.slave.tick(bench.now)]
        assert len(answers) <= MAX_ANSWERS
        for answer in answers:
            assert not answer.extended
            assert len(answer.data) <= 8
            if answer.id == 0x580 + bench.slave.node_id:
                assert len(answer.data) == 8
        bench.slave.take_events()
        if number % 1000 == 999:
            bench = alive(bench, unit)


def shown(unit: str) -> Bench:
    """A slave of a unit that is on and has an image."""
    bench = Bench(unit=unit).power_on()
    bench.show(bytes(3000))
    return bench


def all_entries(bench: Bench):
    """Entries of the dictionary."""
    for item in bench.dictionary.od.values():
        yield from (item.subindices.values() if hasattr(item, "subindices") else [item])


def alive(bench: Bench, unit: str) -> Bench:
    """After a node reset it boots up and answers; a slave whose node ID changed is replaced."""
    bench.now += LONGEST_SILENCE_S
    bench.frame(0x000, bytes((0x81, NODE)))  # also puts a node ID of LSS into force
    bench.advance(0.1)
    if bench.slave.node_id != NODE:
        return shown(unit)
    assert bench.sdo("40 00 10 00").startswith("43001000")
    return bench
