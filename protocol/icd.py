"""The interface definition of a unit: the TOML files of its folder, validated, indexed by name and id."""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import chain
from pathlib import Path
from typing import Final, TypeVar

from pydantic import ValidationError

from starhil.protocol.codec import Field, FieldKind, Row, RowKind, Slot
from starhil.protocol.errors import ProtocolError
from starhil.protocol.icd_schema import (
    BitModel,
    EnumModel,
    FieldModel,
    FileModel,
    ParameterModel,
    RowModel,
    SectionModel,
)
from starhil.protocol.messages import FIRST_TELEMETRY_ID
from starhil.protocol.unit_folders import DEFAULT_UNIT, UNITS_FOLDER, find_unit
from starhil.protocol.user_file import read_user_text
from starhil.protocol.values import INTEGER_RANGES, EnumDefinition, FieldError, IcdError, Parameter, Section

__all__ = [
    "CanopenTable",
    "IcdError",
    "InterfaceDefinition",
    "Names",
    "UnknownNameError",
    "load_unit",
]

_Item = TypeVar("_Item")

_SLOT_TYPES: Final[dict[str, str]] = {
    "enum8": "u8",
    "enum16": "u16",
    "bits8": "u8",
    "bits16": "u16",
    "bits32": "u32",
}
_SIZES: Final[dict[str, int]] = {
    "u8": 1,
    "i8": 1,
    "u16": 2,
    "i16": 2,
    "u32": 4,
    "i32": 4,
    "u64": 8,
    "i64": 8,
    "f32": 4,
    "f64": 8,
}


class UnknownNameError(ProtocolError, KeyError):
    """A name that is not in the interface definition; the text suggests similar ones."""

    def __str__(self) -> str:
        """Return the plain text (KeyError would quote it)."""
        return str(self.args[0])


class Names(dict[str, _Item]):
    """Items by name; a missing name raises UnknownNameError with suggestions."""

    def __init__(self, what: str, items: Iterable[tuple[str, _Item]]) -> None:
        super().__init__(items)
        self._what = what

    def __missing__(self, name: str) -> _Item:
        near = difflib.get_close_matches(name, self, n=3)
        hint = f"did you mean {', '.join(near)}?" if near else "`starhil icd export markdown` lists all"
        raise UnknownNameError(f"no {self._what} named {name!r} in the interface definition; {hint}")


@dataclass(frozen=True)
class CanopenTable:
    """The table `[canopen]` of a definition, as `starhil.protocol.canopen.layout` reads it."""

    file: Path
    document: Mapping[str, object]


@dataclass(frozen=True)
class InterfaceDefinition:
    """The interface between a device and its OBC: rows, enumerations and parameters."""

    name: str
    version: str
    doc: str
    telecommands: Names[Row]
    telemetry: Names[Row]
    enums: Names[EnumDefinition]
    parameters: Names[Parameter]
    sections: tuple[Section, ...] = ()
    """Documentation that accompanies the rows, such as conventions."""
    canopen: CanopenTable | None = None
    """Layout of the rows in the object dictionary, if the unit has CANopen."""

    @cached_property
    def telecommands_by_id(self) -> Mapping[int, Row]:
        """Telecommands by id."""
        return {row.id: row for row in self.telecommands.values()}

    @cached_property
    def telemetry_by_id(self) -> Mapping[int, Row]:
        """Telemetry by id."""
        return {row.id: row for row in self.telemetry.values()}

    @cached_property
    def parameters_by_id(self) -> Mapping[int, Parameter]:
        """Parameters by id."""
        return {parameter.id: parameter for parameter in self.parameters.values()}

    def row_by_id(self, row_id: int) -> Row | None:
        """Return the telecommand or telemetry row with this id, or None."""
        table = self.telemetry_by_id if row_id >= FIRST_TELEMETRY_ID else self.telecommands_by_id
        return table.get(row_id)

    @property
    def rows(self) -> Iterator[Row]:
        """All rows: telecommands, then telemetry, each in order of id."""
        return chain(
            (self.telecommands_by_id[key] for key in sorted(self.telecommands_by_id)),
            (self.telemetry_by_id[key] for key in sorted(self.telemetry_by_id)),
        )


