"""`starhil unit`: list, create, check and describe units."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from starhil.emulator.cli.options import names_of
from starhil.emulator.cli.output import print_text
from starhil.emulator.errors import EmulatorError, explained
from starhil.protocol.files.bundled import DEFAULT_UNIT, SKELETON, bundled_units
from starid.cli.options import AsJson

group = typer.Typer(
    help="List, create, check and describe units. A unit is the interface of a star tracker: a folder of TOML files that define "
    "its telecommands, telemetry and links.",
    no_args_is_help=True,
)

_ROW_KEYS = ("kind", "message_class", "id", "name", "size", "action", "provenance")
_FIELD_KEYS = ("name", "offset", "type", "unit", "value", "argument", "parameter", "const")

UnitArgument = Annotated[
    str,
    typer.Argument(
        metavar="UNIT",
        help="Name of a bundled unit, or a folder of TOML files.",
        autocompletion=names_of("unit"),
    ),
]


@group.command("list")
def list_units(as_json: AsJson = False) -> None:
    """List the bundled units."""
    from starhil.protocol.unit import load_unit

    units = {name: load_unit(name) for name in bundled_units()}
    if as_json:
        print(json.dumps([{"unit": name, **_summary(icd)} for name, icd in units.items()]))
        return
    lines = [
        (
            f"{name} (default)" if name == DEFAULT_UNIT else name,
            ", ".join(_links(icd)),
            _count(len(icd.telecommands), "telecommand"),
            _count(len(icd.telemetry), "telemetry row"),
            icd.doc,
        )
        for name, icd in units.items()
    ]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    for line in lines:
        print("  ".join(text.ljust(width) for text, width in zip(line, widths, strict=True)).rstrip())


@group.command("new")
def new(
    folder: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="Folder to create; it must not contain TOML files.")
    ],
) -> None:
    """Create a unit: a commented definition that already runs, as a starting point."""
    from starid.storage.files import write_atomically

    if folder.exists() and (not folder.is_dir() or any(folder.glob("*.toml"))):
        raise EmulatorError(f"{folder}: is a file, or contains TOML files; choose another folder")
    name = folder.resolve().name
    text = SKELETON.read_text(encoding="utf-8").replace("MY_UNIT", name.replace('"', "").replace("\\", ""))
    file = folder / "unit.toml"
    with explained(f"{file}: cannot be written", "choose another folder"):
        write_atomically(file, lambda temporary: temporary.write_text(text, encoding="utf-8"))
    print(f"wrote {file}; try: starhil unit check {folder}; starhil run --unit {folder} --serial auto")


@group.command("check")
def check(
    unit: UnitArgument,
    no_plugin: Annotated[
        bool,
        typer.Option(
            "--no-plugin",
            help="Do not run the Python file that the unit names as its plugin; what it defines is then not checked.",
        ),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Check a unit: list all errors, or show an example exchange of each row in hexadecimal.

    This runs the unit's plugin, a Python file, if it has one, and calls its quantities: check a unit from elsewhere with
    --no-plugin. The exit status is 0 if there are no errors, otherwise 1.
    """
    from starhil.protocol.export.describe import value_text
    from starhil.protocol.unit.examples import examine

    definition, errors, examples = examine(unit, run_plugin=not no_plugin)
    skipped = definition.plugin.skipped if no_plugin else None
    if definition.plugin.quantities and not errors:
        from starhil.emulator.device.plugin_check import failing_quantities
        from starhil.emulator.profile import Profile

        errors = failing_quantities(definition, Profile.model_validate({"unit": unit}))
    if as_json:
        shown = [
            {
                "row": item.row.name,
                "link": item.link,
                "request": item.request,
                "answers": item.answers,
                "values": {
                    name: value.hex() if isinstance(value, bytes) else value
                    for name, value in item.values.items()
                },
            }
            for item in examples
        ]
        print(json.dumps({"unit": unit, "errors": errors, "examples": shown, "skipped_plugin": skipped}))
    else:
        for text in errors:
            print_text(text + "\n")
        if skipped:
            print_text(f"{skipped} was not run: its names, and examples on its link, are not checked\n")
        for item in examples:
            print(
                f"{item.row.kind} {item.row.name}, ID 0x{item.row.id:02X}, {item.row.size} B, on {item.link}"
            )
            for name, value in item.values.items():
                print(f"    {name} = {value_text(value)}")
            for frame in item.request:
                print(f"  > {frame}")
            for frame in item.answers:
                print(f"  < {frame}")
        print(f"{unit}: {_count(len(errors), 'error')}" if errors else f"{unit}: no errors")
    raise typer.Exit(1 if errors else 0)


