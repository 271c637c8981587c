"""The interface definition as Markdown tables."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from starhil.protocol.codec import Row
from starhil.protocol.export import describe, wire
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.values import Section


def render(icd: InterfaceDefinition) -> str:
    """Return the definition as Markdown: rows, parameters, enumerations, links."""
    return "\n".join(_lines(icd)) + "\n"


def _lines(icd: InterfaceDefinition) -> Iterator[str]:
    yield f"# Interface definition {icd.name} {icd.version}"
    yield ""
    yield icd.doc
    for paragraph in describe.introduction(icd):
        yield ""
        yield paragraph
    yield ""
    yield from _contents(icd)
    for section in icd.sections:
        yield from _section(section)
    for heading, rows in describe.sections(icd):
        yield from ("", f"## {heading}", "")
        yield from _table(
            ("ID", "Name", "Bytes", "Source", "Meaning"),
            ((str(row.id), _link(row), str(row.size), row.provenance, row.doc) for row in rows),
        )
        for row in rows:
            yield from ("", f"### {describe.title(row)}", "", row.doc, "", f"{describe.facts(row)}.")
            if row.fields:
                yield ""
                yield from _table(
                    describe.FIELD_COLUMNS, (describe.field_cells(row, field) for field in row.fields)
                )
    for section in (*describe.reference(icd), *wire.sections(icd)):
        yield from _section(section)


def _section(section: Section) -> Iterator[str]:
    yield from ("", f"## {section.heading}")
    for paragraph in section.paragraphs:
        yield from ("", paragraph)
    yield ""
    yield from _table(section.columns, section.rows)


def _contents(icd: InterfaceDefinition) -> Iterator[str]:
    headings = [section.heading for section in icd.sections]
    headings += ["Telecommands", "Telemetry", "Parameters", "Enumerations"]
    for heading in [*headings, *(section.heading for section in wire.sections(icd))]:
        yield f"- [{heading}](#{heading.lower().replace(' ', '-')})"


def _link(row: Row) -> str:
    """Return a link to a row's heading, by the anchor that GitHub and others generate."""
    anchor = "".join(letter for letter in describe.title(row).lower() if letter.isalnum() or letter in " -_")
    return f"[{row.name}](#{anchor.replace(' ', '-')})"


def _table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> Iterator[str]:
    yield _row(columns)
    yield _row(["---"] * len(columns))
    for row in rows:
        yield _row(row)


def _row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"
