"""The interface definition as one self-contained HTML page."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Final

from starhil.protocol.definition import InterfaceDefinition
from starhil.protocol.export import describe, wire
from starhil.protocol.quoting import html_text
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
    yield f"<title>{html_text(heading)}</title><style>{_STYLE}</style></head><body>"
    yield f"<h1>{html_text(heading)}</h1><p>{html_text(icd.doc)}</p>"
    yield from (f"<p>{html_text(paragraph)}</p>" for paragraph in describe.introduction(icd))
    after = (*describe.reference(icd), *wire.sections(icd))
    anchors = {section: f"section-{number}" for number, section in enumerate((*icd.sections, *after))}
    links = [(anchors[section], section.heading) for section in icd.sections]
    links += [(title.lower(), title) for title, _ in describe.sections(icd)]
    links += [(anchors[section], section.heading) for section in after]
    yield "<nav>" + "".join(f'<a href="#{anchor}">{html_text(text)}</a>' for anchor, text in links) + "</nav>"
    for section in icd.sections:
        yield from _section(anchors[section], section)
    examples = describe.examples(icd)
    for title, rows in describe.sections(icd):
        yield f'<h2 id="{title.lower()}">{title}</h2>'
        yield "<table><tr><th>Id</th><th>Name</th><th>Bytes</th><th>Source</th><th>Meaning</th></tr>"
        for row in rows:
            yield (
                f'<tr class="{row.provenance}"><td>{row.id}</td><td><a href="#{describe.anchor(row)}">{html_text(row.name)}</a></td>'
                f"<td>{row.size}</td><td>{row.provenance}</td><td>{html_text(row.doc)}</td></tr>"
            )
        yield "</table>"
        for row in rows:
            yield f'<h3 id="{describe.anchor(row)}">{html_text(describe.title(row))}</h3>'
            yield f'<p>{html_text(row.doc)}</p><p class="facts">{html_text(describe.facts(row))}.</p>'
            if row.fields:
                kinds = (field.provenance for field in row.fields)
                cells = zip(kinds, describe.field_cells(row), strict=True)
                yield from _table(describe.FIELD_COLUMNS, cells)
            yield from (f"<p>{html_text(describe.example_text(item))}</p>" for item in examples[row.name])
    for section in after:
        yield from _section(anchors[section], section)
    yield "</body></html>"


def _section(anchor: str, section: Section) -> Iterator[str]:
    yield f'<h2 id="{anchor}">{html_text(section.heading)}</h2>'
    yield from (f"<p>{html_text(paragraph)}</p>" for paragraph in section.paragraphs)
    yield from _table(section.columns, (("confirmed", row) for row in section.rows))


def _table(columns: Sequence[str], rows: Iterable[tuple[str, Sequence[str]]]) -> Iterator[str]:
    yield "<table><tr>" + "".join(f"<th>{html_text(column)}</th>" for column in columns) + "</tr>"
    for kind, cells in rows:
        yield f'<tr class="{kind}">' + "".join(f"<td>{html_text(cell)}</td>" for cell in cells) + "</tr>"
    yield "</table>"
