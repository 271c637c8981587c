"""The interface definition as one self-contained HTML page."""

from __future__ import annotations

from starhil.protocol.export import describe, wire
from starhil.protocol.export.templates import fill
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.icd.quoting import html_text


def render(icd: InterfaceDefinition) -> str:
    """Return the definition as an HTML page: rows, parameters, enumerations."""
    sections = (*icd.sections, *describe.reference(icd), *wire.sections(icd))
    anchored = [(f"section-{number}", section) for number, section in enumerate(sections)]
    return fill(
        "page.html.j2",
        icd=icd,
        heading=f"Interface definition {icd.name} {icd.version}",
        before=anchored[: len(icd.sections)],
        groups=list(describe.sections(icd)),
        after=anchored[len(icd.sections) :],
        examples=describe.examples(icd),
        describe=describe,
        quoted=html_text,
        confirmed=lambda rows: [("confirmed", row) for row in rows],
        sourced=lambda row: [
            (field.provenance, cells)
            for field, cells in zip(row.fields, describe.field_cells(row), strict=True)
        ],
    )
