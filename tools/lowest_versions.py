"""The lowest versions that `pyproject.toml` admits, as constraints for pip.

python tools/lowest_versions.py >lowest.txt
pip install --constraint lowest.txt '.[test]'
"""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any, Final

PROJECT: Final = Path(__file__).parent.parent / "pyproject.toml"
EXTRAS: Final = ("lab",)
"""Extras whose versions count, besides the dependencies themselves; tools of tests are those of today."""

_FLOOR: Final = re.compile(r"([\w.-]+)(?:\[[\w,]+\])?>=([\w.]+)")


def lowest_versions(project: dict[str, Any]) -> dict[str, str]:
    """Return the floor of each dependency of a project (the table of its `pyproject.toml`), by name.

    Raises
    ------
    ValueError
        A dependency has no floor.
    """
    table = project["project"]
    needed = [*table["dependencies"]]
    for extra in EXTRAS:
        needed += table["optional-dependencies"][extra]
    floors = {}
    for requirement in needed:
        match = _FLOOR.fullmatch(requirement)
        if match is None:
            raise ValueError(
                f"pyproject.toml: {requirement}: must have a floor, NAME>=VERSION, and nothing else"
            )
        floors[match[1]] = match[2]
    return floors


def main() -> None:
    """Print the constraints."""
    floors = lowest_versions(tomllib.loads(PROJECT.read_text(encoding="utf-8")))
    print(*(f"{name}=={version}" for name, version in floors.items()), sep="\n")


if __name__ == "__main__":
    main()
