"""The interface definition of a unit, indexed by name and ID; `starhil.protocol.unit.reader` reads it from TOML files."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import chain
from pathlib import Path
from typing import Final, TypeVar

from starhil.protocol.errors import ProtocolError, did_you_mean, remedy
from starhil.protocol.icd.canopen_schema import CanopenModel
from starhil.protocol.icd.codec import Row
from starhil.protocol.icd.conventions import Conventions
from starhil.protocol.icd.device_model import DeviceModel, device_model
from starhil.protocol.icd.link_schema import LinkModel, MessageClass
from starhil.protocol.icd.values import EnumDefinition, Parameter, Section
from starhil.protocol.messages import ErrorCode, Request, RequestKind
from starhil.protocol.plugin import Plugin

_Item = TypeVar("_Item")

OTHER_ERROR: Final = "other"
"""Key in `[errors]` for all errors that the table does not name."""


class UnknownNameError(ProtocolError, KeyError):
    """A name that is not in the interface definition; the text suggests similar ones."""


class Names(dict[str, _Item]):
    """Items by name; a missing name raises UnknownNameError with suggestions, or with all names if they are few."""

    def __init__(self, what: str, items: Iterable[tuple[str, _Item]] = (), *, few: bool = False) -> None:
        super().__init__(items)
        self._what = what
        self._few = few

    def __missing__(self, name: str) -> _Item:
        __tracebackhide__ = True  # pytest shows the caller's line instead
        listed = "; `starhil icd list --unit UNIT` lists all"
        hint = remedy(name, self) if self._few else did_you_mean(name, self) or listed
        raise UnknownNameError(f"no {self._what} named {name!r}{hint}")


SELECTING_ACTIONS: Final = frozenset({"subscribe", "select_unsolicited"})
"""Actions that select rows to be sent unsolicited."""
SELECTION: Final = "unsolicited_selection"
"""Parameter that selects a row to be sent unsolicited."""


@dataclass(frozen=True, eq=False)
class InterfaceDefinition:
    """The interface between a device and an OBC: rows, enumerations and parameters."""

    name: str
    version: str
    doc: str
    telecommands: Names[Row] = field(default_factory=partial(Names, "telecommand"))
    telemetry: Names[Row] = field(default_factory=partial(Names, "telemetry row"))
    enums: Names[EnumDefinition] = field(default_factory=partial(Names, "enumeration"))
    parameters: Names[Parameter] = field(default_factory=partial(Names, "parameter"))
    """The parameters that the unit exposes."""
    device_parameters: Names[Parameter] = field(default_factory=partial(Names, "parameter"))
    """All parameters of the device; those that the unit exposes have the unit's limits and defaults."""
    sections: tuple[Section, ...] = ()
    """Documentation that accompanies the rows, such as conventions."""
    canopen: CanopenModel | None = None
    """Layout of the object dictionary, if the unit has CANopen."""
    link: LinkModel = field(default_factory=LinkModel)
    """The links of the unit."""
    conventions: Conventions = field(default_factory=Conventions)
    classes: tuple[MessageClass, ...] = ()
    errors: Mapping[str, int] = field(default_factory=dict)
    """Error codes on the wire by name; empty: the published codes."""
    first_telemetry_id: int | None = None
    """IDs from this one on are telemetry, even if there is no such row."""
    plugin: Plugin = field(default_factory=Plugin)
    files: dict[str, Path] = field(default_factory=dict)
    """Name of a row → the file that defines it."""

    @property
    def model(self) -> DeviceModel:
        """The device model."""
        return device_model()

    def with_rows(self, names: Iterable[str]) -> InterfaceDefinition:
        """Return the definition with only some of its rows: the telecommand, the telemetry or both of each name."""
        names_once = dict.fromkeys(names)
        for name in names_once:
            if name not in self.telecommands:
                self.telemetry[name]  # an unknown one raises the error with suggestions
        telecommands = Names(
            "telecommand", ((name, row) for name, row in self.telecommands.items() if name in names_once)
        )
        telemetry = Names(
            "telemetry row", ((name, row) for name, row in self.telemetry.items() if name in names_once)
        )
        return replace(self, telecommands=telecommands, telemetry=telemetry)

    @cached_property
    def _rows_by_key(self) -> Mapping[tuple[str, int], Row]:
        """Rows by class and ID, and the first row with each ID by the class ""."""
        rows = tuple(self.rows)
        first = {("", row.id): row for row in reversed(rows)}
        return first | {(row.message_class, row.id): row for row in rows}

    @cached_property
    def classes_by_name(self) -> Mapping[str, MessageClass]:
        """Classes by name."""
        return {item.name: item for item in self.classes}

    @property
    def readable(self) -> list[Row]:
        """Telemetry that a request reads."""
        return [row for row in self.telemetry.values() if not row.only_sent]

    @cached_property
    def reported_telecommands(self) -> frozenset[str]:
        """Names of the telecommands of which telemetry reports what was accepted last."""
        fields = (field for row in self.telemetry.values() for field in row.fields)
        return frozenset(field.telecommand for field in fields if field.telecommand is not None)

    @cached_property
    def selects_unsolicited(self) -> bool:
        """Whether a telecommand or a parameter may select any telemetry row to be sent unsolicited."""
        actions = SELECTING_ACTIONS.union(self.plugin.actions)
        by_command = any(row.action in actions for row in self.telecommands.values())
        return by_command or SELECTION in self.parameters or self.plugin.skipped is not None

    @cached_property
    def parameters_by_id(self) -> Mapping[int, Parameter]:
        """Parameters by ID."""
        return {parameter.id: parameter for parameter in self.parameters.values()}

    def row(self, row_id: int, message_class: str = "") -> Row | None:
        """Return the row with this ID in a class, or the first of any class; None if there is none."""
        return self._rows_by_key.get((message_class, row_id))

    def telemetry_row(self, row_id: int, message_class: str | None = None) -> Row | None:
        """Return the telemetry row with this ID in a class (default: the first of any class), or None."""
        rows = (row for row in self.telemetry.values() if row.id == row_id)
        return next((row for row in rows if message_class in (None, row.message_class)), None)

    def kind_of(self, row_id: int, message_class: str = "") -> RequestKind:
        """Return the kind of an ID, which need not belong to a row; without a class, an unknown one is a telecommand."""
        if message_class in self.classes_by_name:
            return self.classes_by_name[message_class].kind
        if self.first_telemetry_id is not None:
            telemetry = row_id >= self.first_telemetry_id
            return RequestKind.TELEMETRY if telemetry else RequestKind.TELECOMMAND
        row = self.row(row_id)
        return RequestKind.TELECOMMAND if row is None else row.kind

    @staticmethod
    def request(row: Row, data: bytes = b"", source: int = 0) -> Request:
        """Return the request for a row."""
        return Request(row.kind, row.id, data, source, message_class=row.message_class)

    def request_of(self, row_id: int, message_class: str | None = None, data: bytes = b"") -> Request:
        """Return a request by ID, which need not belong to a row, and by class if the unit has classes.

        The default class is that of the first row with this ID, or the first class if there is none.
        """
        classes = self.classes_by_name
        if message_class is None or not classes:
            row = self.row(row_id)
            message_class = next(iter(classes), "") if row is None else row.message_class
        elif message_class not in classes:
            raise UnknownNameError(f"no class named {message_class!r}; the unit has {', '.join(classes)}")
        return Request(self.kind_of(row_id, message_class), row_id, data, message_class=message_class)

    def error_number(self, code: ErrorCode) -> ErrorCode | int:
        if not self.errors:
            return code
        name = code.name.lower()
        if name in self.errors:
            return self.errors[name]
        return 0 if code is ErrorCode.OK else self.errors.get(OTHER_ERROR, int(code))

    @property
    def link_is_unknown(self) -> bool:
        """Whether the serial link is of a plugin that was not run."""
        serial = self.link.serial
        custom = serial is not None and "custom" in (serial.framing.kind, serial.check.kind)
        return custom and self.plugin.skipped is not None

    @property
    def canopen_only(self) -> bool:
        """Whether CANopen is the only link of the unit."""
        return self.canopen is not None and self.link.serial is None and self.link.can is None

    @property
    def error_numbers(self) -> Mapping[str, int]:
        """The unit's code of each error, by name."""
        return self.errors or {code.name.lower(): int(code) for code in ErrorCode}

    def error_name(self, number: int) -> str:
        """Return the name of an error by the unit's code."""
        return next(
            (name for name, known in self.error_numbers.items() if known == number), "unpublished code"
        )

    def enum(self, name: str) -> EnumDefinition:
        """Return an enumeration of the unit or, if it has none of this name, of the device model."""
        return self.enums[name] if name in self.enums else self.model.enums[name]

    @property
    def rows(self) -> Iterator[Row]:
        """All rows: telecommands, then telemetry, each in order of ID."""
        return chain(
            sorted(self.telecommands.values(), key=lambda row: row.id),
            sorted(self.telemetry.values(), key=lambda row: row.id),
        )
