"""The interface definition as Markdown tables."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from starhil.protocol.definition import InterfaceDefinition
from starhil.protocol.export import describe, wire
from starhil.protocol.quoting import markdown, one_line
from starhil.protocol.values import Section


def render(icd: InterfaceDefinition) -> str:
    """Return the definition as Markdown: rows, parameters, enumerations, links."""
    return "\n".join(_lines(icd)) + "\n"


def _lines(icd: InterfaceDefinition) -> Iterator[str]:
    yield f"# {markdown(f'Interface definition {icd.name} {icd.version}')}"
    for paragraph in (icd.doc, *describe.introduction(icd)):
        yield from ("", markdown(paragraph))
    yield ""
    after = (*describe.reference(icd), *wire.sections(icd))
    headings = [section.heading for section in icd.sections]
    headings += [heading for heading, _ in describe.sections(icd)]
    for heading in [*headings, *(section.heading for section in after)]:
        yield f"- {_link(heading, heading)}"
    for section in icd.sections:
        yield from _section(section)
    examples = describe.examples(icd)
    for heading, rows in describe.sections(icd):
        yield from ("", f"## {heading}", "")
        yield from _table(
            ("ID", "Name", "Bytes", "Source", "Meaning"),
            (
                (
                    str(row.id),
                    _link(row.name, describe.title(row)),
                    str(row.size),
                    row.provenance,
                    markdown(row.doc),
                )
                for row in rows
            ),
        )
        for row in rows:
            yield from (
                "",
                f"### {describe.title(row)}",
                "",
                markdown(row.doc),
                "",
                f"{markdown(describe.facts(row))}.",
            )
            if row.fields:
                yield ""
                yield from _text_table(describe.FIELD_COLUMNS, describe.field_cells(row))
            for example in examples[row.name]:
                yield from ("", markdown(describe.example_text(example)))
    for section in after:
        yield from _section(section)


def _section(section: Section) -> Iterator[str]:
    yield from ("", f"## {markdown(section.heading)}")
    for paragraph in section.paragraphs:
        yield from ("", markdown(paragraph))
    yield ""
    yield from _text_table(section.columns, section.rows)


def _link(text: str, heading: str) -> str:
    """Return a link to a heading, by the anchor that GitHub and others generate."""
    anchor = "".join(letter for letter in one_line(heading).lower() if letter.isalnum() or letter in " -_")
    return f"[{markdown(text)}](#{anchor.replace(' ', '-')})"


def _text_table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> Iterator[str]:
    yield from _table([markdown(column) for column in columns], (map(markdown, row) for row in rows))


def _table(columns: Sequence[str], rows: Iterable[Iterable[str]]) -> Iterator[str]:
    """Yield a table of cells that are Markdown already."""
    yield _row(columns)
    yield _row(["---"] * len(columns))
    yield from map(_row, rows)


def _row(cells: Iterable[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"
