"""The definition as data: the one module of the judge that knows the types of `starhil.protocol`.

It copies what the TOML files say, field by field. What follows from it (offsets, bit positions, sizes) is counted
here from the order of the fields, so that an error of the product's layout is not copied. Deliberately shared, as
docs/rules.md says: the reader of the TOML files, and the framing and check of a unit's own plugin.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property
from pathlib import Path
from typing import Any

from starhil.hil_tests.judge.framings import Measure, Taken
from starhil.hil_tests.judge.messages import PUBLISHED, Request, Value
from starhil.hil_tests.judge.rows import PARAMETER, SIZES, Field, Row, single
from starhil.protocol.files.bundled import UNITS_FOLDER, find_unit
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.serial.framings import Receiving
from starhil.protocol.unit import load_unit


@dataclass(frozen=True)
class Parameter:
    """A parameter of the device; `id` is 0 if the unit does not expose it."""

    id: int
    name: str
    type: str
    unit: str
    minimum: float
    maximum: float
    default: bool | int | float | str
    enum: Mapping[str, int] | None
    of_link: bool
    """Whether it changes how the unit is reached."""

    @property
    def default_number(self) -> float:
        """Number of the default, as telecommands that set any parameter carry it."""
        return float(self.enum[str(self.default)] if self.enum is not None else self.default)

    def value_of(self, number: float) -> bool | int | float | str | None:
        """Return the value for which a number stands; None if it is none of the parameter's."""
        if self.enum is not None:
            return next((name for name, known in self.enum.items() if known == number), None)
        low, high = self.minimum, self.maximum
        if self.type == "f32":  # the limits may be rounded to single precision
            low, high = min(low, single(low)), max(high, single(high))
        if not low <= number <= high:
            return None
        if self.type.startswith("f"):
            return number
        return None if number % 1 else bool(number) if self.type == "bool" else int(number)


@dataclass(frozen=True)
class Unit:
    """The definition of a unit.

    Attributes
    ----------
    folder
        Folder of its files, in which its own cases stand; None for a definition in one file.
    parameters, device_parameters
        Parameters that the unit exposes, and all of the device, by name.
    serial, can
        Models of `[link.serial]` and `[link.can]`; None if the unit does not have the link.
    unanswered
        Rows that the serial line does not answer.
    errors, device_errors
        Number of each error of a request, and of each cause of the error mode, by name.
    modes
        Names of the modes.
    canopen
        Model of `[canopen]`: objects and PDOs; None if the unit has none.
    """

    name: str
    version: str
    folder: Path | None
    telecommands: Mapping[str, Row]
    telemetry: Mapping[str, Row]
    parameters: Mapping[str, Parameter]
    device_parameters: Mapping[str, Parameter]
    serial: Any
    can: Any
    conventions: Any
    classes: tuple[Any, ...] = ()
    unanswered: frozenset[str] = frozenset()
    errors: Mapping[str, int] = field(default_factory=dict)
    device_errors: Mapping[str, int] = field(default_factory=dict)
    modes: tuple[str, ...] = ()
    first_telemetry_id: int | None = None
    plugin: Any = None
    canopen: Any = None

    @cached_property
    def rows(self) -> tuple[Row, ...]:
        """All rows: telecommands, then telemetry, each in the order of IDs."""
        tables = (self.telecommands, self.telemetry)
        return tuple(row for table in tables for row in sorted(table.values(), key=lambda row: row.id))

    @cached_property
    def readable(self) -> Mapping[str, Row]:
        """Telemetry that a request reads, by name."""
        return {name: row for name, row in self.telemetry.items() if not row.only_sent}

    @cached_property
    def parameters_by_id(self) -> Mapping[int, Parameter]:
        return {item.id: item for item in self.parameters.values()}

    @cached_property
    def by_key(self) -> Mapping[tuple[str, int], Row]:
        """Rows by class and ID."""
        return {(row.message_class, row.id): row for row in self.rows}

    def row(self, request: Request) -> Row | None:
        """Return the row of a request; without a class, the first row with its ID."""
        found = self.by_key.get((request.message_class, request.id))
        if found is None and not request.message_class:
            found = next((row for row in self.rows if row.id == request.id), None)
        return found

    def is_telemetry(self, message_class: str, row_id: int) -> bool:
        """Return whether an ID, which need not belong to a row, is telemetry."""
        kind = next((item.kind for item in self.classes if item.name == message_class), None)
        if kind is not None:
            return str(kind.value) == "telemetry"
        if self.first_telemetry_id is not None:
            return row_id >= self.first_telemetry_id
        return any(row.id == row_id for row in self.telemetry.values())

    def serial_answers(self, row: Row) -> Sequence[str]:
        return () if row.name in self.unanswered else row.answers

    @cached_property
    def reported(self) -> tuple[tuple[Row, Row, Mapping[str, str]], ...]:
        """Each telecommand all of whose fields a telemetry row reports, the row, and the row's field for each of them.

        The row includes the fields of the telecommand, or has the same parameters in the same layout.
        """
        reports = {}
        for row in self.readable.values():
            for name in {
                item.telecommand: None for item in row.named.values() if item.telecommand is not None
            }:
                command = self.telecommands[name]
                reports[name, row.name] = command, row, {field: field for field in command.named}
        for command in self.telecommands.values():
            fields = {
                item.of_parameter: item.name for item in command.named.values() if item.parameter is not None
            }
            for row in self.readable.values() if command.action == "set_parameters" and fields else ():
                places = {
                    fields[item.of_parameter]: item.name
                    for item in row.named.values()
                    if item.of_parameter in fields
                }
                if len(places) == len(fields):
                    reports[command.name, row.name] = command, row, places
        return tuple(reports.values())

    def request(self, row: Row | int, data: bytes = b"", message_class: str = "") -> Request:
        """Return the request for a row, or for an ID, which need not belong to one."""
        if isinstance(row, int):
            return Request(row, data, message_class, self.is_telemetry(message_class, row))
        return Request(row.id, data, row.message_class, row.is_telemetry)

    def code(self, error: str) -> int:
        if not self.errors:
            return PUBLISHED.index(error)
        return self.errors.get(error, self.errors.get("other", PUBLISHED.index(error)))


