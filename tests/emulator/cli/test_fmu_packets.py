"""Texts in the packets between an FMU and its process, whatever the simulator puts there."""

from __future__ import annotations

from starhil.emulator.cli.fmu import process
from starhil.emulator.cli.fmu.process import PACKET, TEXTS, VARIABLES
from starhil.emulator.cli.fmu.variables import TEXT_SIZE

NUMBERS = len(VARIABLES) - len(TEXTS)


def test_a_text_that_is_not_utf_8_is_shown_as_such() -> None:
    packet = PACKET.pack(*[1.0] * NUMBERS, *[b"off\xff"] * len(TEXTS), b"", 0)
    assert {process._unpacked(packet)[name] for name in TEXTS} == {"off\ufffd"}


def test_a_text_that_does_not_fit_ends_with_a_whole_character() -> None:
    values = {each.name: 0.0 if each.name not in TEXTS else "ö" * TEXT_SIZE for each in VARIABLES}
    *_, message, status = PACKET.unpack(process._packed(values, "ö" * TEXT_SIZE, 1))
    assert (message.partition(b"\0")[0].decode(), status) == ("ö" * ((TEXT_SIZE - 1) // 2), 1)
