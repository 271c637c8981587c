"""Reads the interface definition of a unit from its TOML files, or lists all errors in them.

Each file is validated on its own (`starhil.protocol.icd.schema`). Invalid parts are dropped so that the rest can still be
checked, and errors that may only follow from a dropped part are not reported. The tables of all files are then combined
in order of their references: enumerations, parameters, rows, links. An error names the file, the table and the key, and
says what to write instead.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, Final, TypeVar

from pydantic import ValidationError

from starhil.protocol.errors import IcdError, did_you_mean, escape_controls
from starhil.protocol.files.bundled import DEFAULT_UNIT, UNITS_FOLDER, find_unit
from starhil.protocol.files.user_file import TomlError, read_user_toml
from starhil.protocol.files.validation import Problem, problems
from starhil.protocol.icd import FieldError, InterfaceDefinition, schema
from starhil.protocol.icd.codec import Row
from starhil.protocol.icd.conventions import Conventions
from starhil.protocol.icd.definition import OTHER_ERROR, Names
from starhil.protocol.icd.link_schema import CubeSpaceFraming, LinkModel, MessageClass
from starhil.protocol.icd.values import Located, MissingNameError, Parameter, Section
from starhil.protocol.messages import FIRST_TELEMETRY_ID, ErrorCode, RequestKind
from starhil.protocol.plugin import Plugin, load_plugin
from starhil.protocol.serial.formats import words
from starhil.protocol.serial.stack import SerialStack
from starhil.protocol.unit.bindings import check_row
from starhil.protocol.unit.layout import NUMBER, Layout, enum_of

_Item = TypeVar("_Item")

SETTER_PREFIX: Final = "set_"
"""Prefix of the names of telecommands that can be read back."""
HIGHEST_ID: Final = 0xFF
"""Highest ID if the link does not limit it."""
MAX_ROWS: Final = 65536

CLASS: Final = "class"
"""Table of the classes; among the broken names if a class is missing."""
UNIT: Final = "unit"
"""Table of the unit; among the broken names if it has errors."""
UNKNOWN_UNIT: Final = schema.UnitModel(name="", version="", doc="", provenance="ours")
"""Stands for a missing table [unit], or one with errors."""


def load_unit(name_or_folder: str | Path = DEFAULT_UNIT) -> InterfaceDefinition:
    """Read the interface definition of a unit: a bundled unit by name, a folder of TOML files, or one file.

    Bundled units are cached. Raises IcdError, whose text names file, row and field.
    """
    path = find_unit(name_or_folder)
    return _load_bundled(path) if path.parent == UNITS_FOLDER else _load(path)


def check_runs_no_code(name_or_folder: str | Path, named_by: str) -> None:
    """Check that reading a unit, which `named_by` names and not the user, runs no Python file but those of this package.

    Raises IcdError.
    """
    path = find_unit(name_or_folder)
    if path.resolve().parent == UNITS_FOLDER:
        return
    file = read_definition(path, run_plugin=False)[0].plugin.skipped
    if file:
        raise IcdError(
            f"{named_by} names the unit {path}, whose Python file {file} would run; if you trust it, name the unit yourself: "
            f"--unit {path}"
        )


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
    reader = _Reader(path, files, run_plugin=run_plugin)
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


class _Reader:
    """Validates the files of a definition, and puts their tables together."""

    def __init__(self, path: Path, files: list[Path], *, run_plugin: bool) -> None:
        self.errors: list[str] = []
        self._path = path
        self._tables: dict[str, list[tuple[Path, Any]]] = {name: [] for name in schema.FileModel.model_fields}
        """The valid tables of all files, each with its file."""
        self._unread = False
        """Whether a file could not be read, so that names may be missing because of that."""
        self._broken: set[str] = set()
        """Names of tables with errors, which are missing, or lack a field."""
        self._removed: list[tuple[Path, RequestKind, Any]] = []
        """Rows that are not valid, with their files."""
        self._rows: dict[str, Row] = {}
        self._expanded = 0
        self._ids: dict[tuple[int | None, int], str] = {}
        """Code of the class and ID → name of the row."""
        for file in files:
            self._read(file)
        self._unit = self._read_unit()
        self._classes: dict[str, MessageClass] = {}
        for file, item in self._tables["classes"]:
            with self._recording(f"{file}: class {item.name}", CLASS, item.name):
                self._add_class(item)
        link = self._single("link", LinkModel())
        self._icd = InterfaceDefinition(
            name=self._unit.name,
            version=self._unit.version,
            doc=self._unit.doc,
            first_telemetry_id=self._first_telemetry_id(link),
            conventions=self._single("conventions", Conventions()),
            errors=self._single("errors", {}),
            link=link,
            canopen=self._single("canopen", None),
            classes=tuple(self._classes.values()),
            plugin=self._read_plugin(run_plugin=run_plugin),
        )

    # --- files ---

    def _read(self, file: Path) -> None:
        try:
            document = read_user_toml(file)
        except OSError as error:
            self.errors.append(f"{file}: cannot read the interface definition: {error.strerror}")
            self._unread = True
            return
        except TomlError as error:
            self.errors.append(f"{file}: not valid TOML: {error}")
            self._unread = True
            return
        is_reported = False
        while True:
            try:
                tables = schema.FileModel.model_validate(document)
                break
            except ValidationError as error:
                faults = list(problems(error, schema.FileModel, document))
                if not is_reported:  # later ones may be caused by what was removed
                    self.errors += [f"{file}: {problem}" for problem in faults]
                is_reported = True
                places = sorted(map(_place, faults), key=lambda place: [f"{step:>9}" for step in place])
                for place in reversed(dict.fromkeys(places)):  # from the last: the other indices stay
                    self._remove(file, document, place)
        for name, given in tables:
            listed = given if isinstance(given, list) else [] if given is None else [given]
            self._tables[name] += [(file, table) for table in listed]

    def _remove(self, file: Path, document: Any, place: tuple[int | str, ...]) -> None:
        """Remove what is invalid from a document, and record the names that are missing because of that."""
        *path, last = place
        table = document[place[0]][place[1]] if len(place) > 1 else None
        name = table.get("name") if isinstance(table, dict) else None
        if isinstance(name, str):
            self._broken |= {name, name.removeprefix(SETTER_PREFIX)}
        if place[0] == CLASS or place == (UNIT,):
            self._broken.add(str(place[0]))
        if len(place) == 2 and place[0] in tuple(RequestKind):
            self._removed.append((file, RequestKind(place[0]), table))
        for step in path:
            document = document[step]
        del document[last]

    def _single(self, name: str, default: _Item) -> _Item:
        """Return a table that occurs once."""
        tables = self._tables[name]
        self.errors += [f"{file}: a second [{name}]; keep one of them" for file, _ in tables[1:]]
        return tables[0][1] if tables else default

    def _file_of(self, name: str) -> Path:
        """Return the file of a table that occurs once."""
        return self._tables[name][0][0] if self._tables[name] else self._path

    @contextmanager
    def _recording(self, where: str, *names: str) -> Iterator[None]:
        """Record the error of a step, except for a name that is missing because of another error.

        `names` are missing, or lack a field, if the step fails.
        """
        try:
            with Located(where):
                yield
        except IcdError as error:
            caused = isinstance(error, MissingNameError) and (self._unread or error.name in self._broken)
            self.errors += () if caused else error.args
            self._broken |= {*names}

    # --- the definition ---

    def _read_unit(self) -> schema.UnitModel:
        unit = self._single(UNIT, UNKNOWN_UNIT)
        if unit is UNKNOWN_UNIT and not self._unread and UNIT not in self._broken:
            self.errors.append(f"{self._path}: no [unit] with name, version and doc")
        return unit

    def _first_telemetry_id(self, link: LinkModel) -> int | None:
        """Return the lowest telemetry ID, which CubeSpace's links fix."""
        first = self._unit.first_telemetry_id
        fixing = [
            name
            for name, fixes in (
                (
                    "link.serial",
                    link.serial is not None and isinstance(link.serial.framing, CubeSpaceFraming),
                ),
                ("link.can", link.can is not None),
            )
            if fixes
        ]
        if not fixing or self._unit is UNKNOWN_UNIT:
            return first
        if first in (None, FIRST_TELEMETRY_ID):
            return FIRST_TELEMETRY_ID
        self.errors.append(
            f"{self._file_of(UNIT)}: unit.first_telemetry_id: {first}, but {fixing[0]} is of CubeSpace, whose telemetry "
            f"begins at {FIRST_TELEMETRY_ID}; set it to {FIRST_TELEMETRY_ID}"
        )
        return first

    def _read_plugin(self, *, run_plugin: bool) -> Plugin:
        if self._unit is UNKNOWN_UNIT:
            return Plugin(skipped="")
        name, file = self._unit.plugin, self._file_of(UNIT)
        if name is not None and run_plugin:
            with self._recording(str(file)):
                return load_plugin(file.parent, name)
        return Plugin(skipped=name)  # also if it fails: its names are unknown, not wrong

    def definition(self) -> InterfaceDefinition:
        icd = self._icd
        for file, item in self._tables["enum"]:
            with self._recording(f"{file}: enum {item.name}"):
                _add(icd.enums, item.name, item)
        sections: dict[str, Section] = {}
        for file, item in self._tables["section"]:
            with self._recording(f"{file}: section {item.heading}"):
                _add(sections, item.heading, item)
        for name, item in icd.model.parameters.items():
            own = None if item.enum is None else icd.enums.get(item.enum.name)
            icd.device_parameters[name] = item if own is None else Parameter.limited(dict(item), own)
        for file, item in self._tables["parameter"]:
            with self._recording(f"{file}: parameter {item.name}"):
                self._add_parameter(item)
        for kind in RequestKind:
            self._add_rows(kind)
        self._check_removed()
        for row in self._rows.values():
            with self._recording(f"{icd.files[row.name]}: {row.kind} {row.name}"):
                self._check_answers(row)
        with self._recording(str(self._file_of("errors"))):
            _check_errors(icd.errors, icd.conventions)
        used = {id(field.enum) for row in self._rows.values() for field in row.fields}
        used |= {id(parameter.enum) for parameter in icd.parameters.values()}
        enums = {name: enum for name, enum in icd.model.enums.items() if id(enum) in used} | icd.enums
        icd = replace(icd, enums=Names("enumeration", enums.items()), sections=tuple(sections.values()))
        with self._recording(str(self._file_of("link"))):
            _check_link(icd)
        return icd

    def _add_class(self, item: MessageClass) -> None:
        same = next((other.name for other in self._classes.values() if other.code == item.code), None)
        if item.name not in self._classes and item.code is not None and same is not None:
            raise IcdError(f"code {item.code} is already used by {same}")
        _add(self._classes, item.name, item)

    def _add_parameter(self, model: schema.ParameterModel) -> None:
        parameters, device = self._icd.parameters, self._icd.model.parameters
        same_id = next((other.name for other in parameters.values() if other.id == model.id), None)
        if same_id is not None and model.name not in parameters:
            raise IcdError(f"ID {model.id} is already used by {same_id}")
        if model.name not in device:
            raise IcdError(f"the device has no parameter with this name{did_you_mean(model.name, device)}")
        base = device[model.name]
        if model.unit not in (None, base.unit):
            raise IcdError(f"unit {model.unit!r}, but in the device it is {base.unit!r}")
        keys = {**dict(base), **{key: value for key, value in model if value is not None}}
        named = model.enumeration or (None if base.enum is None else base.enum.name)
        enum = enum_of(named, self._icd) if keys["type"] == "enum8" else None
        parameter = Parameter.limited(keys, enum, model.id)
        try:
            default = parameter.check(parameter.default)
        except FieldError as error:
            raise IcdError(f"default: {error}") from None
        parameter = parameter.model_copy(update={"default": default})
        _add(parameters, model.name, parameter)
        self._icd.device_parameters[model.name] = parameter

    # --- rows ---

    def _add_rows(self, kind: RequestKind) -> None:
        """Add the rows of a kind, those that include others last."""
        models: list[tuple[Path, schema.RowModel]] = list(self._tables[kind])
        if kind == "telemetry":
            commands = [
                (file, item) for file, item in self._tables["telecommand"] if item.readback is not None
            ]
            models += [(file, _readback(item)) for file, item in commands]
        for file, model in sorted(models, key=lambda item: (bool(item[1].include), item[0])):
            with self._recording(f"{file}: {kind} {model.name}", model.name):
                self._expand_row(kind, file, model)

    def _check_kind(self, kind: RequestKind, model: schema.RowModel) -> None:
        """Raise IcdError for a key that rows of this kind, or with this action, do not have."""
        if kind == "telecommand" and model.unsolicited is not None:
            raise IcdError("only telemetry is sent unsolicited")
        if kind == "telecommand" and model.request is False:
            raise IcdError("only telemetry is sent without a request; remove `request = false`")
        if kind == "telemetry" and model.readback is not None:
            raise IcdError("only telecommands have a readback")
        plugin = self._icd.plugin
        if model.min_size is not None and model.action not in plugin.actions and plugin.skipped is None:
            raise IcdError("`min_size` needs a telecommand with an action of the unit's plugin")
        if model.readback is not None and not model.name.startswith(SETTER_PREFIX):
            raise IcdError(f"the name of a telecommand with a readback must begin with {SETTER_PREFIX}")

    def _expand_row(self, kind: RequestKind, file: Path, model: schema.RowModel) -> None:
        where = f"{file}: {kind} {model.name}"
        provenance = model.provenance or self._unit.provenance
        if provenance is None:
            raise IcdError("needs `provenance`, here or in [unit]")
        ids = self._ids_of(model)
        self._check_kind(kind, model)
        of_kind = [item.name for item in self._classes.values() if item.kind is kind]
        message_class = model.message_class or next(iter(of_kind), "")
        with self._recording(where):
            self._check_class(kind, model, of_kind)
        answers = model.answer
        if message_class not in self._classes:
            message_class = ""
        elif answers is None:
            answers = self._classes[message_class].answer
        single = model.last_id is None
        errors = len(self.errors)
        for number, row_id in enumerate(ids, 1):
            if len(self.errors) > errors:  # the others would repeat it
                self._broken |= {f"{model.name}_{rest}" for rest in range(number, len(ids) + 1)}
                return
            layout = Layout(self._icd, kind, provenance, None if single else number)
            for name in model.include or ():
                with Located("include"):
                    included = _find("row", name, self._rows)
                layout.include(included)
                if name in self._broken:
                    self._broken.add(model.name)
            for item in model.fields:
                with self._recording(where, model.name):
                    layout.add(item)
            if model.name not in self._broken:
                with self._recording(where, model.name):  # its ID and bindings can still be checked
                    _check_sizes(model, layout.size)
            row = Row.model_construct(
                kind=kind,
                id=row_id,
                name=model.name if single else f"{model.name}_{number}",
                size=layout.size,
                min_size=layout.size if model.min_size is None else model.min_size,
                fields=tuple(layout.fields),
                slots=tuple(layout.slots),
                doc=model.doc,
                provenance=provenance,
                source=model.source or (self._unit.source if provenance == "confirmed" else ""),
                message_class=message_class,
                action=model.action,
                confirm=model.confirm,
                unsolicited=model.unsolicited,
                arguments={
                    name: number if value == NUMBER else value for name, value in model.arguments.items()
                },
                answers=("reply",) if answers is None else tuple(answers),
                zeros=model.unbound is not None,
                request=model.request or "",
                only_sent=model.request is False,
            )
            self._add_row(row, file, complete=model.name not in self._broken)

    def _ids_of(self, model: schema.RowModel) -> range:
        """Return the IDs of the rows to which an entry expands."""
        ids = range(model.id, (model.id if model.last_id is None else model.last_id) + 1)
        if not ids:
            raise IcdError(f"last_id {model.last_id} is below ID {model.id}")
        self._expanded += len(ids)
        if self._expanded > MAX_ROWS:
            raise IcdError(f"last_id {ids[-1]} makes {len(ids)} rows; a unit has at most {MAX_ROWS}")
        return ids

    def _add_row(self, row: Row, file: Path, *, complete: bool) -> None:
        where = f"{file}: {row.kind} {row.name}"
        self.errors += [f"{where}: {text}" for text in check_row(row, self._icd, complete=complete)]
        with self._recording(where):
            self._check_id(row)
            self._rows[row.name] = row
            self._icd.files[row.name] = file
            rows = self._icd.telecommands if row.kind == "telecommand" else self._icd.telemetry
            rows[row.name] = row

    def _check_class(self, kind: RequestKind, model: schema.RowModel, of_kind: list[str]) -> None:
        """Raise IcdError if a row lacks its class, or names a wrong one."""
        if model.message_class is not None:
            found = _find("class", model.message_class, self._classes)
            if found.kind is not kind:
                raise IcdError(f"class {model.message_class} is for {found.kind}, not for {kind}")
        elif (len(of_kind) > 1 or (self._classes and not of_kind)) and CLASS not in self._broken:
            raise IcdError(f"needs `class`, one of {', '.join(of_kind or self._classes)}")

    def _check_id(self, row: Row) -> None:
        first = self._icd.first_telemetry_id
        if first is not None and (row.id >= first) != (row.kind == "telemetry"):
            side = f"{first} and up" if row.kind == "telemetry" else f"below {first}"
            raise IcdError(f"ID {row.id} is not a {row.kind} ID ({side})")
        highest = self._highest_id
        if row.id > highest:
            raise IcdError(f"ID {row.id} is above {highest}")
        if row.name in self._rows:
            raise IcdError("name used twice")
        code = self._classes[row.message_class].code if row.message_class else None
        if self._ids.setdefault((code, row.id), row.name) != row.name:
            raise IcdError(f"ID {row.id} is already used by {self._ids[code, row.id]}")

    def _check_removed(self) -> None:
        """Report the IDs of rows that are not valid, if other rows have them."""
        for file, kind, table in self._removed:
            if not isinstance(table, dict) or not isinstance(table.get("id"), int):
                continue
            name, row_id = table.get("name"), table["id"]
            of_kind = [item.name for item in self._classes.values() if item.kind is kind]
            message_class = self._classes.get(
                str(table.get("class", of_kind[0] if len(of_kind) == 1 else ""))
            )
            if self._classes and message_class is None:
                continue
            used = self._ids.get((None if message_class is None else message_class.code, row_id), name)
            if used != name:
                self.errors.append(f"{file}: {kind} {name}: ID {row_id} is already used by {used}")

    @property
    def _highest_id(self) -> int:
        """Highest ID that the link can carry."""
        serial = self._icd.link.serial
        header = [] if serial is None else serial.request_header
        widths = [bit.width for item in header for bit in item.bits if bit.role == "id"]
        widths += [int(item.type[1:]) for item in header if item.role == "id"]
        return (1 << widths[0]) - 1 if widths else HIGHEST_ID

    def _check_answers(self, row: Row) -> None:
        for answer in row.answers:
            kind, _, name = answer.partition(":")
            with Located(f"answer {answer!r}"):
                if kind not in ("echo", "reply", "row") or (kind == "row") != bool(name):
                    raise IcdError("must be echo, reply or row:NAME")
                if kind == "row":
                    _find("telemetry row", name, self._icd.telemetry)


