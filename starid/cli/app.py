"""The `starid` command: star identification, calibration, the catalogue, and the laboratory."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Final

import typer

from starid.cli import command_line
from starid.cli.output import compiling_reported

COMMANDS: Final[dict[str, str]] = {
    name: f"starid.cli.{name}"
    for name in ("identify", "annotate", "calibrate", "catalog", "features", "database", "reproduce", "bench")
}
"""Sub-command → module."""


def build_app(words: Sequence[str] = ()) -> typer.Typer:
    """Assemble the command line, see `command_line.build_app`."""
    about = "Star identification: stars and attitude of an image, cameras, the star catalogue, and experiments with algorithms."
    return command_line.build_app("starid", about, COMMANDS, words)


def main(words: Sequence[str] | None = None) -> None:
    """Run the command line with the given arguments, by default those of the process."""
    with compiling_reported():
        command_line.run("starid", build_app, sys.argv[1:] if words is None else words)
