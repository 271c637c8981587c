"""Errors planted in the product's own protocol code, so that device and client share them.

`protocol_mutants.toml` lists them as data: which module or function of `starhil.protocol`, which text in it, and what replaces it.
"""

from __future__ import annotations

import tomllib
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path

from tests.planted import Edit, planted

FILE = Path(__file__).with_name("protocol_mutants.toml")


@dataclass(frozen=True)
class ProtocolMutant:
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
    name: str
    unit: str
    cases: tuple[str, ...]
    edits: tuple[Edit, ...]
    link: str = "serial"
    hidden: bool = True

    def planted(self) -> AbstractContextManager[None]:
        """Put the error into the running product."""
        return planted(*self.edits)


def read_mutants() -> list[ProtocolMutant]:
    """Return the mutants of the file."""
    mutants = []
    for table in tomllib.loads(FILE.read_text(encoding="utf-8"))["mutant"]:
        edits, cases = tuple(Edit(**edit) for edit in table.pop("edits")), tuple(table.pop("cases"))
        mutants.append(ProtocolMutant(**table, cases=cases, edits=edits))
    return mutants