def _add(table: dict[str, _Item], name: str, item: _Item) -> None:
    if name in table:
        raise IcdError("defined twice")
    table[name] = item


def _find(what: str, name: str, items: Mapping[str, _Item]) -> _Item:
    """Return the item of a name. Raises MissingNameError, with similar names."""
    if name not in items:
        raise MissingNameError(f"no {what} named {name!r}{did_you_mean(name, items)}", name)
    return items[name]


def _check_errors(errors: Mapping[str, int], conventions: Conventions) -> None:
    names = [*(code.name.lower() for code in ErrorCode), OTHER_ERROR]
    for name in errors:
        if name not in names:
            raise IcdError(
                f"errors.{name}: no such error{did_you_mean(name, names)} (known: {', '.join(names)})"
            )
    if "crc" in errors and not conventions.telecommand_crc:
        raise IcdError(
            "errors.crc: never sent, because a message with a wrong checksum is not answered; remove it"
        )


def _check_link(icd: InterfaceDefinition) -> None:
    """Check that the parts of the links are compatible with each other and with the rows."""
    serial, can = icd.link.serial, icd.link.can
    for row in icd.rows:
        with Located(f"{row.kind} {row.name}"):
            if "echo" in row.answers:
                if serial is not None and isinstance(serial.framing, CubeSpaceFraming):
                    raise IcdError("answer 'echo': link.serial with framing cubespace has no echoes")
                if can is not None:
                    raise IcdError("answer 'echo': link.can has no echoes")
                if serial is not None and (serial.format or serial.acknowledge or serial.refusal):
                    raise IcdError(
                        "answer 'echo': link.serial with `format`, `acknowledge` or `refusal` has no echoes"
                    )
            if row.request and serial is None:
                raise IcdError("`request` is a text on link.serial, which the unit does not have")
    if serial is None or icd.link_is_unknown:
        return
    if isinstance(serial.framing, CubeSpaceFraming):
        for name in serial.framing.unanswered:
            with Located("link.serial.framing.unanswered"):
                _find("telecommand", name, icd.telecommands)
    stack = SerialStack(icd)
    for row in icd.rows:
        with Located(f"{row.kind} {row.name}"):
            text_form = stack.request_formats.of(row.message_class) in stack.text_formats
            check_text_request(row, icd, needed=text_form)


