"""Sphinx configuration: `make docs` builds these pages into out/docs; a warning ends the build."""

from __future__ import annotations

import importlib.metadata
import re
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx

project = "starhil"
version = release = importlib.metadata.version("starhil")
html_title = f"starhil {release}"

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["_build"]

html_theme = "furo"
html_static_path = ["_static"]
html_css_files = ["starhil.css"]
html_copy_source = False
html_theme_options = {
    "light_css_variables": {"color-brand-primary": "#1f4e79", "color-brand-content": "#1f4e79"},
    "dark_css_variables": {"color-brand-primary": "#8ab4f8", "color-brand-content": "#8ab4f8"},
}
pygments_style = "friendly"
pygments_dark_style = "monokai"

myst_heading_anchors = 3

default_role = "code"
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
napoleon_google_docstring = False
napoleon_use_rtype = False
napoleon_use_ivar = True

ROOT = Path(__file__).resolve().parents[1]

LINKS = {
    "docs/": "",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "SECURITY.md": "security.md",
    "CITATION.cff": "../CITATION.cff",
}
"""Beginning of a link in the README → what it is among the pages."""


def put_readme_first(_app: Sphinx, page: str, source: list[str]) -> None:
    """Begin the front page with the README, with its links pointing to the pages here."""
    if page == "index":
        text = (ROOT / "README.md").read_text(encoding="utf-8")
        for there, here in LINKS.items():
            text = text.replace(f"]({there}", f"]({here}")
        source[0] = f"{text}\n{source[0]}"


def write_interfaces(_app: Sphinx) -> None:
    """Put the interface definitions of the units among the pages."""
    from starhil.protocol.export import export
    from starhil.protocol.files.bundled import bundled_units
    from starhil.protocol.unit import load_unit

    for name in bundled_units():
        (ROOT / "docs/icd" / f"{name}.md").write_text(export(load_unit(name), "markdown"), encoding="utf-8")


def put_tables(_app: Sphinx, _page: str, source: list[str]) -> None:
    """Put the reference tables in their places, and let links to the files of a unit lead to its interface definition."""
    from starhil.emulator.cli.reference import with_built_tables

    text = re.sub(r"\]\(\.\./configs/units/([\w-]+)\)", r"](icd/\1.md)", source[0])
    source[0] = with_built_tables(text)


ARRAY = re.compile(r"~numpy\.ndarray\[tuple\[~typing\.Any, \.\.\.\], ~numpy\.dtype\[(~[\w.]+)\]\]")
ARRAY_LIKE = re.compile(r"~numpy\._typing\._array_like\._Buffer \|.*?\[complex \| bytes \| str\]")


def shorten_array_types(_app: Sphinx, *signature: Any) -> tuple[str | None, str | None]:
    """Write the types of numpy in a signature as its documentation does; docstrings give shapes and units."""
    arguments, returned = (
        ARRAY_LIKE.sub("ArrayLike", ARRAY.sub(r"~numpy.ndarray[\1]", text)) if text else text
        for text in signature[-2:]
    )
    return arguments, returned


def keep_whole_sentences(
    _app: Sphinx, what: str, _name: str, _item: Any, _options: Any, lines: list[str]
) -> None:
    """Put the text of a property together again: napoleon takes what is before its first colon for a type."""
    if what == "property":
        for line in [line for line in lines if line.startswith(":type: ")]:
            lines.remove(line)
            lines[0] = f"{line.removeprefix(':type: ')}: {lines[0]}"


def setup(app: Sphinx) -> None:
    """Connect what this file adds."""
    app.connect("autodoc-process-signature", shorten_array_types)
    app.connect("autodoc-process-docstring", keep_whole_sentences, priority=600)
    app.connect("builder-inited", write_interfaces)
    app.connect("source-read", put_readme_first)
    app.connect("source-read", put_tables)
