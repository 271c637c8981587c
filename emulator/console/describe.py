"""Description of a run for a page: the interface, the faults, the sky and the options of the run."""

from __future__ import annotations

import dataclasses
import types
import typing
from typing import Any, Final

import numpy as np
from pydantic import BaseModel

from starhil.emulator.console.history import COLUMNS, KEPT_ROWS, MODES
from starhil.emulator.console.obc import json_integer
from starhil.emulator.console.pointing import DEFAULT_RATE_DEG_S
from starhil.emulator.device.clock_errors import ClockFault
from starhil.emulator.device.telemetry_faults import TelemetryFault
from starhil.emulator.links.table import BUSES, LINKS
from starhil.emulator.links.traffic import CONSOLE_BUS
from starhil.emulator.links.wire_faults import WireFault
from starhil.emulator.run import Run
from starhil.emulator.run.faults import EFFECTS, DeviceFault
from starhil.emulator.run.head import Head
from starhil.emulator.sensor.sky.objects import SkyObjects
from starhil.protocol.files.bundled import bundled
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.icd.codec import Field, Row
from starid.catalog import load_catalog
from starid.catalog.star_names import STAR_NAMES

MAP_V: Final = 4.2
"""Magnitude of the faintest star on the map of the whole sky."""


def load_bright_stars(path: str | None, epoch: float) -> dict[str, Any]:
    """Return the stars on the map of the whole sky, and names of stars, as JSON data."""
    bright = load_catalog(path, epoch).brighter_than(MAP_V)
    stars = np.column_stack([np.degrees(bright.ra_rad), np.degrees(bright.dec_rad), bright.v])
    return {"map": stars.round(2).tolist(), "star_names": STAR_NAMES}


def describe(run: Run, head: Head) -> dict[str, Any]:
    """Return the description of a head of a run as JSON data."""
    icd = head.icd
    links = {key: head.ready_fields[key] for key in LINKS if key in head.ready_fields}
    return {
        "head": head.number,
        "heads": [
            {"head": each.number, "unit": each.icd.name, "profile": each.profile.name} for each in run.heads
        ],
        "columns": COLUMNS,
        "kept_rows": KEPT_ROWS,
        "modes": MODES,
        "profile": head.profile.name,
        "seed": head.profile.run.seed,
        "clock": run.clock.name,
        "links": links,
        "buses": {**BUSES, CONSOLE_BUS: "console's own line"},
        "camera": head.warm.camera if head.warm is not None else head.profile.camera_values,
        "unit": {"name": icd.name, "version": icd.version},
        "telecommands": [describe_row(row, icd) for row in icd.rows if row.kind == "telecommand"],
        "telemetry": [describe_row(row, icd) for row in sorted(icd.readable, key=lambda row: row.id)],
        "parameters": [
            {"id": item.id, "name": item.name, "unit": item.unit, "min": item.minimum, "max": item.maximum}
            for item in icd.parameters.values()
        ],
        "faults": fault_controls(icd, [link.bus for link in head.links.values()]),
        "scenarios": list(bundled("scenario")),
        "slew_rate_deg_s": DEFAULT_RATE_DEG_S,
    }


def describe_row(row: Row, icd: InterfaceDefinition) -> dict[str, Any]:
    """Return a telecommand or telemetry row as JSON data."""
    return {
        "id": row.id,
        "name": row.name,
        "doc": row.doc,
        "confirm": row.confirm,
        "fields": [_describe_field(field, icd) for field in row.named_fields.values()],
    }


def _describe_field(field: Field, icd: InterfaceDefinition) -> dict[str, Any]:
    values: dict[str, Any] = {
        "name": field.name,
        "kind": field.kind,
        "unit": field.unit,
        "doc": field.doc,
        "default": field.default if field.const is None else field.const,
    }
    if field.kind in ("integer", "bits", "float"):
        low, high = field.physical_limits
        bounded = field.kind != "float" or field.minimum is not None or field.maximum is not None
        if bounded and abs(low) < 1e38 and abs(high) < 1e38:
            values |= {"min": _limit(low), "max": _limit(high)}
    if field.enum is not None:
        values["values"] = list(field.enum.values)
    if field.name == "parameter" and icd.parameters:
        values["parameters"] = True
    if field.kind == "bytes":
        values["bytes"] = field.size
    return values


