"""Pumps that run the events of the device, with the wall clock or step by step."""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Callable, Sequence
from typing import Any, Final

from starhil.emulator.errors import EmulatorError
from starhil.emulator.run.tape import Event as EventEntry
from starhil.emulator.run.wiring import Wiring
from starhil.emulator.sensor.pipeline.client import PipelineClient
from starhil.emulator.simulation.clock import SteppedClock
from starhil.emulator.simulation.guard import call_guarded
from starhil.emulator.simulation.scheduler import Event, Scheduler
from starhil.protocol.icd.conventions import NANOSECONDS
from starhil.protocol.transports.base import Transport

log = logging.getLogger("starhil.run")

MAX_STEP_S: Final = 86_400.0
LONGEST_SLEEP_S: Final = 3600.0
PEER_PATIENCE_S: Final = 1.0
"""Wall time for which a step waits for a peer that does not read, seconds."""


class ClockPump:
    """Runs each event in the event loop when it is due."""

    def __init__(self, scheduler: Scheduler, wiring: Wiring) -> None:
        self._scheduler = scheduler
        self._clock = wiring.clock
        self._wiring = wiring
        self._loop = asyncio.get_running_loop()
        self._timer: asyncio.TimerHandle | None = None
        self._running = False
        scheduler.added.connect(self._event_added)

    def start(self) -> None:
        self._running = True
        self._schedule_next()

    def stop(self) -> None:
        self._running = False
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _event_added(self, _event: Event) -> None:
        """Wake up earlier if the new event is due first."""
        if self._running and (self._timer is None or self._due_s() < self._timer.when()):
            self._schedule_next()

    def _due_s(self) -> float:
        """Return the time of the next event on the loop's clock, seconds."""
        due_ns = self._scheduler.next_due_ns()
        if due_ns is None:
            return self._loop.time() + LONGEST_SLEEP_S
        clock = self._clock.running
        wait_s = (due_ns - clock.now_ns()) / NANOSECONDS / clock.speed
        return self._loop.time() + min(max(wait_s, 0.0), LONGEST_SLEEP_S)

    def _schedule_next(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._timer = self._loop.call_at(self._due_s(), self._run_due_event)

    def _run_due_event(self) -> None:
        self._timer = None
        self._wiring.latch()
        event = self._scheduler.pop_due(self._clock.now_ns())
        try:
            if event is not None:  # one at a time, so that the links run in between
                self._wiring.write(EventEntry)
                call_guarded("event", event.action, event.due_ns)
        finally:
            if self._running:
                self._schedule_next()


class StepPump:
    """Runs events on request, once time passes; before each, it waits for the pipelines and for the links to send.

    Simultaneous events run in the order of the devices. If a peer reads nothing for `PEER_PATIENCE_S`, steps do not
    wait for its transport until it reads again.
    """

    def __init__(
        self,
        devices: Sequence[tuple[Scheduler, PipelineClient]],
        transports: Sequence[Transport[Any]],
        clock: SteppedClock,
        time_passes: asyncio.Event,
        wiring: Wiring,
    ) -> None:
        self._wiring = wiring
        self._schedulers = [scheduler for scheduler, _ in devices]
        self._clock = clock
        self._time_passes = time_passes
        self._imagers = [imager for _, imager in devices]
        self._transports = [transport for transport in transports if not transport.immediate]
        self._stalled: dict[Transport[Any], int] = {}
        """Transports for which steps do not wait, with the items sent when the peer stopped reading."""
        self._lock = asyncio.Lock()
        self._stopped = False

    def stop(self) -> None:
        """Run no more events; a step in progress is cancelled."""
        self._stopped = True

    async def step(self, seconds: float, until: Callable[[], bool] = lambda: False) -> int:
        """Advance simulation time, at most to the event after which `until` holds.

        On return, all events within the step are done. Return their number.
        """
        if not 0.0 < seconds <= MAX_STEP_S:
            raise EmulatorError(f"step: must be seconds in (0, {MAX_STEP_S:g}], not {seconds}")
        await self._time_passes.wait()
        async with self._lock:
            end_ns = self._clock.now_ns() + round(seconds * NANOSECONDS)
            events = 0
            await self._settle()
            while (event := self._pop_next(end_ns)) is not None:
                events += 1
                self._clock.set_ns(max(event.due_ns, self._clock.now_ns()))
                self._wiring.write(EventEntry)
                call_guarded("event", event.action, event.due_ns)
                await self._settle()
                if until():
                    return events
            self._clock.set_ns(end_ns)
            return events

    def _pop_next(self, end_ns: int) -> Event | None:
        """Remove and return the earliest event of all devices that is due at `end_ns`, or None."""

        def due_ns(scheduler: Scheduler) -> float:
            due_ns = scheduler.next_due_ns()
            return math.inf if due_ns is None else due_ns

        return min(self._schedulers, key=due_ns).pop_due(end_ns)

    async def _settle(self) -> None:
        """Wait for the pipelines and the links, and let other tasks of the loop run; CancelledError once stopped."""
        for imager in self._imagers:
            await imager.settle()
        await asyncio.sleep(0)
        for transport in self._transports:
            await self._drain(transport)
        if self._stopped:
            raise asyncio.CancelledError

    async def _drain(self, transport: Transport[Any]) -> None:
        """Wait until a transport has sent everything, while its peer reads."""
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
                    "step: the peer of %s does not read; unread output is dropped",
                    transport.description,
                )
            else:
                self._stalled.pop(transport, None)
            return
