"""The `starhil` command, for everything that concerns a device; `starid` is the command of the numerics and the laboratory."""

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
    "icd truth fmu unit run replay bench render campaign endurance session conformance hub cache docs"
)

COMMANDS: Final = {name: f"starhil.emulator.cli.{name}" for name in _NAMES.split()}
"""Sub-command → module."""

MOVED_COMMANDS: Final[dict[tuple[str, ...], str]] = {
    **{(name,): name for name in ("identify", "calibrate", "catalog", "features", "database", "reproduce")},
    ("bench", "identify"): "bench",
}
"""Sub-commands of earlier releases → their names in `starid`; they go on working for one release."""


def build_app(words: Sequence[str] = ()) -> typer.Typer:
    """Assemble the command line, see `command_line.build_app`."""
    about = "Star tracker emulator for hardware-in-the-loop tests: renders the sky, determines the attitude and answers on the bus."
    return command_line.build_app("starhil", about, COMMANDS, words)


def main() -> None:
    """Run the command line; a sub-command that has moved to `starid` is run there."""
    words = sys.argv[1:]
    for old, new in MOVED_COMMANDS.items():
        if tuple(words[: len(old)]) == old:
            from starid.cli import app

            print(f"starhil {' '.join(old)}: is now starid {new}", file=sys.stderr)
            app.main([new, *words[len(old) :]])
    command_line.run("starhil", build_app, words, (StaridError, ProtocolError, EmulatorError, BenchError))