def _limit(number: float) -> float | str:
    return json_integer(number) if isinstance(number, int) else number


def fault_controls(icd: InterfaceDefinition, buses: list[str]) -> list[dict[str, Any]]:
    """Return the controls for faults by level: name, kind and range of each value."""
    choices = {
        **{key: effect.names(icd) for key, effect in EFFECTS.items() if effect.enum},
        "parameter": list(icd.device_parameters),
        "row": list(icd.telemetry),
        "answer_with": list(icd.telemetry),
    }
    share = {"name": "blocked_share", "kind": "number", "min": 0.0, "max": 1.0, "default": 0.0}
    levels = [
        {"level": "optical", "title": "sky and optics", "controls": [share, *_class_controls(SkyObjects)]},
        {"level": "device", "title": "device", "controls": _model_controls(DeviceFault, choices)},
        {"level": "clock", "title": "clock", "controls": _model_controls(ClockFault, choices)},
        {"level": "telemetry", "title": "telemetry", "controls": _model_controls(TelemetryFault, choices)},
    ]
    wire = _model_controls(WireFault, choices)
    return levels + [{"level": bus, "title": BUSES[bus], "controls": wire} for bus in dict.fromkeys(buses)]


def _model_controls(model: type[BaseModel], choices: dict[str, list[str]]) -> list[dict[str, Any]]:
    schema = model.model_json_schema()
    return _schema_controls(schema["properties"], schema.get("$defs", {}), choices)


def _schema_controls(
    properties: dict[str, Any], models: dict[str, Any], choices: dict[str, list[str]]
) -> list[dict[str, Any]]:
    """Return the controls for a model from its JSON schema; a nested model becomes a group."""
    kinds = {
        "boolean": "flag",
        "integer": "integer",
        "number": "number",
        "string": "choice",
        "array": "list",
        "object": "table",
    }
    controls: list[dict[str, Any]] = []
    for name, schema in properties.items():
        content = schema["anyOf"][0] if "anyOf" in schema else schema
        if "$ref" in content:
            inner = models[content["$ref"].rpartition("/")[2]]["properties"]
            controls.append(
                {"name": name, "kind": "group", "controls": _schema_controls(inner, models, choices)}
            )
            continue
        controls.append(
            {
                "name": name,
                "kind": kinds[content["type"]],
                "min": content.get("minimum"),
                "max": content.get("maximum"),
                "default": schema.get("default"),
                "values": content.get("enum", choices.get(name)),
            }
        )
    return controls


def _class_controls(kind: type[Any]) -> list[dict[str, Any]]:
    """Return the controls for the fields of a class of sky objects; a body becomes a group."""
    hints = typing.get_type_hints(kind)
    controls = []
    for field in dataclasses.fields(kind):
        hint = hints[field.name]
        default = None if field.default is dataclasses.MISSING else field.default
        inner = [each for each in typing.get_args(hint) if dataclasses.is_dataclass(each)]
        control: dict[str, Any] = {"name": field.name, "default": default}
        bounds = field.metadata.get("limits")
        if bounds is not None:
            control |= {"min": bounds[0], "max": bounds[1]}
        if typing.get_origin(hint) is types.UnionType and inner:
            control |= {"kind": "group", "controls": _class_controls(typing.cast("type[Any]", inner[0]))}
        elif typing.get_origin(hint) is tuple:
            control |= {"kind": "list", "default": None}
        else:
            control["kind"] = {bool: "flag", int: "integer", float: "number"}.get(hint, "text")
        controls.append(control)
    return controls
