"""What the code of flight software, built unchanged, has exchanged with a unit, again and byte by byte."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.emulator.units.clients import Emulated, with_unit

FOLDER = Path(__file__).with_name("recorded")
STEP_S = 0.005
"""Time after each request of a record."""
MANY = 1000
"""More than the times that a request was repeated."""


@dataclass
class Exchange:
    """A request and its answer."""

    request: bytes
    polled: bool
    """Whether the request was repeated until this answer came."""
    answer: bytes = b""
    whole: bool = True
    """Whether the answer has no other bytes at its end."""

    def matches(self, answer: bytes) -> bool:
        return answer == self.answer if self.whole else answer.startswith(self.answer)


def recorded(name: str) -> list[Exchange]:
    """Return the exchanges of a record."""
    exchanges: list[Exchange] = []
    for line in (FOLDER / name).read_text(encoding="ascii").splitlines():
        mark, _, digits = line.partition(" ")
        if mark in (">", ">>"):
            exchanges.append(Exchange(bytes.fromhex(digits), mark == ">>"))
        elif mark == "<":
            exchanges[-1].whole = not digits.endswith("*")
            exchanges[-1].answer += bytes.fromhex(digits.rstrip("*"))
    return exchanges


@pytest.mark.parametrize(
    ("unit", "name", "count"),
    [("cubestar", "albertasat.txt", 43), ("st16", "cosmos.txt", 7), ("nos3", "nos3.txt", 5)],
)
def test_what_a_driver_sent_is_answered_with_what_it_took(unit: str, name: str, count: int) -> None:
    def scenario(emulated: Emulated) -> None:
        if unit == "cubestar":
            emulated.bench.device.parameters.set({"serial_dialect": "a"})
            emulated.bench.command("save_parameters")
        for number, exchange in enumerate(exchanges, 1):
            for _ in range(MANY if exchange.polled else 1):
                answer = emulated.ask(exchange.request) + b"".join(emulated.step(STEP_S))
                if exchange.matches(answer):
                    break
            assert exchange.matches(answer), f"exchange {number}: {answer.hex(' ')}"

    exchanges = recorded(name)
    assert len(exchanges) == count
    with_unit(unit, "serial", scenario)
