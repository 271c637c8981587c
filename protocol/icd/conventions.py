"""Conventions in which all rows of a unit report attitude, vectors and time."""

from __future__ import annotations

import datetime as dt
from functools import cached_property
from typing import Final, Literal

from pydantic import Field, field_validator
from pydantic_core import PydanticCustomError

from starhil.protocol.icd.values import DefinitionModel

NANOSECONDS: Final = 1_000_000_000
DAY_NS: Final = 86_400 * NANOSECONDS

EPOCHS: Final = {"unix": "1970-01-01", "gps": "1980-01-06", "j2000": "2000-01-01T12:00:00"}
"""Named epochs as Unix times; like Unix time, they do not count leap seconds."""

Axis = Literal["+x", "-x", "+y", "-y", "+z", "-z"]
Order = Literal["little", "big"]
SENSOR_AXES: Final[list[Axis]] = ["+x", "+y", "+z"]


class Conventions(DefinitionModel):
    """How all rows report attitude, vectors and time."""

    quaternion: Literal["rotation", "attitude"] = "rotation"
    """`rotation`: v_sensor = q v q*; `attitude`: the conjugate, the q of an attitude matrix A(q)."""
    scalar_sign: Literal["positive", "any"] = "positive"
    """`positive`: the scalar part is never negative; `any`: the sign that gives the quaternion closer to that of
    the last valid frame."""
    axes: list[Axis] = Field(default=SENSOR_AXES, min_length=3, max_length=3)
    """Axes of the reported frame in the sensor frame (+x right in the image, +y down, +z boresight)."""
    epoch: str = "unix"
    """Epoch of all times: `unix`, `gps`, `j2000`, `midnight` (of the current day), or a date such as
    `2000-01-01`."""
    byte_order: Order = "little"
    """Default byte order of fields."""
    telecommand_crc: bool = False
    """Whether the CRC-8 of its data may follow the data of a telecommand: reflected polynomial 12h, initial value
    0, but FFh without data (CubeSpace). If it is wrong, the telecommand is refused with `crc`."""

    @field_validator("axes")
    @classmethod
    def _right_handed(cls, axes: list[Axis]) -> list[Axis]:
        (a, b, c), (d, e, f), (g, h, i) = (_row(axis) for axis in axes)
        if a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) != 1:
            raise PydanticCustomError(
                "definition",
                "{axes} is not a right-handed frame; "
                "name each of x, y and z once, with an even number of swaps and minus signs",
                {"axes": ", ".join(axes)},
            )
        return axes

    @field_validator("epoch")
    @classmethod
    def _known(cls, epoch: str) -> str:
        try:
            _unix_ns(epoch)
        except ValueError:
            names = ", ".join((*EPOCHS, "midnight"))
            raise PydanticCustomError(
                "definition",
                "{epoch} is not one of {known}, nor a date such as 2000-01-01",
                {"epoch": repr(epoch), "known": names},
            ) from None
        return epoch

    @cached_property
    def rows(self) -> tuple[tuple[int, int, int], tuple[int, int, int], tuple[int, int, int]]:
        """Rows of the matrix from the sensor frame to the reported frame."""
        one, two, three = (_row(axis) for axis in self.axes)
        return one, two, three

    @cached_property
    def epoch_ns(self) -> int | None:
        """Unix time of the epoch, nanoseconds; None for midnight of the day."""
        return _unix_ns(self.epoch)

    def reported_ns(self, unix_ns: int) -> int:
        """Convert a Unix time to nanoseconds since the unit's epoch."""
        return unix_ns % DAY_NS if self.epoch_ns is None else unix_ns - self.epoch_ns

    def unix_ns(self, reported_ns: int, now_ns: int) -> int:
        """Convert time since the unit's epoch to Unix time, ns; `now_ns` sets the day of a midnight epoch."""
        return (
            now_ns - now_ns % DAY_NS + reported_ns if self.epoch_ns is None else reported_ns + self.epoch_ns
        )


def _row(axis: str) -> tuple[int, int, int]:
    sign = -1 if axis[0] == "-" else 1
    return (sign * (axis[1] == "x"), sign * (axis[1] == "y"), sign * (axis[1] == "z"))


def _unix_ns(epoch: str) -> int | None:
    if epoch == "midnight":
        return None
    date = dt.datetime.fromisoformat(EPOCHS.get(epoch, epoch))
    if date.tzinfo is None:
        date = date.replace(tzinfo=dt.UTC)
    return round(date.timestamp()) * NANOSECONDS
