"""Templates of the exports: files in the folder of each format, filled in by Jinja."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from starhil.protocol.values import IcdError

FOLDER = Path(__file__).parent


@cache
def _environment() -> Environment:
    return Environment(  # noqa: S701 -- each format escapes by the functions of `quoting`
        loader=FileSystemLoader(FOLDER),
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        undefined=StrictUndefined,
    )


def fill(name: str, /, **values: Any) -> str:
    """Return a template, a path within `export`, with its values filled in."""
    return _environment().get_template(name).render(values)


def text_of(name: str) -> str:
    """Return a file of `export` as it is."""
    return (FOLDER / name).read_text(encoding="utf-8")


def part_of(name: str, heading: str) -> str:
    """Return the part of a file of `export` under a heading, a comment of one word; raise IcdError if it has none."""
    found = re.search(
        rf"^(?:#|//) {heading}\n(.*?)(?=^(?:#|//) \w+$|\Z)", text_of(name), re.MULTILINE | re.DOTALL
    )
    if found is None:
        raise IcdError(
            f"link.serial: {Path(name).name.partition('.')[0]} of kind {heading!r} is Python code in the unit's "
            "plugin and cannot be exported"
        )
    return found[1].strip("\n") + "\n"
