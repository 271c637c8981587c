"""Folders of units: bundled ones in `configs/units`, and the user's."""

from __future__ import annotations

import difflib
from pathlib import Path
from typing import Final

from starhil.protocol.values import IcdError

DEFAULT_UNIT: Final = "cubestar"
"""Name of the unit that is emulated unless another is chosen."""

UNITS_FOLDER: Final = Path(__file__).resolve().parent.parent / "configs" / "units"
"""Folder of the bundled units."""

SKELETON: Final = UNITS_FOLDER.parent / "new_unit.toml"
"""Template that `starhil unit new` copies."""


def bundled_units() -> list[str]:
    """Return the names of the bundled units."""
    return sorted(folder.name for folder in UNITS_FOLDER.iterdir() if any(folder.glob("*.toml")))


def find_unit(name_or_folder: str | Path) -> Path:
    """Return the path of a unit: a bundled unit by name, or an existing folder or TOML file.

    Raises IcdError, whose text suggests similar names.
    """
    path = Path(name_or_folder).expanduser()
    shipped = bundled_units()
    if path.name == str(name_or_folder) in shipped:
        return UNITS_FOLDER / path.name
    if path.exists():
        return path
    near = difflib.get_close_matches(path.name, shipped, n=3)
    hint = f"did you mean {', '.join(near)}?" if near else f"bundled units: {', '.join(shipped)}"
    raise IcdError(
        f"unit {name_or_folder}: neither a folder nor a bundled unit; {hint}; `starhil unit new FOLDER` creates one"
    )
