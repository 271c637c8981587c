"""Templates of the exports: files in the folder of each format, filled in by Jinja."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from starhil.protocol.errors import IcdError

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
    """Return the part of a file of `export` under a heading, a comment of one word.

    Raises IcdError: there is none, so that the export lacks what a definition selects.
    """
    _, *texts = re.split(r"^(?:#|//) (\w+)\n", text_of(name), flags=re.MULTILINE)
    parts = dict(zip(texts[::2], texts[1::2], strict=True))
    if heading not in parts:
        raise IcdError(f"link.serial: {heading} cannot be exported: protocol/export/{name} has no such part")
    return parts[heading].strip("\n") + "\n"