def read_unit(name_or_folder: str | Path) -> Unit:
    """Return the definition of a unit: a bundled unit by name, a folder of TOML files, or one file.

    Bundled units are cached.
    """
    path = find_unit(name_or_folder)
    return _read_bundled(path) if path.parent == UNITS_FOLDER else _read(path)


@cache
def _read_bundled(path: Path) -> Unit:
    return _read(path)


def _read(path: Path) -> Unit:
    return unit_of(load_unit(path), path if path.is_dir() else None)


def unit_of(icd: InterfaceDefinition, folder: Path | None = None) -> Unit:
    """Return a definition in the judge's types."""
    serial = icd.link.serial
    return Unit(
        name=icd.name,
        version=icd.version,
        folder=folder,
        telecommands={row.name: _row(row, icd) for row in icd.telecommands.values()},
        telemetry={row.name: _row(row, icd) for row in icd.telemetry.values()},
        parameters={item.name: _parameter(item) for item in icd.parameters.values()},
        device_parameters={item.name: _parameter(item) for item in icd.device_parameters.values()},
        serial=serial,
        can=icd.link.can,
        conventions=icd.conventions,
        classes=icd.classes,
        unanswered=frozenset(
            {row.name for row in icd.rows if not row.answers}
            | set(getattr(serial.framing, "unanswered", ()) if serial is not None else ())
        ),
        errors=icd.errors,
        device_errors=icd.enum("device_error").values,
        modes=tuple(icd.model.enums["mode"].values),
        first_telemetry_id=icd.first_telemetry_id,
        plugin=icd.plugin,
        canopen=icd.canopen,
    )


def _parameter(item: Any) -> Parameter:
    enum = None if item.enum is None else item.enum.values
    limits = item.minimum, item.maximum
    return Parameter(
        item.id, item.name, item.type, item.unit, *limits, item.default, enum, bool(item.profile_key)
    )


def _row(row: Any, icd: InterfaceDefinition) -> Row:
    return Row(
        row.kind, row.id, row.name, tuple(_fields(row, icd)), row.message_class, row.provenance, row.source, row.action, row.arguments,
        row.answers, row.request, row.unsolicited, row.only_sent, row.min_size,
    )  # fmt: skip


def _fields(row: Any, icd: InterfaceDefinition) -> Iterator[Field]:
    """Yield the fields of a row in wire order: bytes follow bytes, and bits of the same bytes follow bits.

    A number without limits of its own has those of the parameter that it sets or reports.
    """
    offset = 0
    for slot in row.slots:
        size = SIZES.get(slot.type, slot.size)
        shift = 0
        for item in row.fields:
            if item.slot.index != slot.index:
                continue
            default: Value | None = item.default
            bound = icd.device_parameters[item.parameter] if item.parameter is not None else None
            if bound is None or item.kind not in ("integer", "float") or bound.enum is not None:
                bound = item
            yield Field(
                item.name, item.kind, slot.type, slot.order, offset, size, shift, item.width, item.scale, item.bias,
                bound.minimum if item.minimum is None else item.minimum,
                bound.maximum if item.maximum is None else item.maximum,
                None if item.enum is None else item.enum.values, default, item.const,
                item.value, item.argument, item.telecommand, item.unit, frozenset(item.aliases.values()),
                item.parameter or (value.removeprefix(PARAMETER) if (value := item.value or "").startswith(PARAMETER) else None),
                item.wrap,
            )  # fmt: skip
            shift += item.width
        offset += size


class PluginFraming:
    """A framing of a plugin, whose own deframer finds the messages."""

    marks = b"\x1f\x7f\xff"

    def __init__(self, unit: Unit) -> None:
        link = unit.serial
        self._framing = unit.plugin.framings[link.framing.name]()
        self.start, self.end = self._framing.start, self._framing.end
        self._sizes = link.max_size or 1 << 16, link.timeout

    def encode(self, body: bytes) -> bytes:
        line: bytes = self._framing.encode(body)
        return line

    def take(self, received: bytearray, measure: Measure) -> Taken | None:
        """Remove the first message that the plugin finds."""
        deframer = self._framing.deframer(Receiving(lambda body: body, measure, *self._sizes))
        for position, byte in enumerate(received, 1):
            for found in deframer.feed(bytes((byte,)), 0.0):
                line = bytes(received[:position])
                del received[:position]
                return Taken(found) if isinstance(found, bytes) else Taken(line, junk=True)
        return None
