"""Conversion of a feed sender's clock to simulation time, with tracking of its drift.

The first message sets the offset between the clocks. Drift is determined per window of messages: the sender is slow
only if all of them arrive later than predicted, and fast only if all arrive earlier, so a single late message or an
early burst has no effect. The offset is corrected gradually over the next window. After a pause, or a difference above
`JUMP_S`, it is set again at once.
"""

from __future__ import annotations

from typing import Final

WINDOW_S: Final = 2.0
"""Minimum length of a window, seconds of simulation time."""

WINDOW_MESSAGES: Final = 5
"""Minimum number of messages per window."""

JUMP_S: Final = 1.0
"""Difference above which the sender's clock has paused or jumped, seconds."""


class SenderClock:
    """Converts the times of a sender to simulation time."""

    def __init__(self) -> None:
        self.slope = 0.0
        """Current rate of change of the offset, seconds per second; positive for a slow sender."""
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
        """Convert a sender's time to simulation time, seconds.

        Parameters
        ----------
        t
            Seconds on the sender's clock; increasing from call to call.
        received_s
            Simulation time of receipt, seconds.
        silence_s
            Silence after which a late message means that the sender paused, seconds.
        """
        if self._offset_s is None:
            self.set_offset(t, received_s)
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
