"""Reference tables of the documentation, made from the code, the schemas and the device model.

A page contains its own text and, between two comments with the name of a table, the table written here::

    <!-- begin: profile -->
    …
    <!-- end: profile -->

`tools/make_reference.py` updates these. In place of a table too long to be read as text stands a line that ends in a mark,
`<!-- built: commands -->`, which `make docs` and `starhil docs` replace.
"""

from __future__ import annotations

import ast
import dataclasses
import inspect
import json
import re
import textwrap
from collections.abc import Callable, Container, Iterator, Mapping
from itertools import groupby
from typing import Any, Final, get_args, get_origin, get_type_hints

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from starhil.emulator.truth.config import models_in

UNITS: Final = {
    "anomaly_s": "1/s",
    "baud": "Bd",
    "cosmic_rays_s": "1/s",
    "drift_ppm": "ppm",
    "drift_ppm_c": "ppm/°C",
    "epoch": "Julian year",
    "false_star_magnitudes": "V",
    "height": "px",
    "magnitude": "V",
    "quiet_s": "1/s",
    "rate_window": "frames",
    "split": "bytes",
    "star_magnitude_noise": "mag",
    "start_unix_s": "s, Unix time",
    "width": "px",
}
"""Units of keys whose names do not end in a unit."""

SUFFIXES: Final = {
    "_deg_s2": "°/s²",
    "_deg_s": "°/s",
    "_m_s": "m/s",
    "_km": "km",
    "_m": "m",
    "_deg": "°",
    "_px": "px",
    "_s": "s",
}
"""Suffix of a key → unit, longest first."""

CHOICES: Final = {"bits": "`8`, `12`, `16`"}
"""Values of keys that are not all of a range."""

PARAMETER_FIELDS: Final = ("exposure_s", "gain")
"""Fields of the sensor model that are parameters of the device, not keys of `[sensor]`."""

EXPONENT_FROM: Final = 1e6
"""Numbers from here on are shown with an exponent if no digits are lost."""

Row = tuple[str, ...]
HEAD: Final[Row] = ("key", "range", "default", "meaning")


# --- parts of a table ---


def table(rows: list[Row], head: Row = HEAD) -> str:
    """Return a Markdown table without its empty columns; rows that differ only in their key are one."""
    alike = [(key, list(group)) for key, group in groupby(rows, key=lambda row: row[1:])]
    rows = [(", ".join(row[0] for row in group), *key) for key, group in alike]
    shown = [column for column in range(len(head)) if any(row[column] for row in rows)]
    lines = [
        "| " + " | ".join(row[column].replace("|", "\\|") for column in shown) + " |" for row in (head, *rows)
    ]
    return "\n".join([lines[0], "|" + "---|" * len(shown), *lines[1:]])


def unit(key: str) -> str:
    """Return the unit of a key, empty if it has none."""
    return UNITS.get(key) or next((name for end, name in SUFFIXES.items() if key.endswith(end)), "")


def in_unit(values: str, of: str) -> str:
    """Return a range in a unit, each of which may be empty."""
    return " ".join(filter(None, (values, of)))


def literal(value: object) -> str:
    """Format a value as in a TOML file."""
    if isinstance(value, BaseModel):
        items = value.model_dump(exclude_none=True).items()
        return "`{ " + ", ".join(f"{key} = {json.dumps(item)}" for key, item in items) + " }`"
    if value is None or value in ({}, ""):
        return ""
    if isinstance(value, float) and value >= EXPONENT_FROM and float(f"{value:g}") == value:
        return f"`{value:g}`"
    plain = list(value) if isinstance(value, tuple) else value
    return f"`{json.dumps(plain, ensure_ascii=False)}`"


def plain_text(text: str) -> str:
    """Return a docstring as one line of Markdown: ``name`` becomes `name`."""
    return " ".join(text.replace("``", "`").split())


def attribute_docstrings(model: type, *, grouped: bool = False) -> dict[str, str]:
    """Return the docstring under each field of a class; if `grouped`, it also describes the bare fields above it.

    Raises
    ------
    SystemExit
        A field has no docstring; the message names it.
    """
    texts: dict[str, str] = {}
    for kind in reversed(model.__mro__):
        if kind.__module__.startswith(("starhil.", "starid.")):
            texts |= {name: text or texts.get(name, "") for name, text in _own_docstrings(kind).items()}
    if grouped:
        text = ""
        for name in reversed(texts):
            text = texts[name] = texts[name] or text
    bare = [name for name, text in texts.items() if not text and not name.startswith("_")]
    if bare:
        raise SystemExit(
            f"{model.__module__}.{model.__qualname__}.{bare[0]}: has no docstring; write one under it"
        )
    return texts


