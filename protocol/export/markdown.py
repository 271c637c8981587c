"""The interface definition as Markdown tables."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Final

from starhil.protocol.export import describe, wire
from starhil.protocol.export.templates import fill
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.icd.codec import Row
from starhil.protocol.icd.quoting import markdown, one_line

_ROW_COLUMNS: Final = ("ID", "Name", "Bytes", "Source")
_SOURCE: Final = describe.FIELD_COLUMNS.index("Source")


def render(icd: InterfaceDefinition) -> str:
    """Return the definition as Markdown: rows, parameters, enumerations, links."""
    groups = [(heading, list(_series(rows))) for heading, rows in describe.sections(icd)]
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
        title=_title,
        fields=_fields,
        table=lambda columns, rows: _table(map(markdown, columns), (map(markdown, row) for row in rows)),
    )


def _series(rows: Iterable[Row]) -> Iterator[list[Row]]:
    """Yield rows in groups; rows with consecutive IDs that differ only in name and number are one group."""
    group: list[Row] = []
    for row in rows:
        if group and _same(group[-1], row):
            group.append(row)
            continue
        if group:
            yield group
        group = [row]
    if group:
        yield group


def _same(before: Row, row: Row) -> bool:
    same_class = before.message_class == row.message_class and before.id + 1 == row.id
    return same_class and _description(before) == _description(row)


def _description(row: Row) -> tuple[object, ...]:
    return row.doc, describe.facts(row), list(describe.field_cells(row))


def _title(rows: Sequence[Row]) -> str:
    """Return the heading of one row, or of a group of equal ones."""
    first, last = rows[0], rows[-1]
    if first is last:
        return describe.title(first)
    message_class = f"{first.message_class} " if first.message_class else ""
    return f"{message_class}{first.id} to {last.id} (0x{first.id:02X} to 0x{last.id:02X}) {first.name} to {last.name}"


def _index(groups: Sequence[Sequence[Row]]) -> str:
    """Return the table of a section's rows, with links to each."""
    cells = (
        (str(row.id), _link(row.name, _title(rows)), str(row.size), row.provenance)
        for rows in groups
        for row in rows
    )
    return _table(_ROW_COLUMNS, cells)


def _fields(row: Row) -> str:
    """Return the table of a row's fields, without empty columns; a source is given where it is not the row's."""
    cells = [list(field) for field in describe.field_cells(row)]
    for field in cells:
        if field[_SOURCE] == row.provenance:
            field[_SOURCE] = ""
    shown = [column for column in range(len(describe.FIELD_COLUMNS)) if any(field[column] for field in cells)]
    rows = ([markdown(field[column]) for column in shown] for field in cells)
    return _table((describe.FIELD_COLUMNS[column] for column in shown), rows)


def _link(text: str, heading: str) -> str:
    """Return a link to a heading, by the anchor that GitHub and others generate."""
    anchor = "".join(letter for letter in one_line(heading).lower() if letter.isalnum() or letter in " -_")
    return f"[{markdown(text)}](#{anchor.replace(' ', '-')})"


def _table(columns: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Return a table of cells that are Markdown already."""
    head = list(columns)
    lines = (head, ["---"] * len(head), *rows)
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |" for cells in lines)
