"""Conversion of a feed sender's clock to simulation time, with tracking of its drift.

The first message sets the offset between the clocks. Drift is determined per window of messages: the sender is slow
only if all of them arrive later than predicted, and fast only if all arrive earlier, so a single late message or an
early burst has no effect. The offset is corrected gradually over the next window. After a pause, or a difference above
`JUMP_S`, it is set again at once.

A sender that runs at another speed cannot be followed in this way. Its times are then those of receipt, as long as the
speed differs.
"""

from __future__ import annotations

from collections import deque
from typing import Final

WINDOW_S: Final = 2.0
"""Minimum length of a window, seconds of simulation time."""

WINDOW_MESSAGES: Final = 5
"""Minimum number of messages per window."""

JUMP_S: Final = 1.0
"""Difference above which the sender's clock has paused or jumped, seconds."""


BURST_S: Final = 0.05
"""Wall time within which messages count as one arrival, the last of them, seconds."""

ARRIVALS: Final = (8, 12, 16, 24, 32)
"""Numbers of arrivals from which a speed is determined; the fewest that are conclusive are used."""

SPEED_TOLERANCE: Final = 0.15
"""Largest difference in speed that the tracking of drift follows."""

SAME_SPEED: Final = 0.1
"""Difference in speed below which a speed that differed no longer does."""

STEADY_RATIO: Final = 1.15
"""Largest factor between the speeds in the earlier and in the later half of the arrivals."""

APART_S: Final = 0.3
"""Wall time by which the clocks must move apart before the speed counts as different, seconds."""


class SenderSpeed:
    """Determines the speed of a sender relative to the clock, which has a speed of 0 if it is stepped; a sender then has none.

    It must be the same in the earlier and in the later half of the last arrivals: a pause, a gap or a burst changes
    only one of them.
    """

    def __init__(self, clock_speed: float) -> None:
        self._clock_speed = clock_speed
        self._arrivals: deque[tuple[float, float]] = deque(maxlen=max(ARRIVALS))
        self._burst_begin_s = 0.0
        self._latest: tuple[float, float] | None = None
        self.ratio = 1.0
        """Speed of the sender relative to the clock."""
        self.differs = False
        """Whether the speeds of sender and clock differ."""

    def add(self, t: float, received_s: float) -> None:
        """Take a message into account: the sender's time and the simulation time of receipt, seconds."""
        if self._clock_speed == 0.0:
            return
        before, self._latest = self._latest, (t, received_s)
        if before is None or received_s - self._burst_begin_s < BURST_S * self._clock_speed:
            return
        self._burst_begin_s = received_s
        self._arrivals.append(before)
        for count in ARRIVALS:
            if len(self._arrivals) >= count and self._is_conclusive(count):
                return

    def _is_conclusive(self, count: int) -> bool:
        """Determine the speed from the last arrivals, if they agree on it."""
        first, middle, last = (self._arrivals[-n] for n in (count, count // 2, 1))
        ratio, early, late = _ratio(first, last), _ratio(first, middle), _ratio(middle, last)
        if max(early, late) > STEADY_RATIO * min(early, late):
            return False
        apart_s = abs((last[0] - first[0]) - (last[1] - first[1])) / self._clock_speed
        if apart_s >= APART_S and min(abs(early - 1.0), abs(late - 1.0)) > SPEED_TOLERANCE:
            self.differs = True
        elif max(abs(early - 1.0), abs(late - 1.0)) < SAME_SPEED:
            self.differs = False
        else:
            return False
        self.ratio = ratio
        return True


def _ratio(begin: tuple[float, float], end: tuple[float, float]) -> float:
    """Return the speed between two arrivals."""
    return (end[0] - begin[0]) / (end[1] - begin[1])


class SenderClock:
    """Converts the times of a sender to simulation time; `clock_speed` is simulation time per wall time, 0 if it is stepped."""

    def __init__(self, clock_speed: float) -> None:
        self.slope = 0.0
        """Current rate of change of the offset, seconds per second; positive for a slow sender."""
        self.speed = SenderSpeed(clock_speed)
        self._offset_s: float | None = None
        self._last_t = self._last_received_s = 0.0
        self._begin_window(0.0)

    def _begin_window(self, received_s: float) -> None:
        self._begin_s = received_s
        self._delays: list[float] = []

    def set_offset(self, t: float, received_s: float) -> None:
        """Equate a time of the sender with the simulation time at which it was received."""
        self._offset_s = received_s - t
        self.slope = 0.0
        self._last_t, self._last_received_s = t, received_s
        self._begin_window(received_s)
        self._delays.append(self._offset_s)

    def simulation_time(self, t: float, received_s: float, silence_s: float) -> float:
        """Convert a sender's time, seconds, to simulation time; it increases from call to call.

        After a silence of `silence_s` seconds, a late message means that the sender paused.
        """
        if self._offset_s is None:
            self.set_offset(t, received_s)
            return received_s
        differed = self.speed.differs
        self.speed.add(t, received_s)
        if self.speed.differs or differed:
            self.set_offset(t, received_s)
            self.slope = 1.0 - self.speed.ratio if self.speed.differs else 0.0
            return received_s
        elapsed_s = received_s - self._last_received_s
        delay_s = received_s - t
        if elapsed_s > silence_s and delay_s - self._offset_s > JUMP_S:
            self.set_offset(t, received_s)
            return received_s
        # limited so that simulation time never decreases between messages
        self._offset_s += max(self.slope * elapsed_s, -0.5 * (t - self._last_t))
        self._last_t, self._last_received_s = t, received_s
        if received_s - self._begin_s >= WINDOW_S and len(self._delays) >= WINDOW_MESSAGES:
            self._estimate_drift(self._offset_s, received_s)
        self._delays.append(delay_s)
        return t + self._offset_s

    def _estimate_drift(self, offset_s: float, received_s: float) -> None:
        earliest, latest = min(self._delays), max(self._delays)
        shift_s = earliest - offset_s if earliest > offset_s else min(latest - offset_s, 0.0)
        if abs(shift_s) > JUMP_S:
            self._offset_s = offset_s + shift_s
            self.slope = 0.0
        else:
            self.slope = shift_s / (received_s - self._begin_s)
        self._begin_window(received_s)
