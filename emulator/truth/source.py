"""Truth: where the sensor really points, and how it turns, at any run time.

A source answers `state(t)` for a time in seconds of run time: the attitude, the body rate in the sensor frame, and whether
the answer can be trusted. Sources hold no clock and no socket.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Final, Literal, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from starhil.emulator.errors import EmulatorError
from starid.attitude import Attitude, propagate

Vector: TypeAlias = NDArray[np.float64]

ZERO_RATE: Final[Vector] = np.zeros(3)
ZERO_RATE.flags.writeable = False

MAX_RATE_DEG_S: Final = 600.0
"""Largest body rate about one axis, degrees a second: with all three at it frames can still be drawn."""

SMOOTH_PEAK: Final = 1.875
"""Peak of the derivative of the quintic 10τ³ − 15τ⁴ + 6τ⁵, at τ = ½."""


class TruthStatus(StrEnum):
    """How a truth state came about."""

    OK = "ok"
    WAITING = "waiting"
    """A live feed that has not sent anything yet: the starting attitude."""
    EXTRAPOLATED = "extrapolated"
    """Past the last message of a live feed, carried on at its last rate."""
    STALE = "stale"
    """The live feed has been silent for too long: the attitude stands still."""
    BEFORE_START = "before_start"
    """Before the first row of a file: its first attitude, at rest."""
    AFTER_END = "after_end"
    """After the last row of a file or segment of a profile: its last attitude, at rest."""


@dataclass(frozen=True)
class TruthState:
    """Attitude and rate at one time.

    Attributes
    ----------
    attitude
        ICRS→sensor.
    rate_rad_s
        Body rate (3,), radians a second, sensor frame.
    status
        Whether this is given, carried on or out of date.
    """

    attitude: Attitude
    rate_rad_s: Vector
    status: TruthStatus = TruthStatus.OK


class TruthSource(Protocol):
    """What the emulator asks the truth of."""

    @property
    def kind(self) -> str:
        """The name of the source as in a profile."""

    def state(self, t_s: float) -> TruthState:
        """Truth at a run time in seconds."""


@dataclass(frozen=True)
class FixedTruth:
    """An attitude that does not change."""

    attitude: Attitude
    kind: str = "fixed"

    def state(self, t_s: float) -> TruthState:  # noqa: ARG002 (any time gives the same)
        """Truth at a run time in seconds."""
        return TruthState(self.attitude, ZERO_RATE)


@dataclass(frozen=True)
class RateTruth:
    """A turn at a constant rate that begins from `attitude` at `start_s`.

    Attributes
    ----------
    rate_rad_s
        Body rate (3,), radians a second, sensor frame.
    """

    attitude: Attitude
    rate_rad_s: Vector
    start_s: float = 0.0
    kind: str = "rate"

    def state(self, t_s: float) -> TruthState:
        """Truth at a run time in seconds."""
        return TruthState(propagate(self.attitude, self.rate_rad_s, t_s - self.start_s), self.rate_rad_s)


@dataclass(frozen=True)
class HoldSegment:
    """Rest for a time, seconds."""

    seconds: float


@dataclass(frozen=True)
class RateSegment:
    """Turn at a constant body rate (3,), radians a second, sensor frame, for a time in seconds."""

    seconds: float
    rate_rad_s: Vector


@dataclass(frozen=True)
class SlewSegment:
    """Turn about one axis to an attitude.

    Attributes
    ----------
    to
        Where the slew ends, at rest.
    rate_rad_s
        Largest rate, radians a second.
    shape
        `smooth` (quintic, no jump in acceleration) or `limited` (constant acceleration, coast, constant braking).
    acceleration_rad_s2
        Acceleration of the `limited` shape, radians a second squared.
    """

    to: Attitude
    rate_rad_s: float
    shape: Literal["smooth", "limited"] = "smooth"
    acceleration_rad_s2: float = math.radians(0.1)


Segment: TypeAlias = HoldSegment | RateSegment | SlewSegment


@dataclass(frozen=True)
class _Leg:
    """A segment with its start and its length in time."""

    start_s: float
    seconds: float
    attitude: Attitude
    axis: Vector
    angle: float
    segment: Segment

    def state(self, elapsed: float) -> TruthState:
        """Truth at `elapsed` seconds into the leg."""
        segment = self.segment
        if isinstance(segment, SlewSegment):
            turned, rate = _progress(segment, self.angle, self.seconds, elapsed)
            return TruthState(self.attitude.rotated(self.axis * turned), self.axis * rate)
        rate_vector = segment.rate_rad_s if isinstance(segment, RateSegment) else ZERO_RATE
        return TruthState(propagate(self.attitude, rate_vector, elapsed), rate_vector)


def _slew_seconds(segment: SlewSegment, angle: float) -> float:
    """How long a turn by `angle` (radians) takes."""
    if segment.shape == "smooth":
        return SMOOTH_PEAK * angle / segment.rate_rad_s
    a, rate = segment.acceleration_rad_s2, segment.rate_rad_s
    if angle < rate * rate / a:  # the rate is never reached
        return 2.0 * math.sqrt(angle / a)
    return angle / rate + rate / a


def _progress(segment: SlewSegment, angle: float, seconds: float, elapsed: float) -> tuple[float, float]:
    """Angle turned (radians) and rate (radians a second) `elapsed` seconds into a slew."""
    if seconds <= 0.0:
        return angle, 0.0
    if segment.shape == "smooth":
        tau = elapsed / seconds
        turned = angle * tau**3 * (10.0 - 15.0 * tau + 6.0 * tau * tau)
        return turned, angle / seconds * 30.0 * tau**2 * (1.0 - tau) ** 2
    a = segment.acceleration_rad_s2
    ramp = min(segment.rate_rad_s / a, 0.5 * seconds)
    if elapsed < ramp:
        return 0.5 * a * elapsed * elapsed, a * elapsed
    if elapsed > seconds - ramp:
        left = seconds - elapsed
        return angle - 0.5 * a * left * left, a * left
    return 0.5 * a * ramp * ramp + a * ramp * (elapsed - ramp), a * ramp


class SlewTruth:
    """A profile of rests, turns and slews, one after the other, from a starting attitude.

    Parameters
    ----------
    attitude
        Where the profile begins.
    segments
        What follows, in order.
    start_s
        Run time at which the first segment begins; before it the sensor rests.
    repeat
        Begin anew after the last segment (from the starting attitude) instead of resting there.
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
        now, here = 0.0, attitude
        for segment in segments:
            if isinstance(segment, SlewSegment):
                turn = segment.to.error_to(here).rotation_vector_rad
                angle = float(np.linalg.norm(turn))
                axis = turn / angle if angle > 0.0 else np.array([0.0, 0.0, 1.0])
                leg = _Leg(now, _slew_seconds(segment, angle), here, axis, angle, segment)
                here = segment.to
            else:
                leg = _Leg(now, segment.seconds, here, ZERO_RATE, 0.0, segment)
                here = leg.state(segment.seconds).attitude
            now += leg.seconds
            self._legs.append(leg)
        self.duration_s = now
        """Length of the whole profile, seconds."""
        self._begin, self._end = attitude, here

    def state(self, t_s: float) -> TruthState:
        """Truth at a run time in seconds."""
        elapsed = t_s - self.start_s
        if elapsed < 0.0:
            return TruthState(self._begin, ZERO_RATE, TruthStatus.BEFORE_START)
        if self.repeat and self.duration_s > 0.0:
            elapsed %= self.duration_s
        if elapsed >= self.duration_s:
            return TruthState(self._end, ZERO_RATE, TruthStatus.AFTER_END)
        leg = next(leg for leg in reversed(self._legs) if leg.start_s <= elapsed)
        return leg.state(min(elapsed - leg.start_s, leg.seconds))
