"""Truth from a live feed: a dynamics simulator sends attitudes as it computes them.

Messages are JSON lines (`starhil.emulator.truth.feed_message`) or the blocks of 42
(`starhil.emulator.truth.simulator_42`). A message whose rate contradicts the attitudes is rejected
(`starhil.emulator.truth.feed_rates`).

The first message (or the last one before time starts) sets the offset between the sender's clock and simulation time; drift is tracked
(`starhil.emulator.truth.sender_clock`) and rates are scaled accordingly. With ``timeline = "run"`` in the profile,
``t`` is simulation time. A sender that runs at another speed than the clock is reported, and flagged ``wrong_speed``;
each of its messages then holds from its receipt, with ``timeline = "run"`` still at its ``t``.

Between two messages the attitude is interpolated, with the rates of both if the sender gives rates and times. After the
last one it is propagated at the last rate for at most ``stale_s``; then it is held and flagged ``stale``. With
``timeline = "run"`` it is also stale if the last ``t`` is older than this.

A position, velocity or date that cannot be right (`starhil.emulator.truth.plausibility`) is used as it was sent, but
reported with the likely mistake, and the truth is flagged ``implausible``.

A rejected message is counted, logged (the 1st, 10th, 100th …) and otherwise ignored. Messages whose ``t`` does not
increase are rejected, except that a jump back by more than `RESTART_S` starts a new timeline.
"""

from __future__ import annotations

import bisect
import logging
from collections import deque
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np

from starhil.emulator.simulation.clock import MAX_SCALE
from starhil.emulator.truth.feed_message import FeedMessage, JsonFormat
from starhil.emulator.truth.feed_rates import SHORTEST_S, FeedError, FeedRates
from starhil.emulator.truth.orbit import interpolate_orbit
from starhil.emulator.truth.plausibility import doubt_of_date, doubt_of_orbit
from starhil.emulator.truth.sender_clock import SenderClock, SenderSpeed
from starhil.emulator.truth.simulator_42 import Format42
from starhil.emulator.truth.source import ZERO_RATE, TruthState, TruthStatus
from starid.attitude import Attitude, interpolate, propagate
from starid.attitude.attitude import interpolate_with_rates

log = logging.getLogger("starhil.truth")

HISTORY: Final = 512
"""Number of messages kept for exposures whose midpoint is in the past."""

SPEED_ERROR: Final = 0.05
"""Error of a measured speed that the tracking of drift follows anyway."""

RESTART_S: Final = 1.0
"""Jump back of the sender's time that starts a new timeline, seconds."""


@dataclass(frozen=True)
class _HeldMessage:
    t: float
    """Simulation time, seconds."""
    state: TruthState
    has_rate: bool
    """Whether its rate is the sender's, at a time of the sender; otherwise it is derived, or its time is that of receipt."""


