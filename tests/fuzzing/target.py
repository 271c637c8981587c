"""What a target of fuzzing is, and the table of all targets."""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from starhil.emulator.errors import EmulatorError
from starhil.hil_tests.errors import BenchError
from starhil.protocol.errors import ProtocolError
from starid.errors import StaridError

CORPUS = Path(__file__).parent / "corpus"
DOCUMENTED = (EmulatorError, ProtocolError, BenchError, StaridError)
"""The errors that a caller of the readers expects."""
NESTED = b"[" * 5000
"""Deeper than a recursive parser can follow."""
ATTITUDE = {"ra_deg": 1.0, "dec_deg": 2.0, "roll_deg": 3.0}

Run = Callable[[bytes], object]


@dataclass(frozen=True)
class Target:
    """A target: `make` returns the function of bytes, which may write files into the folder that `make` is given."""

    make: Callable[[Path], Run]
    seeds: Callable[[], list[bytes]]

    def runner(self, folder: Path) -> Run:
        """Return the function of bytes; a documented error is fine if it is one line, and each of its problems is."""
        run = self.make(folder)

        def guarded(data: bytes) -> None:
            try:
                run(data)
            except DOCUMENTED as error:
                for text in (str(error), *getattr(error, "problems", ())):
                    if len(text.splitlines()) != 1:
                        raise AssertionError(f"not one line: {text!r}") from error

        return guarded


TARGETS: dict[str, Target] = {}


def target(
    name: str, seeds: Callable[[], list[bytes]]
) -> Callable[[Callable[[Path], Run]], Callable[[Path], Run]]:
    """Enter a target in the table."""

    def enter(make: Callable[[Path], Run]) -> Callable[[Path], Run]:
        TARGETS[name] = Target(make, seeds)
        return make

    return enter


def read_corpus(name: str) -> list[bytes]:
    """Return the inputs of a target that were kept: one a line, as Python writes bytes."""
    path = CORPUS / f"{name}.txt"
    return [ast.literal_eval(line) for line in path.read_text("ascii").splitlines()] if path.exists() else []


def chunks(data: bytes) -> Iterator[bytes]:
    """Split bytes as a line may do: the first byte is the size of the chunks."""
    size = data[0] % 32 + 1 if data else 1
    for start in range(1, len(data), size):
        yield data[start : start + size]
