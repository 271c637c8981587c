"""`starhil docs`: the pages of the documentation, which are installed with the package."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Final

import typer

from starhil.emulator.cli.output import print_text
from starhil.emulator.errors import EmulatorError

_FOLDER: Final = Path(__file__).resolve().parents[2] / "docs"
"""Folder of the pages in the installation or checkout."""

_HEADING: Final = "# "
"""Beginning of a page; the others are directives for the web site."""


def pages() -> dict[str, str]:
    """Return the pages in Markdown, by name."""
    texts = {page.stem: page.read_text(encoding="utf-8") for page in sorted(_FOLDER.glob("*.md"))}
    return {name: text for name, text in texts.items() if text.startswith(_HEADING)}


def names(incomplete: str) -> list[str]:
    """Complete the name of a page."""
    return [name for name in pages() if name.startswith(incomplete)]


def command(
    page: Annotated[
        str | None,
        typer.Argument(help="Name of a page; without it, the pages are listed.", autocompletion=names),
    ] = None,
) -> None:
    """Print a page of the documentation, in Markdown, or list the pages."""
    found = pages()
    if page is None:
        for name, text in found.items():
            print(f"{name:<18}  {text.splitlines()[0].removeprefix(_HEADING)}")
        return
    name = page.removeprefix("docs/").partition("#")[0].removesuffix(".md")
    if name not in found:
        raise EmulatorError(f"page {page!r}: not found; one of: {', '.join(found)}")
    print_text(found[name])
