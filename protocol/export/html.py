"""The interface definition as one self-contained HTML page."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from html import escape
from typing import Final

from starhil.protocol.export import describe, wire
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.values import Section

_STYLE: Final = """
body { font: 15px/1.45 system-ui, sans-serif; margin: 2em auto; max-width: 72em; padding: 0 1em; color: #1a1a1a; }
h1, h2, h3 { line-height: 1.2; } h2 { border-bottom: 2px solid #446; margin-top: 2.5em; } h3 { margin-top: 2em; }
table { border-collapse: collapse; width: 100%; font-size: 13px; } th, td { border: 1px solid #bbc; padding: 3px 7px; text-align: left;
vertical-align: top; } th { background: #eef; } tr.ours td { background: #fffbe8; } tr.proxy td { background: #f0f7ff; }
td:nth-child(2) { font-family: ui-monospace, monospace; } .facts { color: #555; } nav a { margin-right: 1em; }
@media print { h3, tr { break-inside: avoid; } }
"""


def render(icd: InterfaceDefinition) -> str:
    """Return the definition as an HTML page: rows, parameters, enumerations."""
    return "\n".join(_lines(icd)) + "\n"


def _lines(icd: InterfaceDefinition) -> Iterator[str]:
    heading = f"Interface definition {icd.name} {icd.version}"
    yield "<!DOCTYPE html>"
    yield '<html lang="en"><head><meta charset="utf-8">'
    yield f"<title>{escape(heading)}</title><style>{_STYLE}</style></head><body>"
    yield f"<h1>{escape(heading)}</h1><p>{escape(icd.doc)}</p>"
    yield from (f"<p>{escape(paragraph)}</p>" for paragraph in describe.introduction(icd))
    after = (*describe.reference(icd), *wire.sections(icd))
    links = [_link(section) for section in icd.sections]
    links += [
        '<a href="#telecommands">Telecommands</a><a href="#telemetry">Telemetry</a>',
        *map(_link, after),
    ]
    yield f"<nav>{''.join(links)}</nav>"
    for section in icd.sections:
        yield from _section(section)
    for title, rows in describe.sections(icd):
        yield f'<h2 id="{title.lower()}">{title}</h2>'
        yield "<table><tr><th>Id</th><th>Name</th><th>Bytes</th><th>Source</th><th>Meaning</th></tr>"
        for row in rows:
            yield (
                f'<tr class="{row.provenance}"><td>{row.id}</td><td><a href="#{describe.anchor(row)}">{escape(row.name)}</a></td>'
                f"<td>{row.size}</td><td>{row.provenance}</td><td>{escape(row.doc)}</td></tr>"
            )
        yield "</table>"
        for row in rows:
            yield f'<h3 id="{describe.anchor(row)}">{escape(describe.title(row))}</h3>'
            yield f'<p>{escape(row.doc)}</p><p class="facts">{escape(describe.facts(row))}.</p>'
            if row.fields:
                yield from _table(
                    describe.FIELD_COLUMNS,
                    ((field.provenance, describe.field_cells(row, field)) for field in row.fields),
                )
    for section in after:
        yield from _section(section)
    yield "</body></html>"


def _section(section: Section) -> Iterator[str]:
    yield f'<h2 id="{_anchor(section)}">{escape(section.heading)}</h2>'
    yield from (f"<p>{_text(paragraph)}</p>" for paragraph in section.paragraphs)
    yield from _table(section.columns, (("confirmed", row) for row in section.rows))


def _link(section: Section) -> str:
    return f'<a href="#{_anchor(section)}">{escape(section.heading)}</a>'


def _anchor(section: Section) -> str:
    return section.heading.lower().replace(" ", "-")


def _text(text: str) -> str:
    """Escape a text and mark what is between backticks as code."""
    return re.sub("`([^`]*)`", r"<code>\1</code>", escape(text))


def _table(columns: Sequence[str], rows: Iterable[tuple[str, Sequence[str]]]) -> Iterator[str]:
    yield "<table><tr>" + "".join(f"<th>{escape(column)}</th>" for column in columns) + "</tr>"
    for kind, cells in rows:
        yield f'<tr class="{kind}">' + "".join(f"<td>{_text(cell)}</td>" for cell in cells) + "</tr>"
    yield "</table>"
