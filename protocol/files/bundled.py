"""What ships with the package by name: profiles, scenarios, sessions, units; and similar names for an unknown one."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Final, Literal, TypeAlias

from starhil.protocol.errors import IcdError, did_you_mean

Kind: TypeAlias = Literal["orbit", "profile", "scenario", "session", "unit"]

CONFIGS: Final = Path(__file__).resolve().parents[2] / "configs"
"""Folder `configs` of the installation or checkout."""

UNITS_FOLDER: Final = CONFIGS / "units"

DEFAULT_UNIT: Final = "cubestar"
"""Name of the unit that is emulated unless another is chosen."""

SKELETON: Final = CONFIGS / "new_unit.toml"
"""Template that `starhil unit new` copies."""


@cache
def bundled(kind: Kind) -> Mapping[str, Path]:
    """Return the files (for units, the folders) that ship with the package, by name."""
    files = (CONFIGS / f"{kind}s").glob("*/*.toml" if kind == "unit" else "*.toml")
    found = sorted({file.parent if kind == "unit" else file for file in files})
    return MappingProxyType({path.stem: path for path in found})


def find(kind: Kind, name: str | Path) -> Path:
    """Return the path of what is bundled under a name, or else the name as a path, which may not exist."""
    try:
        return bundled(kind).get(str(name)) or Path(name).expanduser()
    except RuntimeError:  # the home folder of an unknown user
        return Path(name)


def not_found(kind: Kind, name: str | Path) -> str:
    """Return the text of an error for a name that is neither bundled nor a path."""
    known = bundled(kind)
    hint = did_you_mean(Path(name).stem, known)
    return f"{kind} {str(name)!r}: not found; give a path, or one of: {', '.join(known)}{hint}"


def bundled_units() -> list[str]:
    return list(bundled("unit"))


def find_unit(name_or_folder: str | Path) -> Path:
    """Return the path of a unit: a bundled unit by name, or an existing folder or TOML file.

    Raises IcdError, whose text suggests similar names.
    """
    path = find("unit", name_or_folder)
    if name_or_folder != "" and path.exists():  # an empty name is the working folder as a path
        return path
    raise IcdError(f"{not_found('unit', name_or_folder)}; `starhil unit new FOLDER` creates one")
