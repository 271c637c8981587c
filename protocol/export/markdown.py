"""The interface definition as Markdown tables."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final

from starhil.protocol.export import describe, wire
from starhil.protocol.export.templates import fill
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.icd.codec import Row
from starhil.protocol.icd.quoting import markdown, one_line

_ROW_COLUMNS: Final = ("ID", "Name", "Bytes", "Source", "Meaning")


def render(icd: InterfaceDefinition) -> str:
    """Return the definition as Markdown: rows, parameters, enumerations, links."""
    groups = list(describe.sections(icd))
    after = (*describe.reference(icd), *wire.sections(icd))
    headings = [section.heading for section in icd.sections] + [heading for heading, _ in groups]
    return fill(
        "tables.md.j2",
        icd=icd,
        paragraphs=(icd.doc, *describe.introduction(icd)),
        headings=[*headings, *(section.heading for section in after)],
        groups=groups,
        after=after,
        examples=describe.examples(icd),
        describe=describe,
        quoted=markdown,
        link=_link,
        index=_index,
        table=lambda columns, rows: _table(map(markdown, columns), (map(markdown, row) for row in rows)),
    )


def _index(rows: Sequence[Row]) -> str:
    """Return the table of a group of rows, with links to each."""
    cells = (
        (str(row.id), _link(row.name, describe.title(row)), str(row.size), row.provenance, markdown(row.doc))
        for row in rows
    )
    return _table(_ROW_COLUMNS, cells)


def _link(text: str, heading: str) -> str:
    """Return a link to a heading, by the anchor that GitHub and others generate."""
    anchor = "".join(letter for letter in one_line(heading).lower() if letter.isalnum() or letter in " -_")
    return f"[{markdown(text)}](#{anchor.replace(' ', '-')})"


def _table(columns: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Return a table of cells that are Markdown already."""
    head = list(columns)
    lines = (head, ["---"] * len(head), *rows)
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |" for cells in lines)
