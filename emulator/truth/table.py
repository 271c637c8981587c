"""Truth and orbit from the rows of a file, interpolated in time.

`FileTruth` has times in seconds from the start of the truth, `OrbitTable` has dates. Attitudes between two rows lie
on the shortest rotation between them; with ``smooth``, on the cubic of the rotation vector that also has the rates of
both rows, which follows a slew with far fewer rows. Positions lie on the cubic that has both velocities.

A file may have several spans of motion (`Span`). Nothing is interpolated from one to the next: in a gap between two,
the attitude is held and flagged ``gap``, and there is no orbit.
"""

from __future__ import annotations

import bisect
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import overload

import numpy as np

from starhil.emulator.errors import EmulatorError
from starhil.emulator.truth.orbit import OrbitState, interpolate_orbit
from starhil.emulator.truth.source import ZERO_RATE, TruthState, TruthStatus
from starid.arithmetic.arrays import Array
from starid.attitude import Attitude, interpolate, rate_between
from starid.attitude.attitude import interpolate_with_rates


@dataclass(frozen=True)
class Span:
    """A motion without interruption: its first and last row, and the times from which and to which it holds.

    These are seconds as those of the rows, and may exclude rows that only support the interpolation.
    """

    first: int
    last: int
    begin_s: float
    end_s: float

    @property
    def rows(self) -> slice:
        return slice(self.first, self.last + 1)


def span_at(spans: Sequence[Span], t: float) -> Span | None:
    """Return the last of the spans that have begun, each no earlier than the end of the one before; None before the first."""
    number = bisect.bisect_right(spans, t, key=lambda span: span.begin_s) - 1
    return None if number < 0 else spans[number]


class Attitudes(Sequence[Attitude]):
    """The attitudes of quaternions (n, 4), each made when it is needed."""

    def __init__(self, quaternions_xyzw: Array) -> None:
        self._quaternions = quaternions_xyzw

    @staticmethod
    def array_of(attitudes: Sequence[Attitude]) -> Array:
        """Return the quaternions (n, 4) of attitudes."""
        return np.array([attitude.quaternion_xyzw for attitude in attitudes])

    def __len__(self) -> int:
        return len(self._quaternions)

    @overload
    def __getitem__(self, row: int) -> Attitude: ...
    @overload
    def __getitem__(self, row: slice) -> Attitudes: ...
    def __getitem__(self, row: int | slice) -> Attitude | Attitudes:
        chosen = self._quaternions[row]
        return Attitudes(chosen) if isinstance(row, slice) else Attitude(chosen)


class Orbits(Sequence[OrbitState]):
    """The states of positions and velocities (n, 6), each made when it is needed."""

    def __init__(self, states: Array) -> None:
        self._states = states

    @staticmethod
    def array_of(states: Sequence[OrbitState]) -> Array:
        """Return positions and velocities (n, 6) of states."""
        return np.array([(*state.position_m, *state.velocity_m_s) for state in states])

    def __len__(self) -> int:
        return len(self._states)

    @overload
    def __getitem__(self, row: int) -> OrbitState: ...
    @overload
    def __getitem__(self, row: slice) -> Orbits: ...
    def __getitem__(self, row: int | slice) -> OrbitState | Orbits:
        chosen = self._states[row]
        return Orbits(chosen) if isinstance(row, slice) else OrbitState(chosen[:3], chosen[3:])


