"""Conventions in which all rows of a unit report attitude, vectors and time."""

from __future__ import annotations

import datetime as dt
from dataclasses import dataclass
from functools import cached_property
from typing import Final, Literal

from starhil.protocol.values import IcdError

NANOSECONDS: Final = 1_000_000_000
SENSOR_AXES: Final = ("+x", "+y", "+z")
DAY_NS: Final = 86_400 * NANOSECONDS

EPOCHS: Final = {"unix": "1970-01-01", "gps": "1980-01-06", "j2000": "2000-01-01T12:00:00"}
"""Named epochs as Unix times; like Unix time, they do not count leap seconds."""


@dataclass(frozen=True)
class Conventions:
    """Quaternion direction and sign, axes, epoch, byte order and telecommands with a CRC of a unit."""

    quaternion: Literal["rotation", "attitude"] = "rotation"
    scalar_sign: Literal["positive", "any"] = "positive"
    axes: tuple[str, str, str] = SENSOR_AXES
    epoch: str = "unix"
    byte_order: Literal["little", "big"] = "little"
    telecommand_crc: bool = False

    def __post_init__(self) -> None:
        """Reject axes that do not form a right-handed frame, and an unknown epoch."""
        (a, b, c), (d, e, f), (g, h, i) = self.rows
        if a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) != 1:
            raise IcdError(
                f"conventions.axes: {', '.join(self.axes)} is not a right-handed frame; "
                "name each of x, y and z once, with an even number of swaps and minus signs"
            )
        _ = self.epoch_ns

    @cached_property
    def rows(self) -> tuple[tuple[int, int, int], tuple[int, int, int], tuple[int, int, int]]:
        """Rows of the matrix from the sensor frame to the reported frame."""
        one, two, three = (_row(axis) for axis in self.axes)
        return one, two, three

    @cached_property
    def epoch_ns(self) -> int | None:
        """Unix time of the epoch, nanoseconds; None for midnight of the day."""
        if self.epoch == "midnight":
            return None
        try:
            date = dt.datetime.fromisoformat(EPOCHS.get(self.epoch, self.epoch))
        except ValueError:
            known = ", ".join((*EPOCHS, "midnight"))
            raise IcdError(
                f"conventions.epoch: {self.epoch!r} is not one of {known}, nor a date such as 2000-01-01"
            ) from None
        if date.tzinfo is None:
            date = date.replace(tzinfo=dt.UTC)
        return round(date.timestamp()) * NANOSECONDS

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
