"""`starhil icd`: list and export the interface definition."""

from __future__ import annotations

import json
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from starhil.emulator.cli.options import Unit
from starhil.emulator.cli.output import print_text, writing
from starhil.emulator.errors import EmulatorError
from starhil.protocol.files.bundled import DEFAULT_UNIT
from starid.cli.options import AsJson
from starid.cli.output import output_help

group = typer.Typer(help="List or export the interface definition.", no_args_is_help=True)


_ROW_KEYS = ("id", "kind", "name", "size", "provenance")
_PARAMETER_KEYS = ("id", "name", "unit", "default")


class Format(StrEnum):
    """Formats of an export."""

    MARKDOWN = "markdown"
    HTML = "html"
    DBC = "dbc"
    EDS = "eds"
    XTCE = "xtce"
    COSMOS = "cosmos"
    C = "c"
    COSMOS_PLUGIN = "cosmos-plugin"


@group.command()
def export(
    format_: Annotated[
        Format,
        typer.Argument(metavar="FORMAT", help="markdown, html, dbc, eds, xtce, cosmos, c or cosmos-plugin."),
    ],
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            help=output_help(
                "File to write; default: stdout. For c and cosmos-plugin: folder for the files."
            ),
        ),
    ] = None,
    unit: Unit = DEFAULT_UNIT,
    rows: Annotated[
        str | None,
        typer.Option(
            metavar="NAME,…", help="For c: code for these telecommands and telemetry rows; default: all."
        ),
    ] = None,
) -> None:
    """Export the interface definition in another format.

    markdown and html are for readers, dbc for CAN tools, eds for CANopen masters, xtce, cosmos
    and cosmos-plugin for ground software, c for flight software.
    """
    from starhil.protocol import export as formats
    from starhil.protocol.unit import load_unit

    definition, name = load_unit(unit), format_.value
    if rows is not None and format_ is not Format.C:
        raise EmulatorError(f"icd export {name}: --rows is for c only")
    if name in formats.FOLDER_FORMATS:
        if output is None or output.is_file():
            raise EmulatorError(f"icd export {name}: writes several files; name a folder with -o")
        chosen = {} if rows is None else {"rows": [row.strip() for row in rows.split(",")]}
        for path, text in formats.export_folder(definition, name, **chosen).items():
            _write(output / path, text, unit)
        return
    text = formats.export(definition, name)
    if output is None:
        print_text(text)
    else:
        _write(output, text, unit)


def _write(path: Path, text: str, unit: str) -> None:
    from starid.storage.files import write_atomically

    with writing(path, Path(unit).glob("*")):
        write_atomically(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


@group.command("list")
def list_rows(unit: Unit = DEFAULT_UNIT, as_json: AsJson = False) -> None:
    """List telecommands, telemetry and parameters, one per line."""
    from starhil.protocol.unit import load_unit

    definition = load_unit(unit)
    if as_json:
        rows = [{key: getattr(row, key) for key in _ROW_KEYS} for row in definition.rows]
        parameters = [
            {key: getattr(p, key) for key in _PARAMETER_KEYS} for p in definition.parameters.values()
        ]
        head = {"name": definition.name, "version": definition.version}
        print(json.dumps({**head, "rows": rows, "parameters": parameters}))
        return
    for row in definition.rows:
        print(f"{row.id:4d}  {row.kind:11s}  {row.size:4d} B  {row.provenance:9s}  {row.name}")
    for parameter in definition.parameters.values():
        unit = f" {parameter.unit}" if parameter.unit else ""
        print(f"{parameter.id:4d}  parameter    {parameter.default!s:>6}{unit}  {parameter.name}")
