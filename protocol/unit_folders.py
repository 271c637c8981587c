"""Folders of units: bundled ones in `configs/units`, and the user's."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from starhil.protocol.names import CONFIGS, bundled, find, not_found
from starhil.protocol.values import IcdError

DEFAULT_UNIT: Final = "cubestar"
"""Name of the unit that is emulated unless another is chosen."""

UNITS_FOLDER: Final = CONFIGS / "units"
"""Folder of the bundled units."""

SKELETON: Final = UNITS_FOLDER.parent / "new_unit.toml"
"""Template that `starhil unit new` copies."""


def bundled_units() -> list[str]:
    """Return the names of the bundled units."""
    return list(bundled("unit"))


def find_unit(name_or_folder: str | Path) -> Path:
    """Return the path of a unit: a bundled unit by name, or an existing folder or TOML file.

    Raises IcdError, whose text suggests similar names.
    """
    path = find("unit", name_or_folder)
    if path.exists():
        return path
    raise IcdError(f"{not_found('unit', name_or_folder)}; `starhil unit new FOLDER` creates one")
