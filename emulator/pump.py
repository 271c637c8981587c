"""What makes run time pass for a device: with the wall clock, or step by step."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Sequence
from typing import Any, Final

from starhil.emulator.clock import NANOSECONDS, Clock, SteppedClock
from starhil.emulator.device.scheduler import Scheduler
from starhil.emulator.errors import EmulatorError
from starhil.emulator.guard import call_guarded
from starhil.emulator.pipeline.imager import Imager
from starhil.protocol.transports.base import Transport

log = logging.getLogger("starhil.run")

MAX_STEP_S: Final = 86_400.0
LONGEST_SLEEP_S: Final = 3600.0
PEER_PATIENCE_S: Final = 1.0
"""Wall time for which a step waits for a peer that takes nothing of what was sent to it, seconds."""


class ClockPump:
    """Does events when the clock reaches them, in the event loop."""

    def __init__(self, scheduler: Scheduler, clock: Clock) -> None:
        self._scheduler = scheduler
        self._clock = clock
        self._loop = asyncio.get_running_loop()
        self._timer: asyncio.TimerHandle | None = None
        self._running = False
        scheduler.on_add = self._event_added

    def start(self) -> None:
        """Begin."""
        self._running = True
        self._schedule_next()

    def stop(self) -> None:
        """Let time stand."""
        self._running = False
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _event_added(self) -> None:
        """Look anew when the loop comes around: whoever entered the event has its own work to end first."""
        if self._running and (self._timer is None or self._due_s() < self._timer.when()):
            self._schedule_next()

    def _due_s(self) -> float:
        """Time on the loop's clock of the next event."""
        due_ns = self._scheduler.next_due_ns()
        if due_ns is None:
            return self._loop.time() + LONGEST_SLEEP_S
        wait_s = (due_ns - self._clock.now_ns()) / NANOSECONDS / self._clock.speed
        return self._loop.time() + min(max(wait_s, 0.0), LONGEST_SLEEP_S)

    def _schedule_next(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._timer = self._loop.call_at(self._due_s(), self._run_due_event)

    def _run_due_event(self) -> None:
        self._timer = None
        event = self._scheduler.pop_due(self._clock.now_ns())
        try:
            if event is not None:  # one at a time, so that the links get their turn between two
                call_guarded("event", event.action, event.due_ns)
        finally:
            if self._running:
                self._schedule_next()


class StepPump:
    """Goes from event to event when it is told to, and waits before each for the pipeline and for what the links send.

    Parameters
    ----------
    transports
        Where the links send; one whose peer takes nothing for `PEER_PATIENCE_S` is not waited for until the peer reads again.
    """

    def __init__(
        self,
        scheduler: Scheduler,
        clock: SteppedClock,
        imager: Imager,
        transports: Sequence[Transport[Any]] = (),
    ) -> None:
        self._scheduler = scheduler
        self._clock = clock
        self._imager = imager
        self._transports = transports
        self._stalled: dict[Transport[Any], int] = {}
        """Transports that are not waited for, with what they had sent when their peers stopped reading."""
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
            await self._settle()
            while (event := self._scheduler.pop_due(end_ns)) is not None:
                self._clock.set_ns(max(event.due_ns, self._clock.now_ns()))
                call_guarded("event", event.action, event.due_ns)
                await self._settle()
            self._clock.set_ns(end_ns)

    async def _settle(self) -> None:
        """Wait for the pipeline and the links, and give whatever else is in the loop its turn."""
        await self._imager.settle()
        await asyncio.sleep(0)
        for transport in self._transports:
            await self._drain(transport)

    async def _drain(self, transport: Transport[Any]) -> None:
        """Wait until a transport has sent all, as long as its peer takes something."""
        sent = transport.statistics.sent
        if self._stalled.get(transport) == sent:
            return
        while True:
            try:
                async with asyncio.timeout(PEER_PATIENCE_S):
                    await transport.drain()
            except TimeoutError:
                if transport.statistics.sent != sent:
                    sent = transport.statistics.sent
                    continue
                self._stalled[transport] = sent
                log.warning(
                    "step: the peer of %s does not read; what it leaves unread is dropped",
                    transport.description,
                )
            else:
                self._stalled.pop(transport, None)
            return
