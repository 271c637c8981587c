"""Bindings of rows to the device: telemetry to quantities, telecommands to actions; made once at the start."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

from starhil.emulator.device.actions import ACTIONS, PARAMETERS, Action, Outcome
from starhil.emulator.device.device import Device
from starhil.emulator.device.quantities import Getter, getter_of
from starhil.emulator.device.refusal import Refused
from starhil.emulator.device.snapshot import Snapshot
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.icd.codec import Field, Row
from starhil.protocol.icd.device_model import HEALTH, HEALTH_DEFAULTS, PARAMETER
from starhil.protocol.icd.values import Value
from starhil.protocol.messages import ErrorCode, Reply, ReplyKind
from starhil.protocol.serial.checks import crc
from starhil.protocol.unit.bindings import quantity_of
from starhil.protocol.unit.layout import text_of
from starhil.protocol.units_of_measure import factor


class TelemetryBinding:
    """A telemetry row and the quantities of its fields."""

    def __init__(self, row: Row, icd: InterfaceDefinition) -> None:
        self.row = row
        self._after = None if row.action is None else _action_of(row.action, icd)
        self._getters = [
            (field.name, getter)
            for field in row.named_fields.values()
            if (getter := _field_getter(field, icd)) is not None
        ]

    def encode(self, snapshot: Snapshot) -> bytes:
        """Return the bytes of the row at one moment; numbers beyond the range of a field are clipped, or wrap.

        Raises Refused if the row cannot be read then.
        """
        values: dict[str, Value] = {}
        for name, getter in self._getters:
            value = getter(snapshot)
            if value is not None:
                values[name] = value
        return self.row.encode(values, saturate=True)

    def follow(self, device: Device) -> None:
        """Perform the action of the row, if it has one, which follows its reading."""
        if self._after is not None:
            self._after(device, self.row.arguments)


def _field_getter(field: Field, icd: InterfaceDefinition) -> Getter | None:
    """Return the function that computes the value of a field in its unit, or None for an unbound field."""
    if field.telecommand is not None:
        return _accepted(field.telecommand, field.name)
    name = field.value if field.parameter is None else PARAMETER + field.parameter
    if name is None:
        return None
    own = icd.plugin.quantities.get(name)
    getter: Getter = getter_of(name) if own is None else _without_exit(name, own.function)
    if own is None and name.startswith(HEALTH):
        return _health(getter, field, icd)
    declared = quantity_of(name, icd)
    scale = None if declared is None else factor(declared.unit, field.unit)
    if scale not in (None, 1.0):
        getter = _scaled(getter, float(scale or 1.0))
    return getter if field.enum is None else _named(getter, field)


def _health(getter: Getter, field: Field, icd: InterfaceDefinition) -> Getter:
    """Return a getter for a number of the profile's `[health]`.

    If the profile has none, the value is the field's default, otherwise the modelled quantity of its unit.
    """
    for name in HEALTH_DEFAULTS if field.default is None else ():
        scale = factor(icd.model.quantities[name].unit, field.unit)
        if scale is not None:
            modelled = _scaled(getter_of(name), scale)
            return lambda snapshot: modelled(snapshot) if (value := getter(snapshot)) is None else value
    return getter


def _accepted(telecommand: str, name: str) -> Getter:
    return lambda snapshot: snapshot.accepted.get(telecommand, {}).get(name)


def _scaled(getter: Getter, scale: float) -> Getter:
    def scaled(snapshot: Snapshot) -> Value | None:
        value = getter(snapshot)
        return value * scale if isinstance(value, (int, float)) else value

    return scaled


def _named(getter: Getter, field: Field) -> Getter:
    """Return a getter whose values are members of the enumeration of the field, or its default."""
    members = {} if field.enum is None else field.enum.values
    aliases = field.aliases

    def named(snapshot: Snapshot) -> Value | None:
        value = getter(snapshot)
        if value is None:
            return None
        text = text_of(value)
        name = aliases.get(text, text)
        if name in members:
            return name
        return None if isinstance(value, str) else value

    return named


class TelecommandBinding:
    """A telecommand row and its action."""

    def __init__(self, row: Row, icd: InterfaceDefinition) -> None:
        self.row = row
        name = row.action or "nothing"
        self._action = _action_of(name, icd)
        self._may_have_crc = icd.conventions.telecommand_crc
        self._reported = row.name in icd.reported_telecommands
        model = icd.model.actions.get(name)
        declared = {} if model is None else {item.name: item for item in model.arguments}
        self._fixed: dict[str, Any] = {
            key: item.default
            for key, item in declared.items()
            if item.default is not None and "[n]" not in key
        } | dict(row.arguments)
        self._arguments: list[tuple[str, str, Callable[[Any], Any]]] = []
        self._parameters: list[tuple[str, str]] = []
        self._index: dict[str, int] = {}
        for index, field in enumerate(row.named_fields.values()):
            if field.argument is not None:
                item = None if model is None else icd.model.argument(model, field.argument)
                convert = _argument_converter(
                    field, "" if item is None else item.unit, item is not None and item.type == "bool"
                )
                self._arguments.append((field.name, field.argument, convert))
                self._index[field.argument] = index
            elif field.parameter is not None:
                self._parameters.append((field.name, field.parameter))
                self._index[field.parameter] = index

    def execute(self, device: Device, data: bytes) -> Outcome:
        """Decode and execute the telecommand; return the messages that follow the answer, or the pending answer.

        Raises Refused or MessageError with the index of the invalid field.
        """
        values = self.row.decode(self._without_crc(data))
        arguments = dict(self._fixed)
        for name, argument, convert in self._arguments:
            if name in values:  # else the data ended before it
                arguments[argument] = convert(values[name])
        arguments[PARAMETERS] = {parameter: values[name] for name, parameter in self._parameters}
        try:
            outcome = self._action(device, arguments)
        except Refused as refused:
            if refused.argument is not None:
                refused.index = self._index.get(refused.argument, 0)
            raise
        if self._reported:
            device.accepted = MappingProxyType({**device.accepted, self.row.name: MappingProxyType(values)})
        return outcome

    def _without_crc(self, data: bytes) -> bytes:
        """Return the data without the CRC-8 that may follow them. Raises Refused if it is wrong."""
        if not self._may_have_crc or len(data) != self.row.size + 1:
            return data
        if telecommand_crc(data[:-1]) != data[-1]:
            raise Refused(ErrorCode.CRC)
        return data[:-1]


def telecommand_crc(data: bytes) -> int:
    """Return CubeSpace's CRC-8 of a telecommand's data; that of no data is FFh."""
    return crc(data, width=1, poly=0x12, reflect=True) if data else 0xFF


def _argument_converter(field: Field, unit: str, is_bool: bool) -> Callable[[Any], Any]:
    scale = factor(field.unit, unit) if unit else 1.0
    if is_bool:
        return bool
    if scale in (None, 1.0):
        return lambda value: value
    return lambda value: value * scale


def _action_of(name: str, icd: InterfaceDefinition) -> Action:
    """Return the action of a name, of the unit's plugin or of the device."""
    own = icd.plugin.actions.get(name)
    return ACTIONS[name] if own is None else _plugin_action(_without_exit(name, own))


def _without_exit(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function of a plugin whose exit is an error of it, as any other: the device goes on."""

    def call(*arguments: Any) -> Any:
        try:
            return function(*arguments)
        except (Exception, KeyboardInterrupt):
            raise
        except BaseException as error:
            raise RuntimeError(f"the plugin ends with {type(error).__name__} in {name}") from error

    return call


def _plugin_action(function: Callable[[Any, Mapping[str, Any]], Any]) -> Action:
    """Return a function of a plugin as an action; returned bytes become the data of one answer each."""

    def action(device: Device, arguments: Mapping[str, Any]) -> list[Reply]:
        return [
            Reply(ReplyKind.ACK, None, item) if isinstance(item, bytes) else item
            for item in function(device, arguments) or ()
        ]

    return action