class LiveTruth:
    """Truth from the messages of a live feed, by default JSON lines.

    After `stale_s` seconds of silence in simulation time the attitude is held and flagged stale. `timeline` is as in
    the profile: with `anchor` the first message sets the offset of the sender's clock, with `run` it uses simulation
    time.
    """

    def __init__(
        self,
        attitude: Attitude,
        *,
        stale_s: float = 1.0,
        timeline: Literal["anchor", "run"] = "anchor",
        message_format: JsonFormat | Format42 | None = None,
        kind: str = "live",
    ) -> None:
        self.kind = kind
        self.format = message_format or JsonFormat()
        self.stale_s = stale_s
        self.timeline = timeline
        self.accepted = 0
        self.refused = 0
        self.last_fault = ""
        self.doubt = ""
        """Why position, velocity or date in the last message cannot be right; an empty text if they can."""
        self._start = attitude
        self._run_unix_s: float | None = None
        self._clock_speed = 1.0
        self._clock = SenderClock(self._clock_speed)
        self._rates = FeedRates(timed=True)
        self._last_t: float | None = None
        """Sender's time in the last message with a time."""
        self._received_s = 0.0
        """Simulation time at which the last message was accepted."""
        self._held: deque[_HeldMessage] = deque(maxlen=HISTORY)
        self._doubts = 0
        """How often the feed has become implausible."""

    def set_run(self, clock_speed: float, start_unix_s: float) -> None:
        """Set the simulation time per wall time, by default 1, 0 if time passes only on request; and the date of the run."""
        self._clock_speed = clock_speed
        self._run_unix_s = start_unix_s
        self.begin_timeline()

    def receive(self, data: bytes | str, received_s: float) -> bool:
        """Process data received at a simulation time in seconds; return whether the message was accepted."""
        try:
            message = self.format.decode(data)
        except FeedError as fault:
            self.reject(str(fault))
            return False
        return self.accept(message, received_s)

    def accept(self, message: FeedMessage, received_s: float) -> bool:
        """Process a decoded message; return whether it was accepted."""
        try:
            self._add_message(message, received_s)
        except FeedError as fault:
            self.reject(str(fault))
            return False
        self.accepted += 1
        return True

    def reject(self, fault: str) -> None:
        """Count a rejected message and keep its fault in `last_fault`."""
        self.refused += 1
        self.last_fault = fault
        if _is_reported(self.refused):
            log.warning("truth feed: message rejected (%d so far): %s", self.refused, fault)

    def _add_message(self, message: FeedMessage, received_s: float) -> None:
        timed = message.t is not None
        if message.t is not None:
            if self._repeats_the_last(message):
                return
            self._check_time(message.t)
            self._last_t = message.t
        if self._rates.timed != timed:
            self._rates = FeedRates(timed=timed)
        at_s = received_s if message.t is None else message.t
        rate = self._rates.body_rate(at_s, message.attitude, message.rate_rad_s)
        t = at_s
        if timed:
            differed = self.speed.differs
            if self.timeline == "anchor":
                t = self._clock.simulation_time(at_s, received_s, self.stale_s)
                rate = rate * (1.0 - self._clock.slope)
            else:
                self.speed.add(at_s, received_s)
            if self.speed.differs != differed:
                self._speed_changed()
        self._drop_superseded(t, timed=timed)
        self._received_s = received_s
        state = TruthState(message.attitude, rate, orbit=message.orbit, unix_s=message.unix_s)
        self._held.append(_HeldMessage(t, state, has_rate=timed and message.rate_rad_s is not None))
        self._check_plausibility(message)

    def _check_plausibility(self, message: FeedMessage) -> None:
        """Set `doubt`, and report it when it arises."""
        doubt = "" if message.orbit is None else doubt_of_orbit(message.orbit)
        if not doubt and message.unix_s is not None and self._run_unix_s is not None:
            doubt = doubt_of_date(message.unix_s, self._run_unix_s)
        if doubt and not self.doubt:
            self._doubts += 1
            if _is_reported(self._doubts):
                log.warning("truth feed: implausible: %s", doubt)
        self.doubt = doubt

    @property
    def speed(self) -> SenderSpeed:
        """Speed of the sender relative to the clock."""
        return self._clock.speed

    def _speed_changed(self) -> None:
        """Report a speed that differs from the clock's, and discard the states whose times no longer hold."""
        if self.timeline == "anchor":
            self._held.clear()
        if self.speed.differs:
            wall = rounded_speed(self.speed.ratio * self._clock_speed)
            scaled = f"--clock scaled:{wall:g}, or " if wall <= MAX_SCALE else ""
            log.warning(
                "truth feed: the sender runs at %g × the clock; use %slock-step with --clock stepped",
                rounded_speed(self.speed.ratio),
                scaled,
            )

    def _repeats_the_last(self, message: FeedMessage) -> bool:
        """Return whether a message repeats the last one, as simulators do at their start."""
        return (
            bool(self._held)
            and message.t == self._last_t
            and np.array_equal(
                message.attitude.quaternion_xyzw, self._held[-1].state.attitude.quaternion_xyzw
            )
        )

    def _check_time(self, t: float) -> None:
        """Reject a sender's time that does not increase; a long jump back starts a new timeline."""
        if self._last_t is None or t >= self._last_t + SHORTEST_S:
            return
        if self._last_t - t <= RESTART_S:
            raise FeedError(f"t = {t} is not later than in the previous message")
        self.begin_timeline()

    def begin_timeline(self) -> None:
        """Discard the messages and the sender's clock: the sender has restarted, or the run has not begun."""
        self._last_t = None
        self._held.clear()
        self._clock, self._rates = SenderClock(self._clock_speed), FeedRates(timed=True)

    def _drop_superseded(self, t: float, *, timed: bool) -> None:
        """Drop messages replaced by a new one: one received at the same time, or an abandoned timeline."""
        if not self._held or t >= self._held[-1].t + SHORTEST_S:
            return
        ahead_s = self._held[-1].t - t
        if not timed and ahead_s <= 0.0:
            self._held.pop()
        elif ahead_s > RESTART_S:
            self._held.clear()
        else:
            raise FeedError(f"its time is {ahead_s:.3g} s before the previous message's")

    def state(self, t_s: float) -> TruthState:
        """Return the truth at a simulation time in seconds."""
        state = self._state(t_s)
        if state.status in (TruthStatus.WAITING, TruthStatus.STALE):
            return state
        if self.speed.differs:
            return replace(state, status=TruthStatus.WRONG_SPEED)
        if self.doubt:
            return replace(state, status=TruthStatus.IMPLAUSIBLE)
        return state

    def _state(self, t_s: float) -> TruthState:
        if not self._held:
            return TruthState(self._start, ZERO_RATE, TruthStatus.WAITING)
        age, last = t_s - self._held[-1].t, self._held[-1].state
        silence = age if self.timeline == "run" else min(age, t_s - self._received_s)
        if silence > self.stale_s:
            return replace(_moved_on(last, self.stale_s), rate_rad_s=ZERO_RATE, status=TruthStatus.STALE)
        if age >= 0.0:
            return _moved_on(last, min(age, self.stale_s)) if age > 0.0 else last
        if t_s <= self._held[0].t:
            return replace(self._held[0].state, status=TruthStatus.BEFORE_START)
        upper = bisect.bisect_right(self._held, t_s, key=lambda held: held.t)
        return _between(self._held[upper - 1], self._held[upper], t_s)


