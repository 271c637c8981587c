"""The clock of a feed's sender, tied to run time and followed where it slips.

The first message ties the two together. After that only what holds for every message of a window counts: if all of them come
later than the line says, the sender is slow, if all come earlier, it is fast; a single late message, or messages sent ahead in
bursts, move nothing. The line then turns towards the sender's within the next window, without a jump. A sender that paused, or
is more than `JUMP_S` off, is tied again.
"""

from __future__ import annotations

from typing import Final

WINDOW_S: Final = 2.0
"""Least length of a window, seconds of run time."""

WINDOW_MESSAGES: Final = 5
"""Fewest messages of a window."""

JUMP_S: Final = 1.0
"""A difference beyond this is not slipping: the sender paused, or ran ahead, seconds."""


class SenderClock:
    """Turns times of a sender into run time."""

    def __init__(self) -> None:
        self.slope = 0.0
        """By how many seconds a second the offset changes at present: above 0 for a sender that is slow."""
        self._offset_s: float | None = None
        self._last_t = self._last_received_s = 0.0
        self._begin_window(0.0)

    def _begin_window(self, received_s: float) -> None:
        self._begin_s = received_s
        self._delays: list[float] = []

    def tie(self, t: float, received_s: float) -> None:
        """Let a time of the sender be the run time at which it was received."""
        self._offset_s = received_s - t
        self.slope = 0.0
        self._last_t, self._last_received_s = t, received_s
        self._begin_window(received_s)
        self._delays.append(self._offset_s)

    def run_time(self, t: float, received_s: float, silence_s: float) -> float:
        """Return the run time of a sender's time, in seconds.

        Parameters
        ----------
        t
            Seconds on the sender's clock; rising from call to call.
        received_s
            Run time at which it was received, seconds.
        silence_s
            Time without a message after which a sender that comes late has paused, seconds.
        """
        if self._offset_s is None:
            self.tie(t, received_s)
            return received_s
        elapsed_s = received_s - self._last_received_s
        delay_s = received_s - t
        if elapsed_s > silence_s and delay_s - self._offset_s > JUMP_S:
            self.tie(t, received_s)
            return received_s
        # never so far back that run time would fall from one message to the next
        self._offset_s += max(self.slope * elapsed_s, -0.5 * (t - self._last_t))
        self._last_t, self._last_received_s = t, received_s
        if received_s - self._begin_s >= WINDOW_S and len(self._delays) >= WINDOW_MESSAGES:
            self._judge_window(self._offset_s, received_s)
        self._delays.append(delay_s)
        return t + self._offset_s

    def _judge_window(self, offset_s: float, received_s: float) -> None:
        earliest, latest = min(self._delays), max(self._delays)
        shift_s = earliest - offset_s if earliest > offset_s else min(latest - offset_s, 0.0)
        if abs(shift_s) > JUMP_S:
            self._offset_s = offset_s + shift_s
            self.slope = 0.0
        else:
            self.slope = shift_s / (received_s - self._begin_s)
        self._begin_window(received_s)
