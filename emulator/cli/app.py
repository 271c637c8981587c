"""The `starhil` command: what concerns a device. The numerics and the laboratory have the command `starid`."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Final

import typer

from starhil.emulator.errors import EmulatorError
from starhil.hil_tests.errors import BenchError
from starhil.protocol.errors import ProtocolError
from starid.cli import command_line
from starid.errors import StaridError

_NAMES: Final = (
    "run session conformance render replay icd unit campaign bench endurance truth fmu hub cache docs"
)

COMMANDS: Final = {name: f"starhil.emulator.cli.{name}" for name in _NAMES.split()}
"""Sub-command → module."""


def build_app(words: Sequence[str] = ()) -> typer.Typer:
    """Assemble the command line, see `command_line.build_app`."""
    about = "Star tracker emulator for hardware-in-the-loop tests: renders the sky, determines the attitude and answers on the bus."
    return command_line.build_app("starhil", about, COMMANDS, words)


def main() -> None:
    """Run the command line."""
    errors = (StaridError, ProtocolError, EmulatorError, BenchError)
    command_line.run("starhil", build_app, sys.argv[1:], errors)