def _own_docstrings(kind: type) -> dict[str, str]:
    """Return the docstring under each field that a class itself declares; empty if there is none."""
    module = ast.parse(textwrap.dedent(inspect.getsource(kind)))
    body = next(node.body for node in module.body if isinstance(node, ast.ClassDef))
    texts: dict[str, str] = {}
    for statement, after in zip(body, [*body[1:], None], strict=True):
        if isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name):
            text = after.value if isinstance(after, ast.Expr) else None
            texts[statement.target.id] = plain_text(str(text.value)) if isinstance(text, ast.Constant) else ""
    return texts


def documented_names(item: Any) -> dict[str, str]:
    """Return name → description from the sections of a numpy docstring."""
    lines = inspect.cleandoc(item.__doc__ or "").splitlines()
    texts: dict[str, str] = {}
    names: list[str] = []
    for line, after in zip(lines, [*lines[1:], ""], strict=True):
        if line.startswith("    "):
            for name in names:
                texts[name] = f"{texts.get(name, '')} {line.strip()}".strip()
        elif line and not after.startswith("---"):
            names = [name.strip() for name in line.partition(" : ")[0].split(",")]
    return {name: plain_text(text) for name, text in texts.items()}


# --- pydantic models ---


def limits(schema: Mapping[str, Any]) -> str:
    """Describe the values that a JSON schema allows."""
    alternatives = [inner for inner in schema.get("anyOf", ()) if inner.get("type") != "null"]
    if alternatives:
        return limits(alternatives[0]) if len(alternatives) == 1 else ""
    if "enum" in schema or "const" in schema:
        return ", ".join(f"`{item}`" for item in schema.get("enum", [schema.get("const")]))
    if schema.get("type") == "array":
        items = limits(schema.get("items", {}))
        least, most = schema.get("minItems"), schema.get("maxItems")
        count = f"{least} values" if least == most and least else f"up to {most} values" if most else "list"
        if items.startswith(count):  # a matrix
            return items.replace(count, f"{count.removesuffix(' values')} × {count}", 1)
        return f"{count}, each {items}" if items else count
    low, high = schema.get("minimum"), schema.get("maximum")
    if "exclusiveMinimum" in schema:
        above = f"above {schema['exclusiveMinimum']:g}"
        return above if high is None else f"{above}, to {high:g}"
    if low is None:
        return "" if schema.get("type") != "boolean" else "`true`, `false`"
    if high is None:
        return f"{low:g} or more"
    if schema.get("format") == "hex":
        return f"{low:#x} to 0x{high:X}" if low else f"0 to 0x{high:X}"
    return f"{number(low)} to {number(high)}"


def number(value: float) -> str:
    """Format a number as short as possible."""
    return f"{value:g}" if isinstance(value, float) else str(value)


def model_rows(model: type[BaseModel]) -> list[Row]:
    """Return a row for each plain key of a model."""
    texts, properties = attribute_docstrings(model), model.model_json_schema()["properties"]
    return [
        (f"`{name}`", in_unit(limits(properties[name]), unit(name)), default(field), texts[name])
        for name, field in model.model_fields.items()
    ]


def default(field: FieldInfo, schema: Mapping[str, Any] | None = None) -> str:
    """Return the default of a field, in hexadecimal if its schema says so."""
    if field.is_required():
        return "required"
    if field.default and (schema or {}).get("format") == "hex":
        return f"`0x{field.default:02X}`"
    return "" if field.default is PydanticUndefined else literal(field.default)


# --- the tables ---


def profile() -> str:
    """Sections of a profile whose keys come from a model, except the truth."""
    from starhil.emulator.profile import Profile

    return "\n\n".join(section(name, text, field) for name, text, field in plain_sections(Profile))


