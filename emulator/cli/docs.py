"""`starhil docs`: the pages of the documentation, which are installed with the package."""

from __future__ import annotations

import pydoc
import re
from pathlib import Path
from typing import Annotated, Final

import typer

from starhil.emulator.cli.output import print_text
from starhil.emulator.errors import EmulatorError
from starhil.protocol.errors import remedy
from starhil.protocol.files.bundled import DEFAULT_UNIT, bundled_units

_FOLDER: Final = Path(__file__).resolve().parents[2] / "docs"
"""Folder of the pages in the installation or checkout."""

_INTERFACES: Final = "icd/"
"""Beginning of the names of interface definitions."""

_HEADING: Final = "# "
"""Beginning of a page; the others are directives for the web site."""


_DIRECTIVES: Final = re.compile(r"^```\{eval-rst\}\n(.*?)^```\n", re.MULTILINE | re.DOTALL)
"""Sphinx directives in a page of the API."""


def pages() -> dict[str, str]:
    """Return the pages in Markdown, by path, those of the folder itself first; those of the API are `api/NAME`.

    The interface definition of a unit, `icd/NAME`, has only its heading here: `interface` makes its text.
    """
    files = sorted(_FOLDER.rglob("*.md"), key=lambda file: (len(file.parts), file))
    texts = {
        str(file.relative_to(_FOLDER).with_suffix("")): file.read_text(encoding="utf-8") for file in files
    }
    interfaces = {
        f"{_INTERFACES}{name}": f"{_HEADING}Interface definition of `{name}`" for name in bundled_units()
    }
    return {name: text for name, text in texts.items() if text.startswith(_HEADING)} | interfaces


def _interface(unit: str) -> str:
    from starhil.protocol.export import export
    from starhil.protocol.unit import load_unit

    return export(load_unit(unit), "markdown")


def _with_docstrings(directives: re.Match[str]) -> str:
    """Return the documentation of what the directives name, as `pydoc` prints it."""
    names = re.findall(r"^\.\. auto\w+:: (\S+)", directives[1], re.MULTILINE)
    texts = []
    for name in names:
        try:
            texts.append(pydoc.plain(pydoc.render_doc(name, "%s")))
        except pydoc.ErrorDuringImport as error:  # the plugin without pytest
            texts.append(f"{name}: {error}\n")
    return "\n".join(texts)


def names(incomplete: str) -> list[str]:
    return [name for name in pages() if name.startswith(incomplete)]


def command(
    page: Annotated[
        list[str] | None,
        typer.Argument(help="Name of a page; without it, the pages are listed.", autocompletion=names),
    ] = None,
) -> None:
    """Print a page of the documentation, in Markdown, or list the pages.

    `starhil docs icd NAME` prints the interface definition of a unit.
    """
    texts = pages()
    if not page:
        for name, text in texts.items():
            print(f"{name:<18}  {text.splitlines()[0].removeprefix(_HEADING)}")
        return
    page_name = "/".join(page)
    name = page_name.removeprefix("docs/").partition("#")[0].removesuffix(".md")
    name = f"{_INTERFACES}{DEFAULT_UNIT}" if f"{name}/" == _INTERFACES else name
    if name not in texts:
        raise EmulatorError(f"page {page_name!r}: not found{remedy(name, texts)}")
    if name.startswith(_INTERFACES):
        print_text(_interface(name.removeprefix(_INTERFACES)))
        return
    from starhil.emulator.cli.reference import with_built_tables

    print_text(with_built_tables(_DIRECTIVES.sub(_with_docstrings, texts[name])))
