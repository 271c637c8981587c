"""Truth and orbit from the rows of a file, interpolated in time.

`FileTruth` has times in seconds from the start of the truth, `OrbitTable` has dates. Attitudes between two rows lie
on the shortest rotation between them; with ``smooth``, on the cubic of the rotation vector that also has the rates of
both rows, which follows a slew with far fewer rows. Positions lie on the cubic that has both velocities.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from starhil.emulator.errors import EmulatorError
from starhil.emulator.truth.orbit import OrbitState, interpolate_orbit
from starhil.emulator.truth.source import ZERO_RATE, TruthState, TruthStatus, Vector
from starid.arrays import Array
from starid.attitude import Attitude, interpolate, interpolate_with_rates, rate_between


@dataclass(frozen=True, eq=False)
class FileTruth:
    """Attitudes interpolated in time; at rest before the first row and after the last."""

    times_s: Array
    """Times (n,) of the rows, seconds, increasing."""
    attitudes: Sequence[Attitude]
    rates_rad_s: Array | None = None
    """Body rates (n, 3), rad/s, sensor frame; None to derive them from successive rows."""
    orbit: Sequence[OrbitState] | None = None
    """Position and velocity of each row; None if the file has none."""
    smooth: bool = False
    """Whether the attitude between two rows also has their rates."""
    start_unix_s: float | None = None
    """Date of time zero as Unix time; None if the file has no dates."""
    start_s: float = 0.0
    """Simulation time of time zero."""
    repeat: bool = False
    """Whether to start again after the last row."""
    kind: str = "file"

    def __post_init__(self) -> None:
        if not len(self.attitudes):
            raise EmulatorError("truth: a truth file needs at least one row")

    def state(self, t_s: float) -> TruthState:
        """Return the truth at a simulation time in seconds."""
        first, last = float(self.times_s[0]), float(self.times_s[-1])
        t = t_s - self.start_s
        if self.repeat and t > last > first:
            t = first + (t - first) % (last - first)
        if not first <= t <= last:
            row, status = (0, TruthStatus.BEFORE_START) if t < first else (-1, TruthStatus.AFTER_END)
            return self._row(row, ZERO_RATE, t, status)
        if first == last:
            return self._row(0, ZERO_RATE if self.rates_rad_s is None else self.rates_rad_s[0], t)
        low, fraction, span = _between(self.times_s, t)
        before, after = self.attitudes[low], self.attitudes[low + 1]
        if self.rates_rad_s is None:
            rate = rate_between(before, after, span)
        else:
            rate = (1.0 - fraction) * self.rates_rad_s[low] + fraction * self.rates_rad_s[low + 1]
        if self.smooth and self.rates_rad_s is not None:
            attitude = interpolate_with_rates(
                before, after, self.rates_rad_s[low], self.rates_rad_s[low + 1], fraction, span
            )
        else:
            attitude = interpolate(before, after, fraction)
        orbit = None
        if self.orbit is not None:
            orbit = interpolate_orbit(self.orbit[low], self.orbit[low + 1], fraction, span)
        return TruthState(attitude, rate, orbit=orbit, unix_s=self._date(t))

    def _row(self, row: int, rate: Vector, t: float, status: TruthStatus = TruthStatus.OK) -> TruthState:
        orbit = None if self.orbit is None else self.orbit[row]
        return TruthState(self.attitudes[row], rate, status, orbit, self._date(t))

    def _date(self, t: float) -> float | None:
        return None if self.start_unix_s is None else self.start_unix_s + t


class OrbitTable:
    """Positions and velocities of a file, interpolated between the increasing Unix times (n,) of its rows."""

    def __init__(self, source: object, times_unix_s: Array, states: Sequence[OrbitState]) -> None:
        self._source = source
        self._times = times_unix_s
        self._states = states

    def state(self, unix_s: float) -> OrbitState:
        """Return position and velocity at a Unix time."""
        if not self._times[0] <= unix_s <= self._times[-1]:
            raise EmulatorError(
                f"orbit file {self._source}: its dates do not include the date of the run, Unix time {unix_s:.0f}"
            )
        if len(self._states) == 1:
            return self._states[0]
        low, fraction, span = _between(self._times, unix_s)
        return interpolate_orbit(self._states[low], self._states[low + 1], fraction, span)


def _between(times: Array, t: float) -> tuple[int, float, float]:
    """Return the row before a time within at least two rows, the fraction of the way to the next, and their distance."""
    low = min(int(np.searchsorted(times, t, side="right")), len(times) - 1) - 1
    span = float(times[low + 1] - times[low])
    return low, (t - float(times[low])) / span, span
