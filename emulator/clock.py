"""Run time: how fast the emulated time goes, and the device's own unix clock on top of it.

Run time counts nanoseconds since the run began. The model sees no other time; the wall clock is read in `RealClock` and
`ScaledClock` alone.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Final, Protocol

from starhil.emulator.errors import EmulatorError
from starid.files import read_number

NANOSECONDS: Final = 1_000_000_000
"""Nanoseconds in a second."""

MAX_SCALE: Final = 1000.0


class Clock(Protocol):
    """What the model asks the time of."""

    @property
    def name(self) -> str:
        """How the clock is written on the command line."""

    @property
    def speed(self) -> float:
        """Run time that passes in a second of wall time; 0 where time only passes on request."""

    def now_ns(self) -> int:
        """Run time since the start, nanoseconds."""


class ScaledClock:
    """Run time that passes `speed` times as fast as the wall clock."""

    def __init__(self, speed: float) -> None:
        if not 0.0 < speed <= MAX_SCALE:
            raise EmulatorError(f"clock: scale {speed:g} is outside 0 … {MAX_SCALE:g}; try scaled:10")
        self.speed = speed
        self._origin_ns = time.monotonic_ns()

    @property
    def name(self) -> str:
        """How the clock is written on the command line."""
        return f"scaled:{self.speed:g}"

    def now_ns(self) -> int:
        """Run time since the clock was made, nanoseconds."""
        return int((time.monotonic_ns() - self._origin_ns) * self.speed)


class RealClock(ScaledClock):
    """Run time that passes as the wall clock does, and is not set by it."""

    def __init__(self) -> None:
        super().__init__(1.0)

    @property
    def name(self) -> str:
        """How the clock is written on the command line."""
        return "real"


class SteppedClock:
    """Run time that stands still until it is told to go on: the same run gives the same bytes."""

    name: Final = "stepped"
    speed: Final = 0.0

    def __init__(self) -> None:
        self._now_ns = 0

    def now_ns(self) -> int:
        """Run time since the start, nanoseconds."""
        return self._now_ns

    def set_ns(self, now_ns: int) -> None:
        """Go on to a time; never back."""
        if now_ns < self._now_ns:
            raise EmulatorError(f"clock: cannot go back from {self._now_ns} ns to {now_ns} ns")
        self._now_ns = now_ns


def make_clock(text: str) -> RealClock | ScaledClock | SteppedClock:
    """Make the clock that is written `real`, `scaled:FACTOR` or `stepped`."""
    kind, _, factor = text.partition(":")
    if text == "real":
        return RealClock()
    if text == "stepped":
        return SteppedClock()
    if kind == "scaled":
        try:
            return ScaledClock(read_number(factor))
        except ValueError:
            pass
    raise EmulatorError(f"clock: {text!r} is none of real, scaled:FACTOR, stepped")


@dataclass
class DeviceTime:
    """The device's unix time: run time plus an offset that telecommand 2 sets.

    Attributes
    ----------
    clock
        Where run time comes from.
    offset_ns
        Unix time at run time zero, nanoseconds.
    was_set
        Whether the time was set since the device started.
    """

    clock: Clock
    offset_ns: int = 0
    was_set: bool = field(default=False)

    def unix_ns(self, run_ns: int | None = None) -> int:
        """Unix time at a run time, or now, nanoseconds."""
        return (self.clock.now_ns() if run_ns is None else run_ns) + self.offset_ns

    def set_unix_ns(self, unix_ns: int) -> None:
        """Make `unix_ns` the time now."""
        self.offset_ns = unix_ns - self.clock.now_ns()
        self.was_set = True


def split_unix(unix_ns: int) -> tuple[int, int, int]:
    """Split a unix time into whole seconds, whole milliseconds, and microseconds of the second.

    Times before 1970 or past 2106 wrap at 32 bits, as the device's counter does.
    """
    seconds, rest = divmod(unix_ns, NANOSECONDS)
    return seconds & 0xFFFF_FFFF, rest // 1_000_000, rest // 1_000
