"""Simulation time, and the Unix clock of the device, which is derived from it.

Simulation time is counted in nanoseconds since the devices were switched on, which is when the command started: the
device boots while its pipeline starts. At the end of the boot, time stands still until the pipelines of all heads are
ready, however long kernels are compiled. The stepped clock stands at zero until then. The model uses no other time;
only `RealClock` and `ScaledClock` read the wall clock.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, TypeAlias

from starhil.emulator.errors import EmulatorError
from starhil.protocol.icd.conventions import NANOSECONDS
from starid.storage.files import read_number

MAX_SCALE: Final = 1000.0
INVERSION_STEPS: Final = 4
"""Each step makes the error of an inverted clock smaller by its drift, at most 0.1."""


class ScaledClock:
    """A clock that runs `speed` times as fast as wall time."""

    stepped: Final = None

    def __init__(self, speed: float) -> None:
        if not 0.0 < speed <= MAX_SCALE:
            raise EmulatorError(f"clock: scale {speed:g} is outside 0 … {MAX_SCALE:g}; try scaled:10")
        self.speed = speed
        """Simulation time per wall time; 0 if time passes only on request."""
        self._origin_ns = 0
        self._limit_ns: int | None = 0

    @property
    def name(self) -> str:
        """Name of the clock on the command line."""
        return f"scaled:{self.speed:g}"

    @property
    def running(self) -> ScaledClock:
        """The clock that does not stop while an entry of a tape is processed: itself."""
        return self

    def now_ns(self) -> int:
        """Return the simulation time, nanoseconds."""
        now_ns = int((time.monotonic_ns() - self._origin_ns) * self.speed)
        return now_ns if self._limit_ns is None else min(now_ns, self._limit_ns)

    def switch_on(self, wall_ns: int, limit_ns: int) -> None:
        """Let time pass since a time of the monotonic wall clock, up to `limit_ns`; before this, it is zero."""
        self._origin_ns, self._limit_ns = wall_ns, limit_ns

    def start(self) -> None:
        """Let time pass without a limit."""
        self._origin_ns = time.monotonic_ns() - round(self.now_ns() / self.speed)
        self._limit_ns = None


class RealClock(ScaledClock):
    """A clock that runs as fast as wall time; setting the wall clock does not affect it."""

    def __init__(self) -> None:
        super().__init__(1.0)

    @property
    def name(self) -> str:
        """Name of the clock on the command line."""
        return "real"


class SteppedClock:
    """A clock that advances only on request, so that the same run gives the same bytes."""

    name: Final = "stepped"
    speed: Final = 0.0

    def __init__(self) -> None:
        self._now_ns = 0

    @property
    def stepped(self) -> SteppedClock:
        """The clock that can be advanced: itself; None for clocks that advance by themselves."""
        return self

    @property
    def running(self) -> SteppedClock:
        """The clock that does not stop while an entry of a tape is processed: itself."""
        return self

    def now_ns(self) -> int:
        """Return the simulation time, nanoseconds."""
        return self._now_ns

    def switch_on(self, wall_ns: int, limit_ns: int) -> None:
        """Do nothing: time passes on request."""

    def start(self) -> None:
        """Do nothing: time passes on request."""

    def set_ns(self, now_ns: int) -> None:
        """Advance to a time, nanoseconds."""
        if now_ns < self._now_ns:
            raise EmulatorError(f"clock: cannot go back from {self._now_ns} ns to {now_ns} ns")
        self._now_ns = now_ns


class LatchedClock:
    """A clock that stops while an entry of a tape is processed."""

    stepped: Final = None

    def __init__(self, running: ScaledClock | SteppedClock) -> None:
        self.running = running
        """The clock that this one follows, and which does not stop."""
        self.name = running.name
        self.speed = running.speed
        self._now_ns = 0

    def now_ns(self) -> int:
        """Return the time of the last entry, nanoseconds."""
        return self._now_ns

    def switch_on(self, wall_ns: int, limit_ns: int) -> None:
        self.running.switch_on(wall_ns, limit_ns)

    def start(self) -> None:
        self.running.start()

    def latch(self) -> None:
        """Set this clock to the current time."""
        self._now_ns = self.running.now_ns()


Clock: TypeAlias = ScaledClock | SteppedClock | LatchedClock


def make_clock(text: str) -> ScaledClock | SteppedClock:
    """Return the clock named `real`, `scaled:FACTOR` or `stepped`."""
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
    raise EmulatorError(f"clock: must be real, scaled:FACTOR or stepped, not {text!r}")


def _no_drift(_from_ns: int, _to_ns: int) -> int:
    return 0


@dataclass
class DeviceTime:
    """Unix time of the device: simulation time plus an offset, which telecommand 2 sets, and what its clock has gained."""

    clock: Clock
    offset_ns: int = 0
    """Unix time minus simulation time when `since_ns`, nanoseconds."""
    was_set: bool = False
    """Whether the time was set since the last start."""
    gained_ns: Callable[[int, int], int] = _no_drift
    """Returns what the clock gains between two simulation times, nanoseconds."""
    since_ns: int = 0
    """Simulation time from which the clock drifts as now, nanoseconds."""
    stuck_s: int | None = None
    """Unix second at which the seconds of the clock stand; None if they go on."""

    def start(self, unix_ns: int) -> None:
        """Begin at a Unix time now, nanoseconds, which nobody has set."""
        self.set_unix_ns(unix_ns)
        self.was_set = False

    def unix_ns(self, run_ns: int | None = None) -> int:
        """Return the Unix time that the clock shows at a simulation time, or now, nanoseconds."""
        at_ns = self.clock.now_ns() if run_ns is None else run_ns
        unix_ns = at_ns + self.offset_ns + self.gained_ns(self.since_ns, at_ns)
        if self.stuck_s is None:
            return unix_ns
        return self.stuck_s * NANOSECONDS + unix_ns % NANOSECONDS

    def run_ns(self, unix_ns: int) -> int:
        """Return the simulation time at which the clock, unless its second is stuck, shows a Unix time, nanoseconds."""
        run_ns = unix_ns - self.offset_ns
        for _ in range(INVERSION_STEPS):
            run_ns = unix_ns - self.offset_ns - self.gained_ns(self.since_ns, run_ns)
        return run_ns

    def rebase(self) -> None:
        """Keep what the clock has gained until now, because its drift is going to change."""
        now_ns = self.clock.now_ns()
        self.offset_ns += self.gained_ns(self.since_ns, now_ns)
        self.since_ns = now_ns

    def set_unix_ns(self, unix_ns: int) -> None:
        self.since_ns = self.clock.now_ns()
        self.offset_ns = unix_ns - self.since_ns
        self.was_set = True