@dataclass(frozen=True, eq=False)
class FileTruth:
    """Attitudes interpolated in time; at rest before the first span, after the last, and between two."""

    times_s: Array
    """Times (n,) of the rows, seconds, increasing within a span."""
    attitudes: Sequence[Attitude]
    rates_rad_s: Array | None = None
    """Body rates (n, 3), rad/s, sensor frame; None to derive them from successive rows."""
    orbit: Sequence[OrbitState] | None = None
    """Position and velocity of each row; None if the file has none."""
    spans: Sequence[Span] = ()
    """Spans in the order of time; by default one of all rows."""
    smooth: bool = False
    """Whether the attitude between two rows also has their rates."""
    start_unix_s: float | None = None
    """Date of time zero as Unix time; None if the file has no dates."""
    start_s: float = 0.0
    """Simulation time of time zero."""
    repeat: bool = False
    """Whether to start again after the end."""
    kind: str = "file"

    def __post_init__(self) -> None:
        if not len(self.attitudes):
            raise EmulatorError("truth: a truth file needs at least one row")
        if not self.spans:
            whole = Span(0, len(self.attitudes) - 1, float(self.times_s[0]), float(self.times_s[-1]))
            object.__setattr__(self, "spans", (whole,))

    def state(self, t_s: float) -> TruthState:
        """Return the truth at a simulation time in seconds."""
        first, last = self.spans[0], self.spans[-1]
        t = t_s - self.start_s
        if self.repeat and t > last.end_s > first.begin_s:
            t = first.begin_s + (t - first.begin_s) % (last.end_s - first.begin_s)
        span = span_at(self.spans, t)
        if span is None:
            return self._held(first, first.begin_s, t, TruthStatus.BEFORE_START)
        if t > span.end_s:
            return self._held(span, span.end_s, t, TruthStatus.AFTER_END if span is last else TruthStatus.GAP)
        return self._within(span, t)

    def states_in(self, span: Span) -> tuple[Array, list[TruthState]]:
        """Return the times (n,) at which a span begins, has rows and ends, and the states there."""
        rows = self.times_s[span.rows]
        inner = rows[(rows > span.begin_s) & (rows < span.end_s)]
        times = np.unique([span.begin_s, *inner, span.end_s])
        return times, [self._at(span, float(t)) for t in times]

    def _held(self, span: Span, at_s: float, t: float, status: TruthStatus) -> TruthState:
        """Return the state at one end of a span, at rest, as that of another time."""
        return replace(self._at(span, at_s), rate_rad_s=ZERO_RATE, status=status, unix_s=self._date(t))

    def _at(self, span: Span, t: float) -> TruthState:
        """Return the state at a time within a span, which may be that of a row."""
        row = span.first + int(np.searchsorted(self.times_s[span.rows], t))
        return self._row(row) if self.times_s[row] == t else self._within(span, t)

    def _row(self, row: int) -> TruthState:
        rate = ZERO_RATE if self.rates_rad_s is None else self.rates_rad_s[row]
        orbit = None if self.orbit is None else self.orbit[row]
        return TruthState(self.attitudes[row], rate, orbit=orbit, unix_s=self._date(float(self.times_s[row])))

    def _within(self, span: Span, t: float) -> TruthState:
        if span.first == span.last:
            return self._row(span.first)
        low, fraction, length_s = _between(self.times_s[span.rows], t)
        low += span.first
        before, after = self.attitudes[low], self.attitudes[low + 1]
        if self.rates_rad_s is None:
            rate = rate_between(before, after, length_s)
        else:
            rate = (1.0 - fraction) * self.rates_rad_s[low] + fraction * self.rates_rad_s[low + 1]
        if self.smooth and self.rates_rad_s is not None:
            attitude = interpolate_with_rates(
                before, after, self.rates_rad_s[low], self.rates_rad_s[low + 1], fraction, length_s
            )
        else:
            attitude = interpolate(before, after, fraction)
        orbit = None
        if self.orbit is not None:
            orbit = interpolate_orbit(self.orbit[low], self.orbit[low + 1], fraction, length_s)
        return TruthState(attitude, rate, orbit=orbit, unix_s=self._date(t))

    def _date(self, t: float) -> float | None:
        return None if self.start_unix_s is None else self.start_unix_s + t


class OrbitTable:
    """Positions and velocities of a file, interpolated between the Unix times (n,) of the rows of each span."""

    def __init__(
        self, source: object, times_unix_s: Array, states: Sequence[OrbitState], spans: Sequence[Span]
    ) -> None:
        self._source = source
        self.times_unix_s = times_unix_s
        self.states = states
        self.spans = spans

    def state(self, unix_s: float) -> OrbitState:
        """Return position and velocity at a Unix time; EmulatorError if it is in no span."""
        span = span_at(self.spans, unix_s)
        if span is None or unix_s > span.end_s:
            raise EmulatorError(
                f"orbit file {self._source}: its dates do not include the date of the run, Unix time {unix_s:.0f}"
            )
        if span.first == span.last:
            return self.states[span.first]
        low, fraction, length_s = _between(self.times_unix_s[span.rows], unix_s)
        low += span.first
        return interpolate_orbit(self.states[low], self.states[low + 1], fraction, length_s)


def _between(times: Array, t: float) -> tuple[int, float, float]:
    """Return the row before a time within at least two rows, the fraction of the way to the next, and their distance."""
    low = min(int(np.searchsorted(times, t, side="right")), len(times) - 1) - 1
    span = float(times[low + 1] - times[low])
    return low, (t - float(times[low])) / span, span
