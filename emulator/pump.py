"""What makes run time pass for a device: with the wall clock, or step by step."""

from __future__ import annotations

import asyncio
from typing import Final

from emulator.clock import NANOSECONDS, Clock, SteppedClock
from emulator.device.scheduler import Scheduler
from emulator.errors import EmulatorError
from emulator.guard import call_guarded
from emulator.imaging.imager import Imager

MAX_STEP_S: Final = 86_400.0
LONGEST_SLEEP_S: Final = 3600.0


class ClockPump:
    """Does events when the clock reaches them, in the event loop."""

    def __init__(self, scheduler: Scheduler, clock: Clock) -> None:
        self._scheduler = scheduler
        self._clock = clock
        self._loop = asyncio.get_running_loop()
        self._timer: asyncio.TimerHandle | None = None
        self._running = False
        scheduler.on_change = self._changed

    def start(self) -> None:
        """Begin."""
        self._running = True
        self._plan()

    def stop(self) -> None:
        """Let time stand."""
        self._running = False
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _changed(self) -> None:
        """Look anew when the loop comes around: whoever entered the event has its own work to end first."""
        if self._running and (self._timer is None or self._due_s() < self._timer.when()):
            self._plan()

    def _due_s(self) -> float:
        """Time on the loop's clock of the next event."""
        due_ns = self._scheduler.next_due_ns()
        if due_ns is None:
            return self._loop.time() + LONGEST_SLEEP_S
        wait_s = (due_ns - self._clock.now_ns()) / NANOSECONDS / self._clock.speed
        return self._loop.time() + min(max(wait_s, 0.0), LONGEST_SLEEP_S)

    def _plan(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._timer = self._loop.call_at(self._due_s(), self._run)

    def _run(self) -> None:
        self._timer = None
        event = self._scheduler.pop_due(self._clock.now_ns())
        try:
            if event is not None:  # one at a time, so that the links get their turn between two
                call_guarded("event", event.action, event.due_ns)
        finally:
            if self._running:
                self._plan()


class StepPump:
    """Goes from event to event when it is told to, and waits for the pipeline before each."""

    def __init__(self, scheduler: Scheduler, clock: SteppedClock, imager: Imager) -> None:
        self._scheduler = scheduler
        self._clock = clock
        self._imager = imager
        self._lock = asyncio.Lock()

    async def step(self, seconds: float) -> None:
        """Let run time pass; all events within it are done when this returns.

        Raises
        ------
        EmulatorError
            The step is not a positive number of at most a day.
        """
        if not 0.0 < seconds <= MAX_STEP_S:
            raise EmulatorError(f"step: {seconds} given, seconds in (0, {MAX_STEP_S:g}] needed")
        async with self._lock:
            end_ns = self._clock.now_ns() + round(seconds * NANOSECONDS)
            await self._imager.settle()
            while (event := self._scheduler.pop_due(end_ns)) is not None:
                self._clock.set_ns(max(event.due_ns, self._clock.now_ns()))
                call_guarded("event", event.action, event.due_ns)
                await self._imager.settle()
            self._clock.set_ns(end_ns)
