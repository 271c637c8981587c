"""Interface of the object dictionary to the device."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from starhil.protocol.canopen.abort import ABORTS, AbortCode, SdoAbortError
from starhil.protocol.canopen.dictionary import Deferred
from starhil.protocol.icd.codec import Row
from starhil.protocol.icd.values import LengthError, MessageError, Value
from starhil.protocol.messages import ErrorCode


@dataclass(frozen=True)
class GreyImage:
    """A greyscale image of 8 bits per pixel, row by row from the top, and its frame counter."""

    width: int
    height: int
    frame: int
    pixels: bytes


class Sample(Protocol):
    """The device at one moment; each method may raise `SdoAbortError` to refuse."""

    def telemetry(self, row: Row) -> bytes:
        """Return the bytes of a telemetry row."""

    def parameter(self, name: str) -> Value:
        """Return a parameter's value in its unit."""


class Application(Protocol):
    """The device behind an object dictionary; each method may raise `SdoAbortError` to refuse."""

    def sample(self) -> Sample:
        """Return the device at this moment, from which all entries of a PDO are read."""

    def telecommand(self, row: Row, payload: bytes) -> Deferred | None:
        """Execute a telecommand whose payload has been checked against its row."""

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
        abort = ABORTS.get(code, (AbortCode.GENERAL,))[0]
        raise SdoAbortError(abort, f"{what}: {code.name.lower()}")


def abort_of(error: MessageError) -> SdoAbortError:
    """Return the SDO abort that corresponds to a violation of the interface definition."""
    return SdoAbortError(
        AbortCode.LENGTH if isinstance(error, LengthError) else AbortCode.VALUE_RANGE, str(error)
    )
