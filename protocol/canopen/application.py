"""Interface of the object dictionary to the device, and a stand-in for tests and exports."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from starhil.protocol.canopen.abort import AbortCode, SdoAbortError
from starhil.protocol.canopen.dictionary import Deferred
from starhil.protocol.codec import Row
from starhil.protocol.definition import InterfaceDefinition
from starhil.protocol.messages import ErrorCode
from starhil.protocol.values import LengthError, MessageError, Value

STATUS_ABORTS = {
    ErrorCode.INVALID_ID: AbortCode.NO_OBJECT,
    ErrorCode.INVALID_LENGTH: AbortCode.LENGTH,
    ErrorCode.INVALID_PARAMETER: AbortCode.VALUE_RANGE,
    ErrorCode.NOT_IMPLEMENTED: AbortCode.UNSUPPORTED_ACCESS,
    ErrorCode.BUSY: AbortCode.DEVICE_STATE,
    ErrorCode.SEQUENCE: AbortCode.DEVICE_STATE,
}


@dataclass(frozen=True)
class GreyImage:
    """A greyscale image of 8 bits per pixel, row by row from the top, and its frame counter."""

    width: int
    height: int
    frame: int
    pixels: bytes


class Application(Protocol):
    """The device behind an object dictionary; each method may raise `SdoAbortError` to refuse."""

    def telemetry(self, row: Row) -> bytes:
        """Return the current bytes of a telemetry row."""

    def telecommand(self, row: Row, payload: bytes) -> Deferred | None:
        """Execute a telecommand whose payload has been checked against its row."""

    def parameter(self, name: str) -> Value:
        """Return a parameter's value in its unit."""

    def set_parameter(self, name: str, value: Value) -> None:
        """Set a parameter; the value is within the limits of the interface definition."""

    def image(self, name: str) -> GreyImage:
        """Return the image `frame` (from the last `take_image`) or `stored` (from save_image)."""

    def take_image(self, name: str) -> Deferred | None:
        """Take an image for reading."""


def check_status(status: int, what: str) -> None:
    """Raise `SdoAbortError` for a published error code other than 0."""
    if status != ErrorCode.OK:
        code = ErrorCode(status)
        raise SdoAbortError(STATUS_ABORTS.get(code, AbortCode.GENERAL), f"{what}: {code.name.lower()}")


def abort_of(error: MessageError) -> SdoAbortError:
    """Return the SDO abort that corresponds to a violation of the interface definition."""
    return SdoAbortError(
        AbortCode.LENGTH if isinstance(error, LengthError) else AbortCode.VALUE_RANGE, str(error)
    )


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
        self._reported = {
            command: [
                row.name
                for row in icd.telemetry.values()
                if any(field.telecommand == command for field in row.named_fields.values())
            ]
            for command in icd.telecommands
        }

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
