"""Errors planted in the product's own protocol code, so that device and client share them, as `protocol_mutants.toml` lists them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from tests.planted import PlantedDefect, read_defects


@dataclass(frozen=True)
class ProtocolMutant(PlantedDefect):
    """An error of the product, and the cases of a unit of which at least one must fail.

    Attributes
    ----------
    unit
        Bundled unit, `tutorial` for that of docs/your-unit.md, or a link of `tests.conformance.links` with `link:`
        before its name.
    link
        `serial`, `can` or `canopen`.
    hidden
        Whether the product's own codec does not notice the error: it decodes what it encodes.
    """

    mechanism: str
    unit: str
    cases: tuple[str, ...]
    link: str = "serial"
    hidden: bool = True


MUTANTS = read_defects(Path(__file__).with_name("protocol_mutants.toml"), ProtocolMutant)
