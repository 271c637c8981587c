"""Truth sources: the true attitude and body rate of the sensor at any simulation time.

A source has neither clock nor socket; `state(t)` depends only on the time and the received data. Some sources also
provide date and orbit; otherwise `TruthState.completed` adds the run's.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Final, Literal, Protocol, TypeAlias

import numpy as np

from starhil.emulator.errors import EmulatorError
from starhil.emulator.truth.orbit import Orbit, OrbitState
from starid.arithmetic.arrays import Array
from starid.arithmetic.elementary import square
from starid.arithmetic.matrices import length
from starid.attitude import Attitude, propagate

Vector: TypeAlias = Array

ZERO_RATE: Final[Vector] = np.zeros(3)
ZERO_RATE.flags.writeable = False

MAX_RATE_DEG_S: Final = 600.0
"""Largest body rate per axis, degrees per second; images can be rendered at this rate about all axes."""

SMOOTH_PEAK: Final = 1.875
"""Peak of the derivative of the quintic 10τ³ − 15τ⁴ + 6τ⁵, at τ = ½."""


class TruthStatus(StrEnum):
    """Quality of a truth state."""

    OK = "ok"
    WAITING = "waiting"
    """No message from a live feed yet: the configured attitude."""
    EXTRAPOLATED = "extrapolated"
    """After the last message of a live feed: propagated at its last rate."""
    STALE = "stale"
    """The live feed has been silent for too long: the attitude is held."""
    WRONG_SPEED = "wrong_speed"
    """The live feed runs at another speed than the clock: its messages hold from their receipt."""
    IMPLAUSIBLE = "implausible"
    """The live feed gives a position, velocity or date that cannot be right, such as one in other units."""
    BEFORE_START = "before_start"
    """Before the begin of a file: its first attitude, at rest."""
    GAP = "gap"
    """Between two segments of a file: the last attitude of the earlier one, at rest."""
    AFTER_END = "after_end"
    """After the end of a file or the last segment of a slew: its last attitude, at rest."""


@dataclass(frozen=True)
class TruthState:
    """Attitude and rate at one time, with date and orbit if known."""

    attitude: Attitude
    """ICRS→sensor."""
    rate_rad_s: Vector
    """Body rate (3,), rad/s, sensor frame."""
    status: TruthStatus = TruthStatus.OK
    """Whether the state is known, extrapolated or stale."""
    orbit: OrbitState | None = None
    """Position and velocity relative to the Earth's centre, GCRS."""
    unix_s: float | None = None

    def completed(self, unix_s: float, orbit: Orbit | None) -> TruthState:
        """Return the state with the date and orbit of the run if the source has none."""
        date = unix_s if self.unix_s is None else self.unix_s
        place = self.orbit
        if place is None and orbit is not None:
            place = orbit.state(date)
        return dataclasses.replace(self, orbit=place, unix_s=date)


class TruthSource(Protocol):
    """A source of true attitudes and rates."""

    @property
    def kind(self) -> str:
        """Kind of source, as named in a profile."""

    def state(self, t_s: float) -> TruthState:
        """Return the truth at a simulation time in seconds."""


@dataclass(frozen=True)
class FixedTruth:
    """An attitude that does not change."""

    attitude: Attitude
    kind: str = "fixed"

    def state(self, t_s: float) -> TruthState:  # noqa: ARG002 (any time gives the same)
        """Return the truth at a simulation time in seconds."""
        return TruthState(self.attitude, ZERO_RATE)


@dataclass(frozen=True)
class RateTruth:
    """A rotation at a constant rate that starts with `attitude` at `start_s`."""

    attitude: Attitude
    rate_rad_s: Vector
    """Body rate (3,), rad/s, sensor frame."""
    start_s: float = 0.0
    kind: str = "rate"

    def state(self, t_s: float) -> TruthState:
        """Return the truth at a simulation time in seconds."""
        return TruthState(propagate(self.attitude, self.rate_rad_s, t_s - self.start_s), self.rate_rad_s)


@dataclass(frozen=True)
class RateSegment:
    """Rotate at a constant body rate (3,), rad/s, sensor frame, for a time in seconds."""

    seconds: float
    rate_rad_s: Vector


@dataclass(frozen=True)
class SlewSegment:
    """Slew about one axis to an attitude, from rest to rest."""

    to: Attitude
    rate_rad_s: float
    shape: Literal["smooth", "limited"] = "smooth"
    """`smooth` (quintic, no jump in acceleration) or `limited` (constant acceleration, coast, constant braking)."""
    acceleration_rad_s2: float = math.radians(0.1)
    """Acceleration of the `limited` shape, rad/s²."""


