"""Errors of the CANopen slave, as `mutants.toml` lists them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from tests.planted import PlantedDefect, read_defects


@dataclass(frozen=True)
class Mutant(PlantedDefect):
    """An error, and the case that finds it, of those named `canopen.…`."""

    case: str


MUTANTS = read_defects(Path(__file__).with_name("mutants.toml"), Mutant)
