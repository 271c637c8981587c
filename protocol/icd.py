"""Reads the interface definition of a unit from its TOML files, or lists all errors in them.

The files are validated one by one (`icd_schema`). What is invalid is removed, so that the rest can still be checked,
and the names that are missing because of that are noted: an error that another one may cause is left out. Then the
tables of all files are put together in the order of their references: enumerations, parameters, rows, links. An
error names file, table and key, and what to write instead.
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any, Final, TypeVar

from pydantic import ValidationError

from starhil.protocol import icd_schema as schema
from starhil.protocol.codec import Row
from starhil.protocol.conventions import Conventions
from starhil.protocol.definition import (
    OTHER_ERROR,
    InterfaceDefinition,
    Names,
)
from starhil.protocol.device_model import DeviceModel, device_model
from starhil.protocol.errors import escape_controls
from starhil.protocol.icd_bindings import check_row
from starhil.protocol.icd_layout import NUMBER, Layout
from starhil.protocol.link_schema import CubeSpaceFraming, LinkModel, MessageClass
from starhil.protocol.messages import ErrorCode, RequestKind
from starhil.protocol.names import DEFAULT_UNIT, UNITS_FOLDER, did_you_mean, find_unit
from starhil.protocol.plugin import Plugin, load_plugin
from starhil.protocol.serial_stack import build_serial_stack
from starhil.protocol.text_messages import words
from starhil.protocol.user_file import read_user_text
from starhil.protocol.validation_messages import Problem, problems
from starhil.protocol.values import (
    EnumDefinition,
    FieldError,
    IcdError,
    MissingNameError,
    Parameter,
    Section,
)

_Table = TypeVar("_Table")

SETS: Final = "set_"
"""Prefix of the names of telecommands that can be read back."""
HIGHEST_ID: Final = 0xFF
"""Highest ID if the link does not limit it."""

CLASS: Final = "class"
"""Table of the classes; among the broken names if a class is missing."""
UNKNOWN_UNIT: Final = {"name": "", "version": "", "doc": "", "provenance": "ours"}
"""Stands for a table [unit] with errors."""


def load_unit(name_or_folder: str | Path = DEFAULT_UNIT) -> InterfaceDefinition:
    """Read the interface definition of a unit: a bundled unit by name, a folder of TOML files, or one file.

    Bundled units are cached. Raises IcdError, whose text names file, row and field.
    """
    path = find_unit(name_or_folder)
    return _load_bundled(path) if path.parent == UNITS_FOLDER else _load(path)


@cache
def _load_bundled(path: Path) -> InterfaceDefinition:
    return _load(path)


def _load(path: Path) -> InterfaceDefinition:
    definition, errors = read_definition(path)
    if errors:
        raise IcdError(*errors)
    return definition


def read_definition(path: Path, *, run_plugin: bool = True) -> tuple[InterfaceDefinition, list[str]]:
    """Read a folder of TOML files, or one file; return what is valid of the definition, and all errors, one line each.

    Files `*_cases.toml` in a folder are conformance cases, and no part of the definition.
    """
    found = sorted(path.glob("*.toml")) if path.is_dir() else [path]
    files = [file for file in found if file is path or not file.stem.endswith("_cases")]
    reader = _Reader(path, run_plugin=run_plugin)
    for file in files:
        reader.read(file)
    definition = reader.definition()
    errors = reader.errors if files else [f"{path}: no .toml file in this folder"]
    # an error may quote any text of the definition
    return definition, [escape_controls(error) for error in errors]


def _place(problem: Problem) -> tuple[int | str, ...]:
    """Return the place of what cannot be used because of an error: a key, a field, a table."""
    location = problem.location
    if problem.unknown:
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


class _Reader:
    """Validates the files of a definition, and puts their tables together."""

    def __init__(self, path: Path, *, run_plugin: bool) -> None:
        self.errors: list[str] = []
        self._path = path
        self._run_plugin = run_plugin
        self._files: list[tuple[Path, schema.FileModel]] = []
        self._unread = False
        """Whether a file could not be read, so that names may be missing because of that."""
        self._broken: set[str] = set()
        """Names of tables with errors, which are missing, or lack a field."""
        self._model: DeviceModel = device_model()
        self._used_enums: dict[str, EnumDefinition] = {}
        """Enumerations of the device model that the unit uses."""
        self._unit = schema.UnitModel.model_validate(UNKNOWN_UNIT)
        self._enums: dict[str, EnumDefinition] = {}
        self._classes: dict[str, MessageClass] = {}
        self._parameters: dict[str, Parameter] = {}
        self._device_parameters: dict[str, Parameter] = {}
        self._link = LinkModel()
        self._plugin = Plugin()
        self._rows: dict[str, Row] = {}
        self._row_files: dict[str, Path] = {}
        self._ids: dict[tuple[int | None, int], str] = {}
        """Code of the class and ID → name of the row."""
        self._removed: list[tuple[Path, RequestKind, Any]] = []
        """Rows that are not valid, with their files."""
        self.byte_order = Conventions().byte_order

    # --- files ---

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
        said = False
        while True:
            try:
                self._files.append((file, schema.FileModel.model_validate(document)))
            except ValidationError as error:
                found = list(problems(error, schema.FileModel, document))
                if not said:  # later ones may be caused by what was removed
                    self.errors += [f"{file}: {problem}" for problem in found]
                said = True
                for place in sorted({_place(problem) for problem in found}, key=_order, reverse=True):
                    self._remove(file, document, place)
            else:
                return

    def _remove(self, file: Path, document: Any, place: tuple[int | str, ...]) -> None:
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
        if len(place) == 2 and place[0] in tuple(RequestKind):
            self._removed.append((file, RequestKind(place[0]), document[place[0]][last]))
        for step in path:
            document = document[step]
        del document[last]

    def _single(self, name: str, default: _Table) -> tuple[Path, _Table]:
        """Return a table that occurs once, and its file."""
        found = [(file, table) for file, model in self._files if (table := getattr(model, name)) is not None]
        self.errors += [f"{file}: a second [{name}]; keep one of them" for file, _ in found[1:]]
        return found[0] if found else (self._path, default)

    def _every(self, name: str) -> Iterator[tuple[Path, Any]]:
        """Yield the tables of a kind that occurs many times, and their files."""
        for file, model in self._files:
            for table in getattr(model, name):
                yield file, table

    def _attempt(self, step: Callable[..., None], *arguments: object) -> bool:
        """Run one step and record its error; return whether there was none."""
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
            self.errors += error.args

    # --- the definition ---

    def definition(self) -> InterfaceDefinition:
        """Return what is valid of the definition."""
        conventions = self._single("conventions", Conventions())[1]
        errors_file, errors = self._single("errors", dict[str, int]())
        link_file, self._link = self._single("link", LinkModel())
        for file, item in self._every("classes"):
            if not self._attempt(self._add_class, file, item):
                self._broken |= {CLASS, item.name}
        for file, item in self._every("enum"):
            self._attempt(self._add, self._enums, item.name, item, f"{file}: enum {item.name}")
        sections: dict[str, Section] = {}
        for file, item in self._every("section"):
            self._attempt(self._add, sections, item.heading, item, f"{file}: section {item.heading}")
        self._attempt(self._set_unit)
        self.byte_order = conventions.byte_order
        self._add_parameters()
        telecommands = self._build_rows(RequestKind.TELECOMMAND)
        telemetry = self._build_rows(RequestKind.TELEMETRY)
        self._check_removed()
        for row in self._rows.values():
            self._attempt(self._check_answers, row)
        self._attempt(self._check_errors, errors_file, errors, conventions)
        definition = InterfaceDefinition(
            name=self._unit.name,
            version=self._unit.version,
            doc=self._unit.doc,
            telecommands=Names("telecommand", ((row.name, row) for row in telecommands)),
            telemetry=Names("telemetry row", ((row.name, row) for row in telemetry)),
            enums=Names(
                "enumeration",
                {
                    **{name: enum for name, enum in self._model.enums.items() if name in self._used_enums},
                    **self._enums,
                }.items(),
            ),
            parameters=Names("parameter", self._parameters.items()),
            device_parameters=Names("parameter", {**self._device_parameters, **self._parameters}.items()),
            sections=tuple(sections.values()),
            canopen=self._single("canopen", None)[1],
            link=self._link,
            conventions=conventions,
            classes=tuple(self._classes.values()),
            errors=errors,
            first_telemetry_id=self._unit.first_telemetry_id,
            plugin=self._plugin,
            files=self._row_files,
        )
        self._attempt(self._check_link, link_file, definition)
        return definition

    def _set_unit(self) -> None:
        file, unit = self._single("unit", None)
        if unit is None:
            if not self._unread:
                self.errors.append(f"{self._path}: no [unit] with name, version and doc")
            self._plugin = Plugin(skipped="")
            return
        self._unit = unit
        if self._unit.plugin is None:
            return
        self._plugin = Plugin(skipped=self._unit.plugin)  # also if it fails: its names are unknown, not wrong
        if self._run_plugin:
            try:
                self._plugin = load_plugin(file.parent, self._unit.plugin)
            except IcdError as error:
                raise IcdError(f"{file}: {error}") from error

    @staticmethod
    def _add(table: dict[str, _Table], name: str, item: _Table, where: str) -> None:
        if name in table:
            raise IcdError(f"{where}: defined twice")
        table[name] = item

    def _add_class(self, file: Path, item: MessageClass) -> None:
        where = f"{file}: class {item.name}"
        same = next((other.name for other in self._classes.values() if other.code == item.code), None)
        if item.name not in self._classes and item.code is not None and same is not None:
            raise IcdError(f"{where}: code {item.code} is already used by {same}")
        self._add(self._classes, item.name, item, where)

    @staticmethod
    def _check_errors(file: Path, errors: Mapping[str, int], conventions: Conventions) -> None:
        known = [*(code.name.lower() for code in ErrorCode), OTHER_ERROR]
        for name in errors:
            if name not in known:
                raise IcdError(
                    f"{file}: errors.{name}: no such error{did_you_mean(name, known)} (known: {', '.join(known)})"
                )
        if "crc" in errors and not conventions.telecommand_crc:
            raise IcdError(
                f"{file}: errors.crc: never sent, because a message with a wrong checksum is not answered; remove it"
            )

    def _check_link(self, file: Path, definition: InterfaceDefinition) -> None:
        """Check that the parts of the links are compatible with each other and with the rows."""
        serial, can = self._link.serial, self._link.can
        for row in definition.rows:
            if "echo" in row.answers:
                where = f"{self._path}: {row.kind} {row.name}: answer 'echo'"
                if serial is not None and isinstance(serial.framing, CubeSpaceFraming):
                    raise IcdError(f"{where}: link.serial with framing cubespace has no echoes")
                if can is not None:
                    raise IcdError(f"{where}: link.can has no echoes")
                if serial is not None and (serial.format or serial.acknowledge or serial.refusal):
                    raise IcdError(
                        f"{where}: link.serial with `format`, `acknowledge` or `refusal` has no echoes"
                    )
            if row.request and serial is None:
                raise IcdError(
                    f"{self._path}: {row.kind} {row.name}: `request` is a text on link.serial, which the unit does not have"
                )
        if serial is None or definition.link_is_unknown:
            return
        if isinstance(serial.framing, CubeSpaceFraming):
            for name in serial.framing.unanswered:
                if name not in definition.telecommands:
                    raise MissingNameError(
                        f"{file}: link.serial.framing.unanswered: no telecommand named {name!r}"
                        f"{did_you_mean(name, definition.telecommands)}",
                        name,
                    )
        try:
            stack = build_serial_stack(definition)
        except IcdError as error:
            raise IcdError(f"{file}: {error}") from None
        for row in definition.rows:
            text_form = stack.request_formats.of(row.klass) in stack.text_formats
            check_text_requests(row, definition, f"{file}: {row.kind} {row.name}", needed=text_form)

    def enum_of(self, name: str | None, where: str) -> EnumDefinition:
        """Return an enumeration of the unit or, if it has none of this name, of the device model."""
        if name is None:
            raise IcdError(f"{where}: type enum needs `enum`, the name of an enumeration")
        if name in self._enums:
            return self._enums[name]
        if name in self._model.enums:
            return self._used_enums.setdefault(name, self._model.enums[name])
        known = sorted({*self._enums, *self._model.enums})
        raise MissingNameError(
            f"{where}: no enumeration named {name!r}{did_you_mean(name, known)} (known: {', '.join(known)})",
            name,
        )

    # --- parameters ---

    def _add_parameters(self) -> None:
        for name, item in self._model.parameters.items():
            own = None if item.enum is None else self._enums.get(item.enum.name)
            where = f"device model: parameter {name}"
            self._device_parameters[name] = item if own is None else Parameter.limited(dict(item), own, where)
        for file, model in self._every("parameter"):
            self._attempt(self._add_parameter, model, f"{file}: parameter {model.name}")

    def _add_parameter(self, model: schema.ParameterModel, where: str) -> None:
        if model.name in self._parameters:
            raise IcdError(f"{where}: defined twice")
        same_id = next((other.name for other in self._parameters.values() if other.id == model.id), None)
        if same_id is not None:
            raise IcdError(f"{where}: ID {model.id} is already used by {same_id}")
        base = self._model.parameters.get(model.name)
        if base is None:
            hint = did_you_mean(model.name, self._model.parameters)
            raise IcdError(f"{where}: the device has no parameter with this name{hint}")
        if model.unit not in (None, base.unit):
            raise IcdError(f"{where}: unit {model.unit!r}, but in the device it is {base.unit!r}")
        keys = {**dict(base), **{key: value for key, value in model if value is not None}}
        named = model.enumeration or (None if base.enum is None else base.enum.name)
        enum = self.enum_of(named, where) if keys["type"] == "enum8" else None
        parameter = Parameter.limited(keys, enum, where, model.id)
        try:
            default = parameter.check(parameter.default)
        except FieldError as error:
            raise IcdError(f"{where}: default: {error}") from None
        self._parameters[model.name] = parameter.model_copy(update={"default": default})

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

    def _build_rows(self, kind: RequestKind) -> list[Row]:
        """Return the rows of a kind, those that include others last."""
        models: list[tuple[Path, schema.RowModel]] = []
        for file, tables in self._files:
            models += [(file, item) for item in getattr(tables, kind)]
            if kind == "telemetry":
                commands = [item for item in tables.telecommand if item.readback is not None]
                models += [(file, _readback(item)) for item in commands]
        done: list[Row] = []
        for file, model in sorted(models, key=lambda item: bool(item[1].include)):
            self._attempt(self._add_rows, kind, file, model, done)
        return done

    def _add_rows(self, kind: RequestKind, file: Path, model: schema.RowModel, done: list[Row]) -> None:
        try:
            built = list(self._expand_row(kind, f"{file}: {kind} {model.name}", model))
        except IcdError:
            self._broken.add(model.name)
            raise
        for row in built:
            where = f"{file}: {kind} {row.name}"
            whole = model.name not in self._broken
            self.errors += check_row(row, self._model, self._plugin, where, complete=whole)
            if self._attempt(self._check_unique, row, where):
                self._rows[row.name] = row
                self._row_files[row.name] = file
                done.append(row)

    def _class_of(self, kind: RequestKind, model: schema.RowModel, where: str) -> str:
        """Return the class of a row; record an error and return none if it is wrong."""
        of_kind = [item.name for item in self._classes.values() if item.kind is kind]
        if model.klass is None:
            if (len(of_kind) > 1 or (self._classes and not of_kind)) and CLASS not in self._broken:
                self._record(
                    IcdError(f"{where}: needs `class`, one of {', '.join(of_kind or self._classes)}")
                )
            return of_kind[0] if of_kind else ""
        found = self._classes.get(model.klass)
        if found is None:
            text = f"{where}: no class named {model.klass!r}{did_you_mean(model.klass, self._classes)}"
            self._record(MissingNameError(text, model.klass))
            return ""
        if found.kind is not kind:
            self._record(IcdError(f"{where}: class {model.klass} is for {found.kind}, not for {kind}"))
        return model.klass

    def _check_unique(self, row: Row, where: str) -> None:
        first = self._unit.first_telemetry_id
        if first is not None and (row.id >= first) != (row.kind == "telemetry"):
            side = f"{first} and up" if row.kind == "telemetry" else f"below {first}"
            raise IcdError(f"{where}: ID {row.id} is not a {row.kind} ID ({side})")
        highest = self._highest_id
        if row.id > highest:
            raise IcdError(f"{where}: ID {row.id} is above {highest}")
        if row.name in self._rows:
            raise IcdError(f"{where}: name used twice")
        code = self._classes[row.klass].code if row.klass else None
        if self._ids.setdefault((code, row.id), row.name) != row.name:
            raise IcdError(f"{where}: ID {row.id} is already used by {self._ids[code, row.id]}")

    def _check_removed(self) -> None:
        """Report the IDs of rows that are not valid, if other rows have them."""
        for file, kind, table in self._removed:
            if not isinstance(table, dict) or not isinstance(table.get("id"), int):
                continue
            name, row_id = table.get("name"), table["id"]
            of_kind = [item.name for item in self._classes.values() if item.kind is kind]
            klass = self._classes.get(str(table.get("class", of_kind[0] if len(of_kind) == 1 else "")))
            if self._classes and klass is None:
                continue
            used = self._ids.get((None if klass is None else klass.code, row_id), name)
            if used != name:
                self.errors.append(f"{file}: {kind} {name}: ID {row_id} is already used by {used}")

    @property
    def _highest_id(self) -> int:
        """Highest ID that the link can carry."""
        header = [] if self._link.serial is None else self._link.serial.request_header
        widths = [bit.width for item in header for bit in item.bits if bit.role == "id"]
        widths += [int(item.type[1:]) for item in header if item.role == "id"]
        return (1 << widths[0]) - 1 if widths else HIGHEST_ID

    def _expand_row(self, kind: RequestKind, where: str, model: schema.RowModel) -> Iterator[Row]:
        provenance = model.provenance or self._unit.provenance
        if provenance is None:
            raise IcdError(f"{where}: needs `provenance`, here or in [unit]")
        last = model.id if model.last_id is None else model.last_id
        if last < model.id:
            raise IcdError(f"{where}: last_id {last} is below ID {model.id}")
        if kind == "telecommand" and model.unsolicited is not None:
            raise IcdError(f"{where}: only telemetry is sent unsolicited")
        if kind == "telemetry" and model.readback is not None:
            raise IcdError(f"{where}: only telecommands have a readback")
        if model.readback is not None and not model.name.startswith(SETS):
            raise IcdError(f"{where}: the name of a telecommand with a readback must begin with {SETS}")
        klass = self._class_of(kind, model, where)
        answers = model.answer
        if answers is None and klass:
            answers = self._classes[klass].answer
        for number, row_id in enumerate(range(model.id, last + 1), 1):
            single = model.last_id is None
            layout = Layout(self, where, kind, provenance, None if single else number)
            for name in model.include or ():
                if name not in self._rows:
                    self._broken.add(model.name)
                    hint = did_you_mean(name, self._rows)
                    raise MissingNameError(f"{where}: include: no row named {name!r}{hint}", name)
                layout.include(self._rows[name])
                if name in self._broken:
                    self._broken.add(model.name)
            for item in model.fields:
                if not self._attempt(layout.add, item):
                    self._broken.add(model.name)
            if model.size is not None and layout.size != model.size and model.name not in self._broken:
                self._broken.add(model.name)  # its ID and bindings can still be checked
                self._record(
                    IcdError(f"{where}: size is {model.size} but the fields add up to {layout.size} bytes")
                )
            yield Row.model_construct(
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
                unsolicited=model.unsolicited,
                arguments={
                    name: number if value == NUMBER else value for name, value in model.arguments.items()
                },
                answers=("reply",) if answers is None else tuple(answers),
                zeros=model.unbound is not None,
                request=model.request or "",
            )

    def _check_answers(self, row: Row) -> None:
        for answer in row.answers:
            kind, _, name = answer.partition(":")
            where = f"{self._path}: {row.kind} {row.name}: answer {answer!r}"
            if kind not in ("echo", "reply", "row") or (kind == "row") != bool(name):
                raise IcdError(f"{where}: must be echo, reply or row:NAME")
            if kind == "row" and (name not in self._rows or self._rows[name].kind != "telemetry"):
                text = f"{where}: no telemetry row with this name{did_you_mean(name, self._rows)}"
                raise MissingNameError(text, name)


def check_text_requests(row: Row, definition: InterfaceDefinition, where: str, *, needed: bool) -> None:
    """Check the text that requests a row; `needed` if requests of other rows of its format are texts."""
    if not row.request:
        if needed:
            raise IcdError(
                f"{where}: needs `request`, a text, as the other rows of its format on link.serial"
            )
        return
    if row.kind == "telecommand" and row.size:
        raise IcdError(f"{where}: `request` is a text without data; it has no fields")
    same = next(item for item in definition.rows if words(item.request) == words(row.request))
    if same is not row:
        raise IcdError(f"{where}: request {row.request!r} is already that of {same.name}")


def _readback(model: schema.RowModel) -> schema.RowModel:
    """Return the telemetry row that reports the last accepted values of a telecommand."""
    changes = {
        "id": model.readback,
        "name": model.name.removeprefix(SETS),
        "doc": "As set.",
        "include": [model.name],
    }
    kept = {"provenance": model.provenance, "source": model.source, "size": model.size}
    return schema.RowModel.model_validate(kept | changes)