Segment: TypeAlias = RateSegment | SlewSegment


@dataclass(frozen=True)
class _Leg:
    """A segment with its start time, duration and initial attitude."""

    start_s: float
    seconds: float
    attitude: Attitude
    axis: Vector
    angle: float
    segment: Segment

    def state(self, elapsed: float) -> TruthState:
        """Return the truth `elapsed` seconds after the start of the leg."""
        segment = self.segment
        if isinstance(segment, SlewSegment):
            angle, rate = _slew_angle_and_rate(segment, self.angle, self.seconds, elapsed)
            return TruthState(self.attitude.rotated(self.axis * angle), self.axis * rate)
        return TruthState(propagate(self.attitude, segment.rate_rad_s, elapsed), segment.rate_rad_s)


def _slew_seconds(segment: SlewSegment, angle: float) -> float:
    """Return the duration of a slew by `angle` radians."""
    if segment.shape == "smooth":
        return SMOOTH_PEAK * angle / segment.rate_rad_s
    a, rate = segment.acceleration_rad_s2, segment.rate_rad_s
    if angle < rate * rate / a:  # the rate is never reached
        return 2.0 * math.sqrt(angle / a)
    return angle / rate + rate / a


def _slew_angle_and_rate(
    segment: SlewSegment, angle: float, seconds: float, elapsed: float
) -> tuple[float, float]:
    """Return the angle (radians) and rate (rad/s) `elapsed` seconds after the start of a slew."""
    if seconds <= 0.0:
        return angle, 0.0
    if segment.shape == "smooth":
        tau = elapsed / seconds
        turned = angle * tau * square(tau) * (10.0 - 15.0 * tau + 6.0 * tau * tau)
        return turned, angle / seconds * 30.0 * square(tau) * square(1.0 - tau)
    a = segment.acceleration_rad_s2
    ramp = min(segment.rate_rad_s / a, 0.5 * seconds)
    if elapsed < ramp:
        return 0.5 * a * elapsed * elapsed, a * elapsed
    if elapsed > seconds - ramp:
        left = seconds - elapsed
        return angle - 0.5 * a * left * left, a * left
    return 0.5 * a * ramp * ramp + a * ramp * (elapsed - ramp), a * ramp


class SlewTruth:
    """A sequence of holds, constant rates and slews, at rest before the simulation time `start_s`.

    After the last segment it restarts from the initial attitude (`repeat`), or the final attitude is held.
    """

    kind: Final = "slew"

    def __init__(
        self, attitude: Attitude, segments: Sequence[Segment], *, start_s: float = 0.0, repeat: bool = False
    ) -> None:
        if not segments:
            raise EmulatorError("truth: a slew profile needs at least one segment")
        self.start_s = start_s
        self.repeat = repeat
        self._legs: list[_Leg] = []
        leg_start_s, current = 0.0, attitude
        for segment in segments:
            if isinstance(segment, SlewSegment):
                rotation = segment.to.error_to(current).rotation_vector_rad
                angle = length(rotation)
                axis = rotation / angle if angle > 0.0 else np.array([0.0, 0.0, 1.0])
                leg = _Leg(leg_start_s, _slew_seconds(segment, angle), current, axis, angle, segment)
                current = segment.to
            else:
                leg = _Leg(leg_start_s, segment.seconds, current, ZERO_RATE, 0.0, segment)
                current = leg.state(segment.seconds).attitude
            leg_start_s += leg.seconds
            self._legs.append(leg)
        self.duration_s = leg_start_s
        """Duration of all segments, seconds."""
        self._begin, self._end = attitude, current

    def state(self, t_s: float) -> TruthState:
        """Return the truth at a simulation time in seconds."""
        elapsed = t_s - self.start_s
        if elapsed < 0.0:
            return TruthState(self._begin, ZERO_RATE, TruthStatus.BEFORE_START)
        if self.repeat and self.duration_s > 0.0:
            elapsed %= self.duration_s
        if elapsed >= self.duration_s:
            return TruthState(self._end, ZERO_RATE, TruthStatus.AFTER_END)
        leg = next(leg for leg in reversed(self._legs) if leg.start_s <= elapsed)
        return leg.state(min(elapsed - leg.start_s, leg.seconds))
