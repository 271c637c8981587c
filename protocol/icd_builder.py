"""Builds the interface definition of a unit from its TOML files, or lists all errors in them."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any, Final

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from starhil.protocol import icd_schema as schema
from starhil.protocol.codec import Row, RowKind
from starhil.protocol.conventions import Conventions
from starhil.protocol.device_model import DeviceModel, device_model, did_you_mean
from starhil.protocol.icd import InterfaceDefinition, Names, RawTable
from starhil.protocol.icd_bindings import check_row
from starhil.protocol.icd_layout import Layout
from starhil.protocol.link_schema import CubeSpaceFraming, LinkModel, Order
from starhil.protocol.messages import ErrorCode, MessageClass, RequestKind
from starhil.protocol.plugin import Plugin, load_plugin
from starhil.protocol.serial_stack import build_serial_stack
from starhil.protocol.user_file import read_user_text
from starhil.protocol.values import (
    INTEGER_RANGES,
    EnumDefinition,
    FieldError,
    IcdError,
    MissingNameError,
    Parameter,
    Section,
)

SETS: Final = "set_"
"""Prefix of the names of telecommands that can be read back."""
HIGHEST_ID: Final = 0xFF
"""Highest ID if the link does not limit it."""

CLASS: Final = "class"
"""Table of the classes; among the broken names if a class is missing."""
UNKNOWN_UNIT: Final = {"name": "", "version": "", "doc": "", "provenance": "ours"}
"""Stands for a table [unit] with errors."""

_MODELS: Final[dict[str, type[BaseModel]]] = {
    "unit": schema.UnitModel,
    "conventions": schema.ConventionsModel,
    "class": schema.ClassModel,
    "enum": schema.EnumModel,
    "telecommand": schema.RowModel,
    "telemetry": schema.RowModel,
    "fields": schema.FieldModel,
    "repeat": schema.RepeatModel,
    "bits": schema.BitModel,
    "parameter": schema.ParameterModel,
    "section": schema.SectionModel,
}
"""Table → its schema, to suggest keys."""


def read_definition(path: Path, *, run_plugin: bool = True) -> tuple[InterfaceDefinition, list[str]]:
    """Read a folder of TOML files, or one file; return what is valid of the definition, and all errors.

    An error that another one may cause is left out, such as a row that is missing because it has an error itself.
    """
    files = sorted(path.glob("*.toml")) if path.is_dir() else [path]
    builder = _Builder(path, run_plugin=run_plugin)
    for file in files:
        builder.read(file)
    definition = builder.build()
    return definition, builder.errors if files else [f"{path}: no .toml file in this folder"]


def _place(error: ErrorDetails) -> tuple[int | str, ...]:
    """Return the place of what cannot be used because of an error: a key, a field, a table."""
    location = error["loc"]
    if error["type"] == "extra_forbidden":
        return location
    if len(location) > 3 and location[2] == "fields":
        return location[:4]
    return location[: 2 if isinstance(location[1 % len(location)], int) else 1]


def _order(place: tuple[int | str, ...]) -> tuple[tuple[int, str], ...]:
    return tuple((step, "") if isinstance(step, int) else (-1, step) for step in place)


def _name_at(document: Any, place: tuple[int | str, ...]) -> str | None:
    """Return the name of the table at a place."""
    try:
        name = document[place[0]][place[1]]["name"]
    except (IndexError, KeyError, TypeError):
        return None
    return name if isinstance(name, str) else None


def _key_path(document: object, location: tuple[int | str, ...]) -> str:
    """Return the dotted path of a key, with names of rows and fields instead of indices."""
    steps: list[str] = []
    here = document
    for step in location:
        try:
            here = here[step]  # type: ignore[index]
        except (KeyError, IndexError, TypeError):
            here = None
        named = here.get("name") if isinstance(here, dict) else None
        steps.append(str(named if named is not None and isinstance(step, int) else step))
    return ".".join(steps)


def _known_keys(location: tuple[int | str, ...]) -> list[str]:
    """Return the known keys of the table that has an unknown one."""
    tables = [step for step in location[:-1] if isinstance(step, str)]
    model = _MODELS.get(tables[-1], schema.FileModel) if tables else schema.FileModel
    return [item.alias or name for name, item in model.model_fields.items()]


class _Builder:
    """Collects the files of a definition and validates them together."""

    def __init__(self, path: Path, *, run_plugin: bool) -> None:
        self.errors: list[str] = []
        self._run_plugin = run_plugin
        self._unread = False
        """Whether a file could not be read, so that names may be missing because of that."""
        self._broken: set[str] = set()
        """Names of tables with errors, which are missing, or lack a field."""
        self._path = path
        self._model: DeviceModel = device_model()
        self._enums: dict[str, EnumDefinition] = {}
        self._used_enums: set[str] = set()
        self._parameters: dict[str, Parameter] = {}
        self._device_parameters: dict[str, Parameter] = {}
        self._classes: dict[str, MessageClass] = {}
        self._class_answers: dict[str, list[str]] = {}
        self._files: list[tuple[Path, schema.FileModel]] = []
        self._sections: list[Section] = []
        self._tables: dict[str, tuple[Path, object]] = {}
        self._plugin = Plugin()
        self.byte_order: Order = "little"

    def read(self, file: Path) -> None:
        """Read and validate one file."""
        try:
            document = tomllib.loads(read_user_text(file))
        except OSError as error:
            self.errors.append(f"{file}: cannot read the interface definition: {error.strerror}")
            self._unread = True
            return
        except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
            self.errors.append(f"{file}: not valid TOML: {error}")
            self._unread = True
            return
        try:
            model = schema.FileModel.model_validate(document)
        except ValidationError as error:
            for item in error.errors():
                where = f"{file}: {_key_path(document, item['loc'])}"
                if item["type"] == "extra_forbidden":
                    hint = did_you_mean(str(item["loc"][-1]), _known_keys(item["loc"]))
                    self.errors.append(f"{where}: unknown key{hint}")
                else:
                    self.errors.append(f"{where}: {item['msg']}")
            for place in sorted({_place(item) for item in error.errors()}, key=_order, reverse=True):
                self._remove(document, place)
            model = schema.FileModel.model_validate(document)
        self._files.append((file, model))

    def _remove(self, document: Any, place: tuple[int | str, ...]) -> None:
        """Remove what is invalid from a document, and record the names that are missing because of that."""
        *path, last = place
        named = [name for name in (_name_at(document, place[:2]),) if name is not None]
        self._broken |= {*named, *(name.removeprefix(SETS) for name in named)}
        if place[0] == CLASS:
            self._broken.add(CLASS)
        if place == ("unit",):
            document["unit"] = UNKNOWN_UNIT
            self._plugin = Plugin(skipped="")
            return
        for step in path:
            document = document[step]
        del document[last]

    def _attempt(self, step: Callable[..., None], *arguments: object) -> bool:
        """Run one step of building and record its error; return whether there was none."""
        try:
            step(*arguments)
        except IcdError as error:
            self._record(error)
            return False
        return True

    def _record(self, error: IcdError) -> None:
        """Record an error, except for a name that is missing because of another error."""
        caused = isinstance(error, MissingNameError) and (self._unread or error.name in self._broken)
        if not caused:
            self.errors.append(str(error))

    def build(self) -> InterfaceDefinition:
        """Build what is valid of the definition."""
        for file, model in self._files:
            for name, table in (
                ("unit", model.unit),
                ("conventions", model.conventions),
                ("errors", model.errors),
                ("link", model.link),
                ("canopen", model.canopen),
            ):
                if table is not None:
                    self._attempt(self._add_table, name, file, table)
            for item in model.class_:
                if not self._attempt(self._add_class, file, item):
                    self._broken |= {CLASS, item.name}
            for enum in model.enum:
                self._attempt(self._add_enum, file, enum)
            for section in model.section:
                self._attempt(self._add_section, file, section)
        if "unit" not in self._tables:
            if not self._unread:
                self.errors.append(f"{self._path}: no [unit] with name, version and doc")
            self._tables["unit"] = (self._path, schema.UnitModel.model_validate(UNKNOWN_UNIT))
            self._plugin = Plugin(skipped="")
        self._attempt(self._load_plugin)
        conventions = Conventions()
        try:
            conventions = self._conventions()
        except IcdError as error:
            self._record(error)
        self.byte_order = conventions.byte_order
        self._add_parameters()
        rows: dict[str, Row] = {}
        telecommands = self._build_rows("telecommand", rows)
        telemetry = self._build_rows("telemetry", rows)
        for row in (*telecommands, *telemetry):
            self._attempt(self._check_answers, row, rows)
        definition = self._definition(conventions, telecommands, telemetry)
        self._attempt(self._check_link, definition)
        return definition

    def _check_link(self, definition: InterfaceDefinition) -> None:
        """Check that the parts of the links are compatible with each other and with the rows."""
        link = definition.link
        for row in definition.rows:
            if "echo" in row.answers:
                where = f"{self._path}: {row.kind} {row.name}: answer 'echo'"
                if link.serial is not None and isinstance(link.serial.framing, CubeSpaceFraming):
                    raise IcdError(f"{where}: link.serial with framing cubespace has no echoes")
                if link.can is not None:
                    raise IcdError(f"{where}: link.can has no echoes")
        custom = link.serial is not None and "custom" in (link.serial.framing.kind, link.serial.check.kind)
        if link.serial is None or (custom and definition.plugin.skipped is not None):
            return
        if isinstance(link.serial.framing, CubeSpaceFraming):
            for name in link.serial.framing.unanswered:
                if name not in definition.telecommands:
                    raise MissingNameError(
                        f"{self._tables['link'][0]}: link.serial.framing.unanswered: no telecommand named {name!r}"
                        f"{did_you_mean(name, definition.telecommands)}",
                        name,
                    )
        try:
            build_serial_stack(definition)
        except IcdError as error:
            raise IcdError(f"{self._tables['link'][0]}: {error}") from None

    def _definition(
        self, conventions: Conventions, telecommands: list[Row], telemetry: list[Row]
    ) -> InterfaceDefinition:
        unit = self._unit
        self._attempt(self._check_errors)
        errors = self._tables.get("errors", (self._path, {}))[1]
        link = self._tables.get("link", (self._path, None))[1]
        enums = {
            **{name: enum for name, enum in self._model.enums.items() if name in self._used_enums},
            **self._enums,
        }
        return InterfaceDefinition(
            name=unit.name,
            version=unit.version,
            doc=unit.doc,
            telecommands=Names("telecommand", ((row.name, row) for row in telecommands)),
            telemetry=Names("telemetry", ((row.name, row) for row in telemetry)),
            enums=Names("enumeration", enums.items()),
            parameters=Names("parameter", self._parameters.items()),
            device_parameters=Names("parameter", {**self._device_parameters, **self._parameters}.items()),
            sections=tuple(self._sections),
            canopen=self._raw_table("canopen"),
            link=link if isinstance(link, LinkModel) else LinkModel(),
            conventions=conventions,
            classes=tuple(self._classes.values()),
            errors=errors if isinstance(errors, dict) else {},
            first_telemetry_id=unit.first_telemetry_id,
            plugin=self._plugin,
        )

    # --- tables that occur once ---

    def _add_table(self, name: str, file: Path, table: object) -> None:
        if name in self._tables:
            raise IcdError(f"{file}: a second [{name}]; keep one of them")
        self._tables[name] = (file, table)

    def _raw_table(self, name: str) -> RawTable | None:
        if name not in self._tables:
            return None
        file, table = self._tables[name]
        return RawTable(file, table) if isinstance(table, dict) else None

    @property
    def _unit(self) -> schema.UnitModel:
        unit = self._tables["unit"][1]
        if not isinstance(unit, schema.UnitModel):
            raise TypeError("unit: not a table of the schema")
        return unit

    def _load_plugin(self) -> None:
        file, name = self._tables["unit"][0], self._unit.plugin
        if name is None:
            return
        self._plugin = Plugin(skipped=name)  # also if it fails: its names are unknown, not wrong
        if self._run_plugin:
            try:
                self._plugin = load_plugin(file.parent, name)
            except IcdError as error:
                raise IcdError(f"{file}: {error}") from error

    def _conventions(self) -> Conventions:
        file, table = self._tables.get("conventions", (self._path, schema.ConventionsModel()))
        if not isinstance(table, schema.ConventionsModel):
            raise TypeError("conventions: not a table of the schema")
        one, two, three = table.axes
        try:
            return Conventions(
                table.quaternion,
                table.scalar_sign,
                (one, two, three),
                table.epoch,
                table.byte_order,
                table.telecommand_crc,
            )
        except IcdError as error:
            raise IcdError(f"{file}: {error}") from None

    def _check_errors(self) -> None:
        file, table = self._tables.get("errors", (self._path, {}))
        known = [*(code.name.lower() for code in ErrorCode), "other"]
        for name in table if isinstance(table, dict) else {}:
            if name not in known:
                raise IcdError(
                    f"{file}: errors.{name}: no such error{did_you_mean(name, known)} (known: {', '.join(known)})"
                )

    # --- tables that occur many times ---

    def _add_class(self, file: Path, model: schema.ClassModel) -> None:
        where = f"{file}: class {model.name}"
        if model.name in self._classes:
            raise IcdError(f"{where}: defined twice")
        same = next((item.name for item in self._classes.values() if item.code == model.code), None)
        if model.code is not None and same is not None:
            raise IcdError(f"{where}: code {model.code} is already used by {same}")
        self._classes[model.name] = MessageClass(
            model.name, RequestKind(model.kind), model.code, model.reply, model.unsolicited
        )
        if model.answer is not None:
            self._class_answers[model.name] = model.answer

    def _add_section(self, file: Path, model: schema.SectionModel) -> None:
        where = f"{file}: section {model.heading}"
        if any(other.heading == model.heading for other in self._sections):
            raise IcdError(f"{where}: defined twice")
        for number, row in enumerate(model.rows, 1):
            if len(row) != len(model.columns):
                raise IcdError(f"{where}: row {number} has {len(row)} cells, must have {len(model.columns)}")
        rows = tuple(tuple(row) for row in model.rows)
        self._sections.append(Section(model.heading, tuple(model.paragraphs), tuple(model.columns), rows))

    def _add_enum(self, file: Path, model: schema.EnumModel) -> None:
        if model.name in self._enums:
            raise IcdError(f"{file}: enum {model.name}: defined twice")
        if len(set(model.values.values())) != len(model.values):
            raise IcdError(f"{file}: enum {model.name}: two names have the same number")
        self._enums[model.name] = EnumDefinition(model.name, model.doc, dict(model.values))

    def enum_of(self, name: str | None, where: str) -> EnumDefinition:
        """Return an enumeration of the unit or, if it has none of this name, of the device model."""
        if name is None:
            raise IcdError(f"{where}: type enum needs `enum`, the name of an enumeration")
        if name in self._enums:
            return self._enums[name]
        if name in self._model.enums:
            self._used_enums.add(name)
            return self._model.enums[name]
        known = sorted({*self._enums, *self._model.enums})
        raise MissingNameError(
            f"{where}: no enumeration named {name!r}{did_you_mean(name, known)} (known: {', '.join(known)})",
            name,
        )

    # --- parameters ---

    def _add_parameters(self) -> None:
        for name, item in self._model.parameters.items():
            enum = None if item.enum is None else self._enums.get(item.enum, self._model.enums[item.enum])
            low, high = self._limits(item, enum, f"device model: parameter {name}")
            self._device_parameters[name] = Parameter(
                0, name, item.type, item.unit, low, high, item.default, item.doc, enum
            )
        for file, model in self._files:
            for parameter in model.parameter:
                self._attempt(self._add_parameter, file, parameter)

    def _add_parameter(self, file: Path, model: schema.ParameterModel) -> None:
        where = f"{file}: parameter {model.name}"
        if model.name in self._parameters:
            raise IcdError(f"{where}: defined twice")
        same_id = next((other.name for other in self._parameters.values() if other.id == model.id), None)
        if same_id is not None:
            raise IcdError(f"{where}: ID {model.id} is already used by {same_id}")
        base = self._model.parameters.get(model.name)
        if base is None:
            hint = did_you_mean(model.name, self._model.parameters)
            raise IcdError(f"{where}: the device has no parameter with this name{hint}")
        changes = model.model_dump(exclude_none=True, exclude={"id"})
        whole = base.model_copy(update=changes)
        if whole.unit != base.unit:
            raise IcdError(f"{where}: unit {whole.unit!r}, but in the device it is {base.unit!r}")
        enum = self.enum_of(whole.enum, where) if whole.type == "enum8" else None
        low, high = self._limits(whole, enum, where)
        parameter = Parameter(
            model.id, whole.name, whole.type, whole.unit, low, high, whole.default, whole.doc, enum
        )
        try:
            self._parameters[whole.name] = replace(parameter, default=parameter.check(whole.default))
        except FieldError as error:
            raise IcdError(f"{where}: default: {error}") from None

    @staticmethod
    def _limits(
        model: schema.DeviceParameterModel, enum: EnumDefinition | None, where: str
    ) -> tuple[float, float]:
        if enum is not None:
            return float(min(enum.values.values())), float(max(enum.values.values()))
        if model.type == "bool":
            return 0.0, 1.0
        if model.min is None or model.max is None or not model.min <= model.max:
            raise IcdError(f"{where}: needs min and max, with min not above max")
        low, high = INTEGER_RANGES.get(model.type, (float("-inf"), float("inf")))
        if model.min < low or model.max > high:
            raise IcdError(f"{where}: limits {model.min:g} to {model.max:g} do not fit type {model.type}")
        return model.min, model.max

    def check_parameter(self, name: str | None, unit: str, where: str) -> str | None:
        """Check that the parameter of a field exists and has the unit of the field."""
        if name is None:
            return None
        if name not in self._device_parameters:
            raise IcdError(
                f"{where}: no parameter named {name!r}{did_you_mean(name, self._device_parameters)}"
            )
        if self._device_parameters[name].unit != unit:
            raise IcdError(
                f"{where}: unit {unit!r}, but parameter {name} is in {self._device_parameters[name].unit!r}; they must agree"
            )
        return name

    # --- rows ---

    def _build_rows(self, kind: RowKind, rows: dict[str, Row]) -> list[Row]:
        models = [
            (file, row)
            for file, model in self._files
            for row in (
                model.telecommand
                if kind == "telecommand"
                else [*model.telemetry, *_readbacks(model.telecommand)]
            )
        ]
        waiting = [(file, model) for file, model in models if model.include]
        done: list[Row] = []
        for file, model in chain(((file, model) for file, model in models if not model.include), waiting):
            self._attempt(self._add_rows, kind, file, model, rows, done)
        return done

    def _add_rows(
        self, kind: RowKind, file: Path, model: schema.RowModel, rows: dict[str, Row], done: list[Row]
    ) -> None:
        try:
            built = list(self._expand_row(kind, file, model, rows))
        except IcdError:
            self._broken.add(model.name)
            raise
        for row in built:
            where = f"{file}: {kind} {row.name}"
            whole = model.name not in self._broken
            self.errors += check_row(row, self._model, self._plugin, where, complete=whole)
            if self._attempt(self._check_unique, file, row, rows):
                rows[row.name] = row
                done.append(row)

    def _class_of(self, kind: RowKind, model: schema.RowModel, where: str) -> str:
        """Return the class of a row; record an error and return none if it is wrong."""
        of_kind = [item.name for item in self._classes.values() if item.kind.value == kind]
        if model.class_ is None:
            if (len(of_kind) > 1 or (self._classes and not of_kind)) and CLASS not in self._broken:
                self._record(
                    IcdError(f"{where}: needs `class`, one of {', '.join(of_kind or self._classes)}")
                )
            return of_kind[0] if of_kind else ""
        found = self._classes.get(model.class_)
        if found is None:
            text = f"{where}: no class named {model.class_!r}{did_you_mean(model.class_, self._classes)}"
            self._record(MissingNameError(text, model.class_))
            return ""
        if found.kind.value != kind:
            self._record(IcdError(f"{where}: class {model.class_} is for {found.kind.value}, not for {kind}"))
        return model.class_

    def _check_unique(self, file: Path, row: Row, rows: Mapping[str, Row]) -> None:
        where = f"{file}: {row.kind} {row.name}"
        first = self._unit.first_telemetry_id
        if first is not None and (row.id >= first) != (row.kind == "telemetry"):
            side = f"{first} and up" if row.kind == "telemetry" else f"below {first}"
            raise IcdError(f"{where}: ID {row.id} is not a {row.kind} ID ({side})")
        highest = self._highest_id
        if row.id > highest:
            raise IcdError(f"{where}: ID {row.id} is above {highest}")
        if row.name in rows:
            raise IcdError(f"{where}: name used twice")
        code = self._code(row)
        same = next(
            (other.name for other in rows.values() if (self._code(other), other.id) == (code, row.id)), None
        )
        if same is not None:
            raise IcdError(f"{where}: ID {row.id} is already used by {same}")

    @property
    def _highest_id(self) -> int:
        """Highest ID that the link can carry."""
        link = self._tables.get("link", (self._path, None))[1]
        if not isinstance(link, LinkModel) or link.serial is None:
            return HIGHEST_ID
        header = link.serial.request_header
        widths = [bit.width for item in header for bit in item.bits if bit.role == "id"]
        widths += [int(item.type[1:]) for item in header if item.role == "id"]
        return (1 << widths[0]) - 1 if widths else HIGHEST_ID

    def _code(self, row: Row) -> int | None:
        return self._classes[row.klass].code if row.klass else None

    def _expand_row(
        self, kind: RowKind, file: Path, model: schema.RowModel, rows: Mapping[str, Row]
    ) -> Iterator[Row]:
        where = f"{file}: {kind} {model.name}"
        provenance = model.provenance or self._unit.provenance
        if provenance is None:
            raise IcdError(f"{where}: needs `provenance`, here or in [unit]")
        last = model.id if model.last_id is None else model.last_id
        if last < model.id:
            raise IcdError(f"{where}: last_id {last} is below ID {model.id}")
        if kind == "telemetry" and model.readback is not None:
            raise IcdError(f"{where}: only telecommands have a readback")
        if model.readback is not None and not model.name.startswith(SETS):
            raise IcdError(f"{where}: the name of a telecommand with a readback must begin with {SETS}")
        klass = self._class_of(kind, model, where)
        for number, row_id in enumerate(range(model.id, last + 1), 1):
            single = model.last_id is None
            layout = Layout(self, where, kind, provenance, None if single else number)
            for name in model.include or ():
                if name not in rows:
                    self._broken.add(model.name)
                    raise MissingNameError(
                        f"{where}: include: no row named {name!r}{did_you_mean(name, rows)}", name
                    )
                layout.include(rows[name])
                if name in self._broken:
                    self._broken.add(model.name)
            for item in model.fields:
                if not self._attempt(layout.add, item):
                    self._broken.add(model.name)
            if model.size is not None and layout.size != model.size and model.name not in self._broken:
                raise IcdError(f"{where}: size is {model.size} but the fields add up to {layout.size} bytes")
            yield Row(
                kind=kind,
                id=row_id,
                name=model.name if single else f"{model.name}_{number}",
                size=layout.size,
                fields=tuple(layout.fields),
                slots=tuple(layout.slots),
                doc=model.doc,
                provenance=provenance,
                source=model.source or (self._unit.source if provenance == "confirmed" else ""),
                klass=klass,
                action=model.action,
                arguments={
                    name: number if value == "[n]" else value for name, value in model.arguments.items()
                },
                answers=tuple(
                    self._class_answers.get(klass, ["reply"]) if model.answer is None else model.answer
                ),
                zeros=model.unbound is not None,
            )

    def _check_answers(self, row: Row, rows: Mapping[str, Row]) -> None:
        for answer in row.answers:
            kind, _, name = answer.partition(":")
            where = f"{self._path}: {row.kind} {row.name}: answer {answer!r}"
            if kind not in ("echo", "reply", "row") or (kind == "row") != bool(name):
                raise IcdError(f"{where}: must be echo, reply or row:NAME")
            if kind == "row" and (name not in rows or rows[name].kind != "telemetry"):
                text = f"{where}: no telemetry row with this name{did_you_mean(name, rows)}"
                raise MissingNameError(text, name)


def _readbacks(telecommands: list[schema.RowModel]) -> Iterator[schema.RowModel]:
    """Yield the telemetry rows that report the last accepted values of telecommands."""
    for model in telecommands:
        if model.readback is not None:
            name = model.name.removeprefix(SETS)
            yield schema.RowModel(
                id=model.readback, name=name, doc="As set.", provenance=model.provenance, source=model.source,
                size=model.size, include=[model.name],
            )  # fmt: skip
