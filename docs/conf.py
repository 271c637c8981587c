"""Sphinx configuration: `make docs` builds these pages into out/docs; a warning ends the build."""

from __future__ import annotations

import importlib.metadata
from pathlib import Path

from sphinx.application import Sphinx

project = "starhil"
version = release = importlib.metadata.version("starhil")
html_title = f"starhil {release}"

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["_build"]

html_theme = "furo"
html_static_path = ["_static"]
html_css_files = ["wide_tables.css"]
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


def put_readme_first(_app: Sphinx, page: str, source: list[str]) -> None:
    """Begin the front page with the README, whose links count from the folder above."""
    if page == "index":
        readme = Path(__file__).resolve().parent.parent / "README.md"
        source[0] = readme.read_text(encoding="utf-8").replace("](docs/", "](") + "\n" + source[0]


def setup(app: Sphinx) -> None:
    """Connect what this file adds."""
    app.connect("source-read", put_readme_first)