def plain_sections(model: type[BaseModel], prefix: str = "") -> Iterator[tuple[str, str, type[BaseModel]]]:
    """Yield name, description and model of each section of a profile, including nested ones."""
    texts = attribute_docstrings(model)
    for name, field in model.model_fields.items():
        models = models_in(field.annotation)
        if len(models) != 1:
            continue
        (inner,) = models
        if all(models_in(item.annotation) for item in inner.model_fields.values()):
            yield from plain_sections(inner, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", texts[name], inner


def section(name: str, text: str, model: type[BaseModel]) -> str:
    """Return one section of a profile: heading and table."""
    return f"### `[{name}]`\n\n{text}\n\n{table(model_rows(model))}"


def truth() -> str:
    """The truth sources, segments of a slew, and an attitude."""
    from starhil.emulator.truth.config import AttitudeConfig, MountConfig, SegmentConfig, TruthConfig

    parts = [
        described(title, model)
        for title, model in (("An attitude", AttitudeConfig), ("A mount", MountConfig))
    ]
    return "\n\n".join(
        (*alternatives(TruthConfig, "`kind"), *alternatives(SegmentConfig, "Segment `do"), *parts)
    )


def orbit() -> str:
    from starhil.emulator.truth.config import OrbitConfig

    return "\n\n".join(alternatives(OrbitConfig, "`kind"))


def alternatives(annotation: Any, key: str) -> Iterator[str]:
    """Yield the section of each model of a union, with its distinguishing first key in the heading."""
    headings: dict[Row, str] = {}
    for model in models_in(annotation):
        title = f'{key} = "{kind_of(model)}"`'
        own, shared = apart(model_rows(model)[1:], headings)
        headings = {row: title.strip("`") for row in own} | headings
        parts = [f"### {title}", plain_text(model.__doc__ or ""), *shared]
        yield "\n\n".join([*parts, table(own)] if own else parts)


def described(title: str, model: type[BaseModel]) -> str:
    return f"### {title}\n\n{plain_text(model.__doc__ or '')}\n\n{table(model_rows(model))}"


def kind_of(model: type[BaseModel]) -> str:
    """Return the value of a model's first key, which distinguishes it from the alternatives."""
    field = next(iter(model.model_fields.values()))
    return str(get_args(field.annotation)[0])


def sensor() -> str:
    """Keys of `[sensor]`."""
    from starhil.emulator.sensor.model import SensorModel

    return table(dataclass_rows(SensorModel, PARAMETER_FIELDS))


def sky() -> str:
    """Keys of `[sky]` and of the tables in it."""
    from starhil.emulator.sensor.sky.objects import (
        CatalogError,
        Constellation,
        EarthLimb,
        Moon,
        Obstruction,
        PointSource,
        SkyObjects,
        SunGlare,
    )

    bodies = {
        "moon": Moon,
        "sun": SunGlare,
        "earth": EarthLimb,
        "planets": PointSource,
        "satellites": Constellation,
        "obstructions": Obstruction,
        "catalog_errors": CatalogError,
    }
    hints = get_type_hints(SkyObjects)
    parts = [table(dataclass_rows(SkyObjects, skipped=bodies))]
    for name, body in bodies.items():
        listed = get_origin(hints[name]) is tuple
        head = f"### `[[sky.{name}]]`" if listed else f"### `[sky.{name}]`"
        about = plain_text((body.__doc__ or "").partition("\n\n")[0])
        parts.append(f"{head}\n\n{about}\n\n{table(dataclass_rows(body))}")
    return "\n\n".join(parts)


def dataclass_rows(kind: Any, skipped: Container[str] = ()) -> list[Row]:
    """Return a row for each field of a dataclass of the sky or the sensor."""
    texts = attribute_docstrings(kind, grouped=True)
    rows: list[Row] = []
    for field in dataclasses.fields(kind):
        if field.name in skipped:
            continue
        low, high, of = field.metadata.get("limits", (None, None, ""))
        allowed = "" if low is None or high is None or low <= -1e5 else f"{number(low)} to {number(high)}"
        value = "required" if field.default is dataclasses.MISSING else literal(field.default)
        name, of_field = field.name, of or unit(field.name)
        allowed = in_unit(CHOICES.get(name, allowed), of_field)
        rows.append((f"`{name}`", allowed, value, texts[name]))
    return rows


def identifier() -> str:
    """Options of each algorithm, as the emulator accepts them in `[identifier]`."""
    from starhil.emulator.profile.profile import DEVICE_OPTIONS
    from starid.identification.options import ALGORITHMS

    parts = []
    for name, algorithm in ALGORITHMS.items():
        texts: dict[str, str] = {}
        for kind in reversed(inspect.getmro(algorithm.options)[:-1]):
            texts |= documented_names(kind)
        names = sorted(
            {field.name for field in dataclasses.fields(algorithm.options)} - DEVICE_OPTIONS.keys()
        )
        rows: list[Row] = [(f"`{option}`", "", "", texts[option]) for option in names]
        parts.append(f'### With `run.algorithm = "{name}"`\n\n{table(rows)}')
    return "\n\n".join(parts)


def faults() -> str:
    """Keys of the tables of a `fault` request, except optical faults, whose keys are those of `[sky]`."""
    from starhil.emulator.device.clock_errors import ClockFault
    from starhil.emulator.device.telemetry_faults import TelemetryFault
    from starhil.emulator.links.wire_faults import WireFault
    from starhil.emulator.run.faults import EFFECTS, DeviceFault
    from starhil.protocol.unit import load_unit

    enums = load_unit().enums
    rows: list[Row] = []
    for row, effect in zip(model_rows(DeviceFault), EFFECTS.values(), strict=True):
        allowed = ", ".join(f"`{name}`" for name in enums[effect.enum].values) if effect.enum else row[1]
        rows.append((row[0], allowed, row[2], row[3]))
    return (
        f"### `device`\n\n{table(rows)}\n\n### `clock`\n\n{table(model_rows(ClockFault))}\n\n### `telemetry`\n\n"
        "A table, or a list of tables. [FDIR tests](fdir.md) has examples; on CANopen, PDOs and SDO answers are affected.\n\n"
        f"{table(model_rows(TelemetryFault))}\n\n### `serial`, `can`\n\n"
        f"`can` is what the device sends on the CAN bus, CANopen included.\n\n{table(model_rows(WireFault))}"
    )


def scenario() -> str:
    from starhil.emulator.control.scenario import ScenarioEvent

    return table(model_rows(ScenarioEvent))


def unit_definition() -> str:
    """Tables and keys of the files of a unit."""
    from starhil.protocol.icd import canopen_schema, link_schema, values
    from starhil.protocol.icd import schema as icd_schema
    from starhil.protocol.icd.conventions import Conventions
    from starhil.protocol.messages import ErrorCode

    headings: dict[str, type[BaseModel]] = {
        "[unit]": icd_schema.UnitModel,
        "[conventions]": Conventions,
        "[[class]]": link_schema.MessageClass,
        "[[enum]]": values.EnumDefinition,
        "[[telecommand]], [[telemetry]]": icd_schema.RowModel,
        "fields": icd_schema.FieldModel,
        "bits": icd_schema.BitModel,
        "repeat": icd_schema.RepeatModel,
        "[[parameter]]": icd_schema.ParameterModel,
        "[link.serial]": link_schema.SerialLinkModel,
        "[[link.serial.format]]": link_schema.FormatModel,
        **headings_by_kind("framing", link_schema.FramingModel),
        "stuffing": link_schema.ByteStuffing,
        **headings_by_kind("check", link_schema.CheckModel),
        "request_header, reply_header": link_schema.HeaderFieldModel,
        "bits of a header": link_schema.HeaderBitModel,
        "[link.can]": link_schema.CubeSpaceCanModel,
        "[canopen]": canopen_schema.CanopenModel,
        "[[canopen.object]]": canopen_schema.PlacedObject,
        "packed": canopen_schema.PackedField,
        "members": canopen_schema.PlacedMember,
        "[[canopen.tpdo]], [[canopen.rpdo]]": canopen_schema.PdoModel,
    }
    parts: list[str] = []
    titles: dict[Row, str] = {}
    for heading, model in headings.items():
        texts = attribute_docstrings(model)
        schema = model.model_json_schema()
        properties = schema.get("properties") or schema["$defs"][model.__name__]["properties"]
        rows: list[Row] = [
            (f"`{key}`", limits(properties[key]), default(field, properties[key]), texts[name])
            for name, field in model.model_fields.items()
            for key in (field.alias or name,)
            if f'{key} = "' not in heading
        ]
        own, shared = apart(rows, titles)
        titles = dict.fromkeys(own, heading) | titles
        parts.append("\n\n".join([f"### `{heading}`", plain_text(model.__doc__ or ""), *shared]))
        if own:
            parts.append(table(own))
    numbers = "\n".join(f"| `{code.name.lower()}` | `{int(code)}` |" for code in ErrorCode)
    parts.append(
        "### `[errors]`\n\nThe number of each error on the wire, 0 to 0xFFFF. An error missing from an existing table is sent "
        f"as `other`, if given; `ok` keeps its default.\n\n| key | default |\n|---|---|\n{numbers}\n| `other` | |"
    )
    return "\n\n".join(parts)


def headings_by_kind(key: str, union: Any) -> dict[str, type[BaseModel]]:
    """Return the models of a union that `kind` selects, each with its heading."""
    return {
        f'{key} = {{ kind = "{get_args(model.model_fields["kind"].annotation)[0]}" }}': model
        for model in get_args(get_args(union)[0])
    }


def apart(rows: list[Row], headings: Mapping[Row, str]) -> tuple[list[Row], list[str]]:
    """Return rows without those that an earlier table has too, and a line for each earlier table with several of them."""
    elsewhere: dict[str, list[Row]] = {}
    for row in rows:
        elsewhere.setdefault(headings.get(row, ""), []).append(row)
    shared = {heading: same for heading, same in elsewhere.items() if heading and len(same) > 1}
    lines = [
        f"Also, as in `{heading}`: {', '.join(row[0] for row in same)}." for heading, same in shared.items()
    ]
    return [row for row in rows if headings.get(row) not in shared], lines


def quantities() -> str:
    """Every quantity of the device."""
    from starhil.protocol.icd.device_model import device_model

    model = device_model()
    rows: list[Row] = []
    for item in model.quantities.values():
        kind = item.type if item.enum is None else f"name: {', '.join(model.enums[item.enum].values)}"
        count = f" n from 1 to {item.count}." if item.count else ""
        rows.append((f"`{item.name}`", kind, item.unit, item.doc + count))
    return table(rows, ("quantity", "type", "unit", "meaning"))


def snapshot() -> str:
    """What a custom quantity can read: a snapshot, and the records in it."""
    from starhil.emulator.device.counters import Acknowledge, Counters
    from starhil.emulator.device.measurement import Measurement
    from starhil.emulator.device.parameters import ParameterState
    from starhil.emulator.device.power import FrameTiming, ThermalState
    from starhil.emulator.device.reported import Reported
    from starhil.emulator.device.snapshot import Constants, Snapshot
    from starhil.emulator.device.stored_images import FileState, ImageState, StoredImage
    from starhil.emulator.sensor.pipeline.messages import FrameResult, MatchedStar

    return "\n\n".join(
        f"### `{kind.__name__}`\n\n{plain_text((kind.__doc__ or '').splitlines()[0])}\n\n"
        + table(record_rows(kind), ("field", "type", "meaning"))
        for kind in (
            *(
                Snapshot,
                Constants,
                Measurement,
                FrameResult,
                MatchedStar,
                Reported,
                FrameTiming,
                ThermalState,
            ),
            *(ParameterState, Counters, Acknowledge, ImageState, FileState, StoredImage),
        )
    )


def record_rows(kind: type) -> list[Row]:
    """Return a row for each field and each computed value of a record."""
    texts = attribute_docstrings(kind, grouped=True)
    types = {field.name: str(field.type) for field in dataclasses.fields(kind)}
    for name, item in vars(kind).items():
        function = (
            getattr(item, "fget", None) or getattr(item, "function", None) or getattr(item, "func", None)
        )
        if function is not None:
            types[name], texts[name] = function.__annotations__["return"], plain_text(item.__doc__)
    return [(f"`{name}`", f"`{types[name]}`", texts[name]) for name in types]


def actions() -> str:
    """Every action of the device model and its arguments."""
    from starhil.protocol.icd.device_model import device_model

    rows: list[Row] = []
    for action in device_model().actions.values():
        rows.append((f"`{action.name}`", "", "", "", "", action.doc))
        for item in action.arguments:
            value = "required" if item.required else literal(item.default)
            kind = item.type if item.enum is None else f"name of {item.enum}"
            rows.append(("", f"`{item.name}`", kind, item.unit, value, item.doc))
    return table(rows, ("action", "argument", "type", "unit", "default", "meaning"))


def device_parameters() -> str:
    from starhil.protocol.icd.device_model import device_model

    rows: list[Row] = [
        (
            f"`{item.name}`",
            item.unit,
            "" if item.type in ("bool", "enum8") else f"{number(item.minimum)} to {number(item.maximum)}",
            literal(item.default),
            item.doc,
        )
        for item in device_model().parameters.values()
    ]
    return table(rows)


def commands() -> str:
    """Every command of both programs, with its arguments and options."""
    return "\n\n".join(command_part(name, command) for name, command in each_command())


def command_list() -> str:
    """Every command of both programs in one line: its arguments, and what it does."""
    rows: list[Row] = []
    for name, command in each_command():
        arguments = (item for item in command.params if item.param_type_name == "argument")
        usage = " ".join([name, *(argument_usage(item) for item in arguments)])
        rows.append((f"`{usage}`", plain_text(inspect.cleandoc(command.help or "").split("\n\n")[0])))
    return table(rows, ("command", "what it does"))


def each_command() -> Iterator[tuple[str, Any]]:
    """Yield name and command, those in groups included."""
    import typer.main

    from starhil.emulator.cli import app as starhil
    from starid.cli import app as starid

    for program in (starhil, starid):
        app: Any = typer.main.get_command(program.build_app())
        for name in program.COMMANDS:
            group = getattr(app.commands[name], "commands", None)
            if group is None:
                yield f"{app.name} {name}", app.commands[name]
            else:
                inner = ((key, item) for key, item in group.items() if not item.hidden)
                yield from ((f"{app.name} {name} {key}", item) for key, item in inner)


def command_part(name: str, command: Any) -> str:
    shown = [parameter for parameter in command.params if not getattr(parameter, "hidden", False)]
    arguments = [parameter for parameter in shown if parameter.param_type_name == "argument"]
    usage = " ".join([name, *("[options]",), *(argument_usage(item) for item in arguments)])
    rows = ["| option | default | meaning |\n|---|---|---|", *(option_row(item) for item in shown)]
    text = "\n\n".join(plain_text(part) for part in inspect.cleandoc(command.help or "").split("\n\n"))
    return f"## {name}\n\n{text}\n\n    {usage}\n\n" + "\n".join(rows)


def argument_usage(parameter: Any) -> str:
    name = argument_name(parameter) + ("…" if parameter.nargs == -1 else "")
    return name if parameter.required else f"[{name}]"


def argument_name(parameter: Any) -> str:
    """Return the name of an argument, without the underscore that avoids hiding a Python name."""
    return str(parameter.name).rstrip("_").upper()


def option_row(parameter: Any) -> str:
    argument = parameter.param_type_name == "argument"
    names = [argument_name(parameter)] if argument else [*parameter.opts, *parameter.secondary_opts]
    value = "required" if parameter.required else shown_default(parameter.default)
    low, high = getattr(parameter, "min", None), getattr(parameter, "max", None)
    bounds = "" if low is None else f" {low:g} or more." if high is None else f" {low:g} to {high:g}."
    text = plain_text(parameter.help or "").replace("|", "\\|") + bounds
    return f"| {', '.join(f'`{name}`' for name in names)} | {value} | {text} |"


def shown_default(value: Any) -> str:
    """Format the default of an option; empty for flags that are off and options without a default."""
    if value is None or value is False or value in ("", (), []) or callable(value):
        return ""
    return f"`{' '.join(str(item) for item in value)}`" if isinstance(value, tuple | list) else f"`{value}`"


TABLES: Final[dict[str, Callable[[], str]]] = {
    function.__name__: function
    for function in (
        *(actions, command_list, commands, device_parameters, faults, identifier, orbit, profile),
        *(quantities, scenario, sensor, sky, snapshot, truth, unit_definition),
    )
}
"""Name of a table in a page → function that writes it."""

BLOCK: Final = re.compile(r"(<!-- begin: (\w+).*?\n).*?(<!-- end: \2)", re.DOTALL)
BUILT: Final = re.compile(r"^.*<!-- built: (\w+) -->$", re.MULTILINE)
"""A line that stands for a table, and says where to read it."""


def with_tables(page: str) -> str:
    """Return a page with its tables updated from the code."""
    return BLOCK.sub(lambda found: f"{found[1]}\n{TABLES[found[2]]()}\n\n{found[3]}", page)


def with_built_tables(page: str) -> str:
    """Return a page with the tables that only a build has."""
    return BUILT.sub(lambda found: TABLES[found[1]](), page)