def load_unit(name_or_folder: str | Path = DEFAULT_UNIT) -> InterfaceDefinition:
    """Read the interface definition of a unit: a name that ships with the package, a folder of TOML files, or one file.

    A unit that ships is read once. Raises IcdError, whose text names file, row and field.
    """
    path = find_unit(name_or_folder)
    return _load_shipped(path) if path.parent == UNITS_FOLDER else _load(path)


@cache
def _load_shipped(path: Path) -> InterfaceDefinition:
    return _load(path)


def _load(path: Path) -> InterfaceDefinition:
    if path.is_dir():
        files = sorted(path.glob("*.toml"))
        if not files:
            raise IcdError(f"{path}: no .toml file of an interface definition in this folder")
    else:
        files = [path]
    builder = _Builder()
    for file in files:
        builder.add(file, _read(file))
    return builder.build(path)


def _read(file: Path) -> FileModel:
    try:
        document = tomllib.loads(read_user_text(file))
    except OSError as error:
        raise IcdError(f"{file}: cannot read the interface definition: {error.strerror}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise IcdError(f"{file}: not valid TOML: {error}") from None
    try:
        return FileModel.model_validate(document)
    except ValidationError as error:
        first = error.errors()[0]
        raise IcdError(f"{file}: {_key_path(document, first['loc'])}: {first['msg']}") from None


def _key_path(document: object, location: tuple[int | str, ...]) -> str:
    """Return a key's dotted path, with names of rows and fields instead of positions."""
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


class _Builder:
    """Collects the files of a definition and validates them together."""

    def __init__(self) -> None:
        self._head: tuple[str, str, str] | None = None
        self._enums: dict[str, EnumDefinition] = {}
        self._parameters: dict[str, Parameter] = {}
        self._row_models: dict[RowKind, list[tuple[Path, RowModel]]] = {"telecommand": [], "telemetry": []}
        self._parameter_models: list[tuple[Path, ParameterModel]] = []
        self._sections: list[Section] = []
        self._canopen: CanopenTable | None = None

    def add(self, file: Path, model: FileModel) -> None:
        if model.definition is not None:
            if self._head is not None:
                raise IcdError(f"{file}: a second [definition]; keep one of them")
            self._head = (model.definition.name, model.definition.version, model.definition.doc)
        for enum in model.enum:
            self._add_enum(file, enum)
        for section in model.section:
            self._add_section(file, section)
        if model.canopen is not None:
            if self._canopen is not None:
                raise IcdError(f"{file}: a second [canopen]; keep one of them")
            self._canopen = CanopenTable(file, model.canopen)
        self._row_models["telecommand"] += [(file, row) for row in model.telecommand]
        self._row_models["telemetry"] += [(file, row) for row in model.telemetry]
        self._parameter_models += [(file, parameter) for parameter in model.parameter]

    def build(self, path: Path) -> InterfaceDefinition:
        if self._head is None:
            raise IcdError(f"{path}: no [definition] with name, version and doc")
        for file, model in self._parameter_models:
            self._add_parameter(file, model)
        rows: dict[str, Row] = {}
        telecommands = self._build_rows("telecommand", rows)
        telemetry = self._build_rows("telemetry", rows)
        name, version, doc = self._head
        return InterfaceDefinition(
            name=name,
            version=version,
            doc=doc,
            telecommands=Names("telecommand", ((row.name, row) for row in telecommands)),
            telemetry=Names("telemetry", ((row.name, row) for row in telemetry)),
            enums=Names("enumeration", self._enums.items()),
            parameters=Names("parameter", self._parameters.items()),
            sections=tuple(self._sections),
            canopen=self._canopen,
        )

    def _add_section(self, file: Path, model: SectionModel) -> None:
        where = f"{file}: section {model.heading}"
        if any(other.heading == model.heading for other in self._sections):
            raise IcdError(f"{where}: defined twice")
        for number, row in enumerate(model.rows, 1):
            if len(row) != len(model.columns):
                raise IcdError(f"{where}: row {number} has {len(row)} cells, must have {len(model.columns)}")
        rows = tuple(tuple(row) for row in model.rows)
        self._sections.append(Section(model.heading, tuple(model.paragraphs), tuple(model.columns), rows))

    def _add_enum(self, file: Path, model: EnumModel) -> None:
        if model.name in self._enums:
            raise IcdError(f"{file}: enum {model.name}: defined twice")
        if len(set(model.values.values())) != len(model.values):
            raise IcdError(f"{file}: enum {model.name}: two names have one number")
        self._enums[model.name] = EnumDefinition(model.name, model.doc, dict(model.values))

    def _enum(self, name: str | None, where: str) -> EnumDefinition:
        if name is None:
            raise IcdError(f"{where}: type enum needs `enum`, the name of an enumeration")
        if name not in self._enums:
            raise IcdError(f"{where}: no enumeration named {name!r}; known: {', '.join(sorted(self._enums))}")
        return self._enums[name]

    def _add_parameter(self, file: Path, model: ParameterModel) -> None:
        where = f"{file}: parameter {model.name}"
        if model.name in self._parameters:
            raise IcdError(f"{where}: defined twice")
        same_id = next((other.name for other in self._parameters.values() if other.id == model.id), None)
        if same_id is not None:
            raise IcdError(f"{where}: id {model.id} is already used by {same_id}")
        enum = self._enum(model.enum, where) if model.type == "enum8" else None
        low, high = self._parameter_limits(model, enum, where)
        parameter = Parameter(
            model.id, model.name, model.type, model.unit, low, high, model.default, model.doc, enum
        )
        try:
            default = parameter.check(model.default)
        except FieldError as error:
            raise IcdError(f"{where}: default: {error}") from None
        self._parameters[model.name] = Parameter(
            model.id, model.name, model.type, model.unit, low, high, default, model.doc, enum
        )

    @staticmethod
    def _parameter_limits(
        model: ParameterModel, enum: EnumDefinition | None, where: str
    ) -> tuple[float, float]:
        if enum is not None:
            return float(min(enum.values.values())), float(max(enum.values.values()))
        if model.type == "bool":
            return 0.0, 1.0
        if model.min is None or model.max is None or not model.min <= model.max:
            raise IcdError(f"{where}: needs min and max, min not above max")
        low, high = INTEGER_RANGES.get(model.type, (float("-inf"), float("inf")))
        if model.min < low or model.max > high:
            raise IcdError(f"{where}: limits {model.min:g} to {model.max:g} do not fit type {model.type}")
        return model.min, model.max

    def _build_rows(self, kind: RowKind, rows: dict[str, Row]) -> list[Row]:
        models = self._row_models[kind]
        waiting = [(file, model) for file, model in models if model.include]
        done: list[Row] = []
        for file, model in chain(((file, model) for file, model in models if not model.include), waiting):
            for row in self._expand_row(kind, file, model, rows):
                self._check_unique(file, row, done, rows)
                rows[row.name] = row
                done.append(row)
        return done

    @staticmethod
    def _check_unique(file: Path, row: Row, done: list[Row], rows: Mapping[str, Row]) -> None:
        where = f"{file}: {row.kind} {row.name}"
        if (row.id >= FIRST_TELEMETRY_ID) != (row.kind == "telemetry"):
            side = "128 to 255" if row.kind == "telemetry" else "0 to 127"
            raise IcdError(f"{where}: id {row.id} is not a {row.kind} id ({side})")
        if row.name in rows:
            raise IcdError(f"{where}: name used twice")
        same_id = next((other.name for other in done if other.id == row.id), None)
        if same_id is not None:
            raise IcdError(f"{where}: id {row.id} is already used by {same_id}")

    def _expand_row(
        self, kind: RowKind, file: Path, model: RowModel, rows: Mapping[str, Row]
    ) -> Iterator[Row]:
        where = f"{file}: {kind} {model.name}"
        if (model.fields is None) == (model.include is None):
            raise IcdError(f"{where}: needs either `fields` or `include`")
        layout = _Layout(self, where, model.provenance)
        if model.include is not None:
            for name in model.include:
                if name not in rows:
                    raise IcdError(f"{where}: include: no row named {name!r}")
                layout.include(rows[name])
        for item in model.fields or ():
            layout.add(item)
        if layout.size != model.size:
            raise IcdError(f"{where}: size is {model.size} but the fields make {layout.size} bytes")
        last = model.id if model.last_id is None else model.last_id
        if last < model.id:
            raise IcdError(f"{where}: last_id {last} is below id {model.id}")
        for row_id in range(model.id, last + 1):
            suffix = "" if model.last_id is None else f"_{row_id - model.id + 1}"
            yield Row(
                kind=kind,
                id=row_id,
                name=model.name + suffix,
                size=model.size,
                fields=tuple(layout.fields),
                slots=tuple(layout.slots),
                doc=model.doc,
                provenance=model.provenance,
                source=model.source,
            )

    def check_parameter(self, name: str | None, unit: str, where: str) -> str | None:
        """Check that a field's parameter exists and has the field's unit."""
        if name is None:
            return None
        if name not in self._parameters:
            raise IcdError(f"{where}: no parameter named {name!r}")
        if self._parameters[name].unit != unit:
            raise IcdError(
                f"{where}: unit {unit!r}, but parameter {name} has {self._parameters[name].unit!r}; they must agree"
            )
        return name

    def enum_of(self, name: str | None, where: str) -> EnumDefinition:
        """Return an enumeration by name."""
        return self._enum(name, where)


class _Layout:
    """Places the fields of one row one after another."""

    def __init__(self, builder: _Builder, where: str, provenance: str) -> None:
        self._builder = builder
        self._where = where
        self._provenance = provenance
        self.fields: list[Field] = []
        self.slots: list[Slot] = []
        self.size = 0

    def include(self, row: Row) -> None:
        """Append the fields of another row."""
        moved = {slot.index: self._slot(slot.type, slot.size) for slot in row.slots}
        for item in row.fields:
            self._append(replace(item, slot=moved[item.slot.index]))

    def add(self, model: FieldModel) -> None:
        """Append a field, a series of numbered fields, or the bits of a bit field."""
        where = f"{self._where}: field {model.name or 'unused'}"
        if model.type.startswith("bits"):
            self._add_bits(model, where)
            return
        if model.bits:
            raise IcdError(f"{where}: only types bits8, bits16 and bits32 have bits")
        if model.type in ("bytes", "text"):
            if model.size is None:
                raise IcdError(f"{where}: type {model.type} needs a size")
        elif model.size is not None:
            raise IcdError(f"{where}: type {model.type} has a fixed size; remove `size`")
        for number in range(1, (model.count or 1) + 1):
            suffix = f"_{number}" if model.count else ""
            self._append(self._field(model, where, suffix))

    def _field(self, model: FieldModel, where: str, suffix: str) -> Field:
        kind: FieldKind
        if model.name is None:
            kind = "unused"
        elif model.type.startswith("enum"):
            kind = "enum"
        elif model.type in ("f32", "f64"):
            kind = "float"
        elif model.type == "bytes":
            kind = "bytes"
        elif model.type == "text":
            kind = "text"
        else:
            kind = "integer"
        if model.type in ("bytes", "text"):
            slot = self._slot("bytes", model.size or 0)
        else:
            scalar = _SLOT_TYPES.get(model.type, model.type)
            slot = self._slot(scalar, _SIZES[scalar])
        enum = self._builder.enum_of(model.enum, where) if kind == "enum" else None
        self._check_limits(model, where)
        return Field(
            name=(model.name or "") + (suffix if model.name else ""),
            kind=kind,
            slot=slot,
            unit=model.unit,
            scale=model.scale,
            bias=model.offset,
            minimum=model.min,
            maximum=model.max,
            enum=enum,
            default=self._default(model.default, enum, where),
            parameter=self._builder.check_parameter(model.parameter, model.unit, where),
            provenance=model.provenance or self._provenance,
            doc=model.doc,
            wrap=model.wrap,
        )

    def _add_bits(self, model: FieldModel, where: str) -> None:
        if not model.bits or model.count:
            raise IcdError(f"{where}: type {model.type} needs `bits` and takes no count")
        scalar = _SLOT_TYPES[model.type]
        slot = self._slot(scalar, _SIZES[scalar])
        shift = 0
        for bit in model.bits:
            self._append(self._bit(model, bit, slot, shift, f"{self._where}: field {bit.name or 'unused'}"))
            shift += bit.width
        if shift != 8 * slot.size:
            raise IcdError(f"{where}: the bits make {shift}, must be {8 * slot.size}")

    def _bit(self, model: FieldModel, bit: BitModel, slot: Slot, shift: int, where: str) -> Field:
        kind: FieldKind
        if bit.name is None:
            kind = "unused"
        elif bit.enum is not None:
            kind = "enum"
        else:
            kind = "flag" if bit.width == 1 else "bits"
        enum = self._builder.enum_of(bit.enum, where) if kind == "enum" else None
        if enum is not None and max(enum.values.values()) >= 2**bit.width:
            raise IcdError(f"{where}: enumeration {enum.name} does not fit {bit.width} bits")
        return Field(
            name=bit.name or "",
            kind=kind,
            slot=slot,
            shift=shift,
            width=bit.width,
            enum=enum,
            default=self._default(bit.default, enum, where),
            parameter=self._builder.check_parameter(bit.parameter, "", where),
            provenance=model.provenance or self._provenance,
            doc=bit.doc,
        )

    def _slot(self, scalar: str, size: int) -> Slot:
        slot = Slot(len(self.slots), scalar, self.size, size)
        self.slots.append(slot)
        self.size += size
        return slot

    def _append(self, item: Field) -> None:
        if item.name and any(other.name == item.name for other in self.fields):
            raise IcdError(f"{self._where}: field {item.name}: name used twice in the row")
        self.fields.append(item)

    @staticmethod
    def _check_limits(model: FieldModel, where: str) -> None:
        if model.min is not None and model.max is not None and model.min > model.max:
            raise IcdError(f"{where}: min {model.min:g} is above max {model.max:g}")
        if model.wrap and not model.type.startswith("u"):
            raise IcdError(f"{where}: wrap: only unsigned integers wrap")
        if model.wrap and (model.min, model.max) != (None, None):
            raise IcdError(f"{where}: wrap: a field that wraps has no min and max")
        limits = INTEGER_RANGES.get(model.type)
        if limits is None:
            return
        for name, value in (("min", model.min), ("max", model.max)):
            if (
                value is not None
                and not limits[0] <= round((value - model.offset) / model.scale) <= limits[1]
            ):
                raise IcdError(f"{where}: {name} {value:g} does not fit type {model.type} with its scale")

    @staticmethod
    def _default(
        value: bool | float | str | None, enum: EnumDefinition | None, where: str
    ) -> bool | int | float | str | None:
        if enum is not None and value is not None and value not in enum.values:
            raise IcdError(f"{where}: default {value!r} is not in enumeration {enum.name}")
        return value
