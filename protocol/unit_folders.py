"""Folders of units: those that ship with the package in `configs/units`, and a user's own."""

from __future__ import annotations

import difflib
from pathlib import Path
from typing import Final

from starhil.protocol.values import IcdError

DEFAULT_UNIT: Final = "cubestar"
"""Name of the unit that is emulated unless another is chosen."""

UNITS_FOLDER: Final = Path(__file__).resolve().parent.parent / "configs" / "units"
"""Folder of the units that ship with the package."""


def shipped_units() -> list[str]:
    """Return the names of the units that ship with the package."""
    return sorted(folder.name for folder in UNITS_FOLDER.iterdir() if any(folder.glob("*.toml")))


def find_unit(name_or_folder: str | Path) -> Path:
    """Return the folder of a unit: an existing folder (or file), else that of a unit that ships.

    Raises IcdError that offers similar names.
    """
    path = Path(name_or_folder).expanduser()
    shipped = shipped_units()
    if path.name == str(name_or_folder) in shipped:
        return UNITS_FOLDER / path.name
    if path.exists():
        return path
    near = difflib.get_close_matches(path.name, shipped, n=3)
    hint = f"did you mean {', '.join(near)}?" if near else f"units that ship: {', '.join(shipped)}"
    raise IcdError(f"unit {name_or_folder}: neither a folder nor a unit that ships with the package; {hint}")
