"""Lock-step with a simulator: each message advances the simulation clock to its time, and is then answered.

The first message is the current truth. Each later message is the truth at the end of the step that it causes, so
that exposures within the step are between two messages. The simulator waits for the answer: both have the same
time, and the same messages give the same bytes.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import replace

from starhil.emulator.errors import EmulatorError
from starhil.emulator.truth.feed_rates import SHORTEST_S, FeedError
from starhil.emulator.truth.live import RESTART_S, LiveTruth

Step = Callable[[float], Awaitable[None]]
"""Advances simulation time by a number of seconds; returns when all events within the step are done."""


class LockStep:
    """Advances the simulation clock with the messages of a live feed."""

    def __init__(self, truth: LiveTruth, now_s: Callable[[], float], step: Step) -> None:
        self._truth = truth
        truth.timeline = "run"
        self._now_s = now_s
        self._step = step
        self._last_t: float | None = None
        self._lock = asyncio.Lock()

    async def receive(self, data: bytes) -> str:
        """Process one message; return the fault of a rejected message, otherwise an empty text."""
        async with self._lock:
            try:
                return await self._apply_message(data)
            except (FeedError, EmulatorError) as fault:
                self._truth.reject(str(fault))
                return str(fault)

    async def _apply_message(self, data: bytes) -> str:
        message = self._truth.format.decode(data)
        if message.t is None:
            raise FeedError("t is missing; lock-step needs the sender's time")
        last, now = self._last_t, self._now_s()
        if last is not None and last - message.t > RESTART_S:
            self._truth.begin_timeline()
            last = None
        step_s = 0.0 if last is None else message.t - last
        if last is not None and abs(step_s) < SHORTEST_S:
            return ""  # a simulator may repeat its first message
        if step_s < 0.0:
            raise FeedError(f"t = {message.t} is not later than in the previous message")
        self._last_t = message.t
        accepted = self._truth.accept(replace(message, t=now + step_s), now)
        if step_s > 0.0:
            await self._step(step_s)
        return "" if accepted else self._truth.last_fault
