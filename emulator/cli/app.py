"""The `starhil` command: what concerns a device. The numerics and the laboratory have the command `starid`."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import nullcontext
from typing import Final

import typer

from starhil.emulator.cli.output import kernel_modules
from starhil.emulator.errors import EmulatorError
from starhil.hil_tests.errors import BenchError
from starhil.protocol.errors import ProtocolError
from starid.cli import command_line
from starid.cli.output import compiling_reported
from starid.errors import StaridError

_NAMES: Final = (
    "icd truth fmu unit run replay bench render campaign endurance session conformance hub cache docs"
)

_COMPILING: Final = frozenset({"campaign", "endurance", "render", "replay", "bench centroid", "bench frame"})
"""Commands that compile kernels and do not start an emulator, which would report it."""

COMMANDS: Final = {name: f"starhil.emulator.cli.{name}" for name in _NAMES.split()}
"""Sub-command → module."""


def build_app(words: Sequence[str] = ()) -> typer.Typer:
    """Assemble the command line, see `command_line.build_app`."""
    about = "Star tracker emulator for hardware-in-the-loop tests: renders the sky, determines the attitude and answers on the bus."
    return command_line.build_app("starhil", about, COMMANDS, words)


def main() -> None:
    """Run the command line."""
    words = sys.argv[1:]
    compiles = not _COMPILING.isdisjoint((" ".join(words[:1]), " ".join(words[:2])))
    with compiling_reported(kernel_modules()) if compiles else nullcontext():
        command_line.run("starhil", build_app, words, (StaridError, ProtocolError, EmulatorError, BenchError))
