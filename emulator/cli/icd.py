"""`starhil icd`: list and export the interface definition."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from starhil.emulator.cli.options import AsJson, Unit
from starhil.emulator.cli.output import output_help, prepare_output, print_text
from starhil.protocol.unit_folders import DEFAULT_UNIT

group = typer.Typer(help="List or export the interface definition.", no_args_is_help=True)


class Format(StrEnum):
    """Formats of an export."""

    MARKDOWN = "markdown"
    HTML = "html"
    DBC = "dbc"
    EDS = "eds"
    XTCE = "xtce"
    COSMOS = "cosmos"


@group.command()
def export(
    format_: Annotated[
        Format, typer.Argument(metavar="FORMAT", help="markdown, html, dbc, eds, xtce or cosmos.")
    ],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help=output_help("File to write; default: stdout.")),
    ] = None,
    unit: Unit = DEFAULT_UNIT,
) -> None:
    """Export the interface definition in another format.

    markdown and html are for readers, dbc for CAN tools, eds for CANopen masters, xtce and
    cosmos for ground software.
    """
    from starhil.protocol.export import export as render
    from starhil.protocol.icd import load_unit

    text = render(load_unit(unit), format_.value)
    if output is None:
        print_text(text)
    else:
        _write(output, text)


def _write(path: Path, text: str) -> None:
    """Write a file atomically."""
    from starhil.emulator.errors import EmulatorError
    from starid.files import write_atomically

    prepare_output(path, "-o")
    try:
        write_atomically(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))
    except OSError as error:
        raise EmulatorError(
            f"{path}: cannot be written ({error.strerror}); choose another file with -o"
        ) from None


@group.command("list")
def list_rows(
    unit: Unit = DEFAULT_UNIT,
    as_json: AsJson = False,
) -> None:
    """List telecommands, telemetry and parameters, one per line."""
    import json

    from starhil.protocol.icd import load_unit

    definition = load_unit(unit)
    if as_json:
        print(
            json.dumps(
                {
                    "name": definition.name,
                    "version": definition.version,
                    "rows": [
                        {
                            "id": r.id,
                            "kind": r.kind,
                            "name": r.name,
                            "size": r.size,
                            "provenance": r.provenance,
                        }
                        for r in definition.rows
                    ],
                    "parameters": [
                        {"id": p.id, "name": p.name, "unit": p.unit, "default": p.default}
                        for p in definition.parameters.values()
                    ],
                }
            )
        )
        return
    for row in definition.rows:
        print(f"{row.id:4d}  {row.kind:11s}  {row.size:4d} B  {row.provenance:9s}  {row.name}")
    for parameter in definition.parameters.values():
        unit = f" {parameter.unit}" if parameter.unit else ""
        print(f"{parameter.id:4d}  parameter    {parameter.default!s:>6}{unit}  {parameter.name}")
