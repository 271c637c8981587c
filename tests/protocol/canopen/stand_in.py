"""A stand-in for the device behind an object dictionary."""

from __future__ import annotations

from starhil.protocol.canopen.abort import AbortCode, SdoAbortError
from starhil.protocol.canopen.application import GreyImage
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.icd.codec import Row
from starhil.protocol.icd.values import Value


class StandInApplication:
    """An application without a device: preset telemetry, stored parameters, recorded telecommands.

    Attributes
    ----------
    rows
        Values of telemetry rows by row name; other rows have their defaults.
    commands
        Telecommands executed: row name and values.
    images, taken
        Images by name; names of the images requested by `take_image`.
    """

    def __init__(self, icd: InterfaceDefinition) -> None:
        self._parameters: dict[str, Value] = {name: item.default for name, item in icd.parameters.items()}
        self.rows: dict[str, dict[str, Value]] = {}
        self.images: dict[str, GreyImage] = {}
        self.taken: list[str] = []
        self.commands: list[tuple[str, dict[str, Value]]] = []
        self._reported: dict[str, list[str]] = {command: [] for command in icd.telecommands}
        for row in icd.telemetry.values():
            for command in {field.telecommand for field in row.named_fields.values()} & self._reported.keys():
                self._reported[command].append(row.name)

    def sample(self) -> StandInApplication:
        """Return this application: it is of one moment."""
        return self

    def telemetry(self, row: Row) -> bytes:
        """Return the preset values, encoded."""
        return row.encode(self.rows.get(row.name, {}))

    def telecommand(self, row: Row, payload: bytes) -> None:
        """Record the telecommand, and set its values in the telemetry that reports them."""
        values = dict(row.decode(payload))
        self.commands.append((row.name, values))
        for name in self._reported[row.name]:
            self.rows[name] = {**self.rows.get(name, {}), **values}

    def parameter(self, name: str) -> Value:
        """Return the stored value."""
        return self._parameters[name]

    def set_parameter(self, name: str, value: Value) -> None:
        """Store the value."""
        self._parameters[name] = value

    def image(self, name: str) -> GreyImage:
        """Return the preset image."""
        if name not in self.images:
            raise SdoAbortError(AbortCode.NO_DATA, name)
        return self.images[name]

    def take_image(self, name: str) -> None:
        """Record the request."""
        self.taken.append(name)
