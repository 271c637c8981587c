"""A client for NOS3's generic star tracker, written from its table."""

from __future__ import annotations

from tests.emulator.units.clients import Emulated, arcseconds_between, attitude_matrix, true_matrix, with_unit

QUANTISATION = 8.0
"""Arcseconds that 16 bits a component leave uncertain."""


def command(identifier: int, payload: int = 0) -> bytes:
    return b"\xde\xad" + bytes([identifier]) + payload.to_bytes(4, "big") + b"\xbe\xef"


def data_of(unit: Emulated) -> tuple[list[float], int]:
    reply = unit.ask(command(2))
    assert reply[:9] == command(2)
    body = reply[9:]
    assert len(body) == 13
    assert body[:2] == b"\xde\xad"
    assert body[11:] == b"\xbe\xef"
    raw = [int.from_bytes(body[2 + 2 * n : 4 + 2 * n], "big") for n in range(4)]
    return [(value - 32768.0) / 32767.0 for value in raw], body[10]


def test_attitude_is_the_truth_and_flagged_valid():
    def scenario(unit: Emulated) -> None:
        quaternion, valid = data_of(unit)
        assert valid == 1
        assert arcseconds_between(attitude_matrix(*quaternion), true_matrix()) < QUANTISATION

    with_unit("nos3", "serial", scenario)


def test_validity_clears_when_the_lens_is_covered():
    def scenario(unit: Emulated) -> None:
        unit.cover()
        unit.step(3.0)
        assert data_of(unit)[1] == 0
        unit.bench.pipeline.fail = ""
        unit.step(3.0)
        assert data_of(unit)[1] == 1

    with_unit("nos3", "serial", scenario)


def test_commands_are_echoed_with_their_payload_and_counted():
    def scenario(unit: Emulated) -> None:
        assert unit.ask(command(0, 0x12345678)) == command(0, 0x12345678)
        reply = unit.ask(command(1))
        assert reply[:9] == command(1)
        assert reply[9:11] + reply[15:] == b"\xde\xad\xbe\xef"
        first = int.from_bytes(reply[11:15], "big")
        unit.ask(command(0))
        second = int.from_bytes(unit.ask(command(1))[11:15], "big")
        assert second == first + 2

    with_unit("nos3", "serial", scenario)


def test_unknown_command_and_wrong_trailer_are_not_answered_and_the_next_command_is():
    def scenario(unit: Emulated) -> None:
        assert unit.ask(command(3)) == b""
        assert unit.ask(command(2)[:-1] + b"\x00") == b""
        assert data_of(unit)[1] == 1

    with_unit("nos3", "serial", scenario)