def _is_reported(count: int) -> bool:
    """Return whether what has happened this often is logged: at 1, 10, 100 …, as a peer may repeat it without end."""
    return str(count).rstrip("0") == "1"


def rounded_speed(speed: float) -> float:
    """Return a whole speed, or a whole fraction, if one is near; otherwise, round to two significant digits."""
    whole = max(round(speed), 1) / max(round(1.0 / speed), 1)
    return whole if abs(speed / whole - 1.0) < SPEED_ERROR else float(f"{speed:.2g}")


def _moved_on(last: TruthState, seconds: float) -> TruthState:
    orbit = last.orbit
    return replace(
        last,
        attitude=propagate(last.attitude, last.rate_rad_s, seconds),
        status=TruthStatus.EXTRAPOLATED,
        orbit=orbit and replace(orbit, position_m=orbit.position_m + seconds * orbit.velocity_m_s),
        unix_s=None if last.unix_s is None else last.unix_s + seconds,
    )


def _between(first: _HeldMessage, second: _HeldMessage, t_s: float) -> TruthState:
    """Interpolate between two messages at a simulation time in seconds."""
    before, after, span_s = first.state, second.state, second.t - first.t
    fraction = (t_s - first.t) / span_s
    orbit = None
    if before.orbit is not None and after.orbit is not None:
        orbit = interpolate_orbit(before.orbit, after.orbit, fraction, span_s)
    unix_s = None
    if before.unix_s is not None and after.unix_s is not None:
        unix_s = before.unix_s + fraction * (after.unix_s - before.unix_s)
    rate = (1.0 - fraction) * before.rate_rad_s + fraction * after.rate_rad_s
    if first.has_rate and second.has_rate:
        attitude = interpolate_with_rates(
            before.attitude, after.attitude, before.rate_rad_s, after.rate_rad_s, fraction, span_s
        )
    else:
        attitude = interpolate(before.attitude, after.attitude, fraction)
    return TruthState(attitude, rate, orbit=orbit, unix_s=unix_s)
