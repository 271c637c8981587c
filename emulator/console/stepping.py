"""Runs the stepped clock in small steps at a given speed, on request of a page."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any, Final

from starhil.emulator.errors import EmulatorError

Execute = Callable[[dict[str, Any]], Awaitable[dict[str, Any]]]
"""Executes a request on the control channel."""

STEP_WALL_S: Final = 0.1
"""Wall time of one step, seconds."""

FASTEST: Final = 100.0
"""Maximum speed, simulation seconds per second."""


class StepRunner:
    """Steps the clock until it is paused."""

    def __init__(self, execute: Execute) -> None:
        self.execute = execute
        self._task: asyncio.Task[None] | None = None
        self.speed = 0.0
        """Simulation seconds per second; 0 while paused."""

    def run(self, speed: float) -> None:
        """Run at a speed; 0 pauses."""
        if not 0.0 <= speed <= FASTEST:
            raise EmulatorError(f"speed: {speed:g} is outside 0 … {FASTEST:g}")
        self.pause()
        if speed > 0.0:
            self.speed = speed
            self._task = asyncio.create_task(self._step())

    def pause(self) -> None:
        """Pause after the current step."""
        self.speed = 0.0
        self._task = None

    async def _step(self) -> None:
        own = asyncio.current_task()
        loop = asyncio.get_running_loop()
        while self._task is own:
            begin = loop.time()
            await self.execute({"do": "step", "seconds": self.speed * STEP_WALL_S})
            await asyncio.sleep(max(0.0, begin + STEP_WALL_S - loop.time()))