@group.command("describe")
def describe(unit: UnitArgument = DEFAULT_UNIT, as_json: AsJson = False) -> None:
    """Describe a unit: links, conventions, and the binding of each field."""
    from starhil.protocol.unit import load_unit

    icd = load_unit(unit)
    if as_json:
        print(json.dumps({**_summary(icd), "rows": [_row(row) for row in icd.rows]}))
        return
    conventions = icd.conventions
    print(f"{icd.name} {icd.version}: {icd.doc}")
    print(f"links: {', '.join(_links(icd)) or 'none'}")
    print(
        f"conventions: quaternion as {conventions.quaternion}, scalar {conventions.scalar_sign}, "
        f"axes {', '.join(conventions.axes)}, time since {conventions.epoch}, {conventions.byte_order}-endian"
    )
    for item in icd.classes:
        code = "none" if item.code is None else str(item.code)
        print(f"class {item.name}: {item.kind.value}, code {code}")
    for row in icd.rows:
        message_class = f"{row.message_class} " if row.message_class else ""
        action = "" if row.action is None else f", action {row.action}"
        print(f"{message_class}{row.id} {row.kind} {row.name}: {row.size} B{action}, {row.provenance}")
        for field in row.named_fields.values():
            unit_text = f" {field.unit}" if field.unit else ""
            print(f"    {field.offset:4d} {field.name}: {field.type}{unit_text}{_binding(field)}")


@group.command("bindings")
def bindings(as_json: AsJson = False) -> None:
    """List what the rows of a unit can be bound to: quantities, actions and their arguments, and parameters."""
    from starhil.protocol.icd.device_model import device_model

    model = device_model()
    if as_json:
        kinds = {"quantities": model.quantities, "actions": model.actions, "parameters": model.parameters}
        shown = {kind: [item.model_dump() for item in items.values()] for kind, items in kinds.items()}
        print(json.dumps(shown))
        return
    for quantity in model.quantities.values():
        print(_bound("value", quantity.name, quantity.unit, quantity.doc))
    for action in model.actions.values():
        print(_bound("action", action.name, "", action.doc))
        for argument in action.arguments:
            print(_bound("  argument", argument.name, argument.unit, argument.doc))
    for parameter in model.parameters.values():
        print(_bound("parameter", parameter.name, parameter.unit, parameter.doc))


def _bound(key: str, name: str, unit: str, doc: str) -> str:
    return f'{key} = "{name}"  {f"{unit}: " if unit else ""}{doc}'


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"


def _binding(field: Any) -> str:
    for name, arrow in (("value", "<-"), ("argument", "->"), ("parameter", "parameter"), ("const", "=")):
        bound = getattr(field, name)
        if bound is not None:
            return f" {arrow} {bound}"
    return ""


def _links(icd: Any) -> list[str]:
    serial, can = icd.link.serial, icd.link.can
    links = [] if serial is None else [f"serial ({serial.framing.kind})"]
    links += [] if can is None else [f"CAN ({can.kind})"]
    return links + ([] if icd.canopen is None else ["CANopen"])


def _summary(icd: Any) -> dict[str, Any]:
    return {
        "name": icd.name,
        "version": icd.version,
        "doc": icd.doc,
        "links": _links(icd),
        "telecommands": len(icd.telecommands),
        "telemetry": len(icd.telemetry),
        "parameters": len(icd.parameters),
    }


def _row(row: Any) -> dict[str, Any]:
    named = {"class" if key == "message_class" else key: getattr(row, key) for key in _ROW_KEYS}
    fields = [{key: getattr(field, key) for key in _FIELD_KEYS} for field in row.named_fields.values()]
    return {**named, "fields": fields}