def check_text_request(row: Row, definition: InterfaceDefinition, *, needed: bool) -> None:
    """Check the text that requests a row; `needed` if requests of other rows of its format are texts."""
    if not row.request:
        if needed and not row.only_sent:
            raise IcdError("needs `request`, a text, as the other rows of its format on link.serial")
        return
    if row.kind == "telecommand" and row.size:
        raise IcdError("`request` is a text without data; it has no fields")
    same = next(item for item in definition.rows if words(item.request) == words(row.request))
    if same is not row:
        raise IcdError(f"request {row.request!r} is already that of {same.name}")


def _check_sizes(model: schema.RowModel, size: int) -> None:
    if model.size not in (None, size):
        raise IcdError(f"size is {model.size} but the fields add up to {size} bytes")
    if model.min_size is not None and model.min_size > size:
        raise IcdError(f"min_size is {model.min_size} but the fields add up to {size} bytes")


def _readback(model: schema.RowModel) -> schema.RowModel:
    """Return the telemetry row that reports the last accepted values of a telecommand."""
    changes = {
        "id": model.readback,
        "name": model.name.removeprefix(SETTER_PREFIX),
        "doc": "As set.",
        "include": [model.name],
    }
    kept = {"provenance": model.provenance, "source": model.source, "size": model.size}
    return schema.RowModel.model_validate(kept | changes)
